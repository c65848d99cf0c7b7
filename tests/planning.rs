//! Steps before a run: stages' descriptions, checks of the request, and the printed plan.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::io::{BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use common::{Finished, Project, TINY, bin, signal, stage, wait_until};
use pixels::{Rgba8, write_png};
use serde_json::{Value, json};

/// Copies a program by another process: a file that this process has open for writing can't be
/// executed.
fn install(from: &Path, to: &Path) {
    std::fs::create_dir_all(to.parent().unwrap()).unwrap();
    assert!(
        Command::new("install").args(["-m", "755"]).args([from, to]).status().unwrap().success()
    );
}

/// Shell script of a stage, which appends its first argument to `started`. `describe` waits while
/// the file `wait` exists.
const SCRIPT: &str = r#"#!/bin/sh
cd "$(dirname "$0")"
echo "$1" >> started
if [ "$1" = describe ]; then
    while [ -e wait ]; do sleep 0.05; done
    echo '{"name":"mine","version":"1","code":"1","summary":"","parameters":{"type":"object"},"inputs":{},"output":{"kind":"k"}}'
    exit
fi
while [ "$1" != --output ]; do shift; done
mkdir "$2" && echo 1 > "$2/x"
"#;

fn project_with_script() -> Project {
    let project = Project::new(
        "default: [mine]\nstages:\n  mine: {run: ./mine.sh}\n  other: {run: ./other.sh}\n",
    );
    project.write("script", SCRIPT);
    install(&project.path("script"), &project.path("mine.sh"));
    project
}

/// Commands that inspect a foreign pipeline start none of its programs; only `run` does. Later
/// commands use the cached description until the program changes.
#[test]
fn only_run_starts_a_foreign_program() {
    let project = project_with_script();
    let started = || std::fs::read_to_string(project.path("started")).unwrap_or_default();
    let inspections: [&[&str]; 7] = [
        &["plan"],
        &["why", "mine"],
        &["status"],
        &["graph"],
        &["log", "mine"],
        &["gc", "--dry-run"],
        &["describe", "mine"],
    ];
    for arguments in inspections {
        let finished = project.run(arguments);
        if !["log", "gc"].contains(&arguments[0]) {
            finished.fails(
                2,
                &[
                    "pipeline.yaml:3: stage mine",
                    "mine.sh",
                    "check what the program does, then start it with `nerf-sr run`",
                ],
            );
        }
        assert_eq!(started(), "", "{arguments:?}");
    }
    project.ok(&["run"]);
    // `run` reads the description again after the stage: the script may call another program, which
    // may have been rebuilt meanwhile.
    let started_by_run = "describe\n--params\ndescribe\n";
    assert_eq!(started(), started_by_run, "other.sh is missing, but isn't needed");
    for arguments in inspections {
        project.ok(arguments);
    }
    assert!(project.ok(&["plan"]).contains("cached"));
    assert_eq!(started(), started_by_run);
    // A program with changed content counts as changed, even with equal size and time.
    let metadata = std::fs::metadata(project.path("mine.sh")).unwrap();
    project.write("script", &SCRIPT.replace("echo 1", "echo 2"));
    install(&project.path("script"), &project.path("mine.sh"));
    let file = std::fs::File::options().write(true).open(project.path("mine.sh")).unwrap();
    file.set_modified(metadata.modified().unwrap()).unwrap();
    drop(file);
    assert_eq!(std::fs::metadata(project.path("mine.sh")).unwrap().len(), metadata.len());
    project.run(&["plan"]).fails(2, &["check what the program does"]);
    assert_eq!(started(), started_by_run);
    project.ok(&["run"]);
    project.ok(&["plan"]);
    // `run` starts only programs that its targets need.
    project.write(
        "pipeline.yaml",
        "default: [demo-scene]\nstages:\n  demo-scene: {}\n  mine: {run: ./new.sh}\n",
    );
    install(&project.path("script"), &project.path("new.sh"));
    let before = started();
    project.ok(&[
        "run",
        "-p",
        "size=4",
        "-p",
        "train=1",
        "-p",
        "test=1",
        "-p",
        "demo-scene.samples_per_axis=1",
    ]);
    assert_eq!(started(), before);
}

#[test]
fn a_slow_describe_is_reported_and_can_be_interrupted() {
    let project = project_with_script();
    project.write("wait", "");
    let mut child =
        project.command(&["run"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut stderr = BufReader::new(child.stderr.take().unwrap());
    let mut line = String::new();
    stderr.read_line(&mut line).unwrap();
    assert!(line.contains("reading the stages' descriptions"), "{line}");
    wait_until(|| project.path("started").exists());
    signal(&child, "-TERM");
    line.clear();
    stderr.read_to_string(&mut line).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130), "{line}");
    assert!(
        line.contains("interrupted") && !line.contains("failed") && !line.contains("stage mine"),
        "{line}"
    );
    // The next run continues after the file `wait` is deleted.
    let child =
        project.command(&["run"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    std::fs::remove_file(project.path("wait")).unwrap();
    let finished = Finished::of(child.wait_with_output().unwrap());
    assert_eq!(finished.code, 0, "{}", finished.stderr);
}

fn run_installed(project: &Project, arguments: &[&str]) -> Finished {
    Finished::of(
        Command::new(project.path("bin/nerf-sr"))
            .args(arguments)
            .current_dir(project.path(""))
            .output()
            .unwrap(),
    )
}

/// A missing program affects only targets that use it; the error message names the command that
/// builds the program.
#[test]
fn a_missing_program_fails_only_targets_that_need_it() {
    let project = Project::tiny();
    let installed = |name: &str| -> PathBuf { project.path("bin").join(name) };
    ["nerf-sr", "demo-scene", "prep"]
        .into_iter()
        .for_each(|name| install(&bin(name), &installed(name)));
    for arguments in
        [&["plan", "prep"][..], &["run", "demo-scene"], &["plan", "prep", "-p", "kernel=box"]]
    {
        let finished = run_installed(&project, arguments);
        assert_eq!(finished.code, 0, "{arguments:?}: {}", finished.stderr);
    }
    run_installed(&project, &["plan"])
        .fails(2, &["pipeline.yaml:9: stage train-ss: ", "train-ss isn't built; run `make build`"]);
    run_installed(&project, &["plan", "prep", "-p", "rays=1"]).fails(
        2,
        &["no stage has this parameter", "stages without a description were not searched: "],
    );
    project.replace("  demo-scene:\n", "  demo-secne:\n");
    project.replace("{dataset: demo-scene}", "{dataset: demo-secne}");
    run_installed(&project, &["plan"])
        .fails(2, &["pipeline.yaml:4: stage demo-secne", "did you mean demo-scene?"]);
    // Blocks that the target doesn't need are checked too.
    project.replace("lr_width: 24", "ir_width: 24");
    run_installed(&project, &["plan", "demo-secne"]).fails(
        2,
        &["pipeline.yaml:8: stage prep: parameter ir_width: unknown; did you mean lr_width?"],
    );
}

/// Bad calls are refused before any stage runs.
#[test]
fn plan_and_run_refuse_calls_that_a_stage_would_refuse() {
    let upsample = "  upsample:\n    inputs: \
        {views: prep/train, cameras: prep/train-cameras}\n    parameters: {method: imdn}\n";
    let project = Project::new(&format!("{TINY}{upsample}"));
    for (arguments, message) in [
        (
            &["upsample"][..],
            "stage upsample: input weights is missing: methods imdn, liif and swinir",
        ),
        (
            &["upsample", "-p", "method=bicubic,liif"],
            "stage upsample [upsample.method=liif]: input weights is missing",
        ),
        (
            &["-p", "prep.scale=2.7", "-p", "kernel=average"],
            "stage prep: parameter kernel: average requires an integer scale",
        ),
        (
            &["-p", "background=alpha", "-p", "supervision=kernel"],
            "stage train-ss: parameter supervision: kernel cannot be used with prep.background",
        ),
        (
            &["-p", "background=white,alpha", "-p", "exposure=true"],
            "stage train-ss [background=alpha]: parameter exposure",
        ),
        (
            &["-p", "background=alpha", "-p", "pose_refinement=true"],
            "parameter pose_refinement: with prep.background alpha, renders cannot be compared with photographs",
        ),
        (&["--device", "gpu"], "--device gpu: no such device; expected cpu, cuda or cuda:N"),
        (&["--device", "cuda:"], "--device cuda:: no such device"),
    ] {
        for verb in ["plan", "run"] {
            project.run(&[&[verb], arguments].concat()).fails(2, &[message]);
        }
    }
    assert_eq!(project.store_listing(), Vec::<String>::new());
    std::fs::create_dir(project.path("weights")).unwrap();
    project.ok(&["plan", "upsample", "-i", "weights=weights"]);
    // A stage that is started directly refuses the same calls.
    let (views, output) = (project.path("views"), project.path("none"));
    let inputs = [("views", views.as_path()), ("cameras", &views)];
    common::stage("upsample", r#"{"method": "imdn"}"#, &inputs, &output, &[])
        .fails(2, &["input weights is missing", "convert-weights.py"]);
    let inputs = [("dataset", views.as_path())];
    common::stage("prep", r#"{"kernel": "average", "scale": 1.5}"#, &inputs, &output, &[])
        .fails(2, &["average requires an integer scale"]);
}

#[test]
fn why_plan_and_graph_include_sinks() {
    let project = Project::new(&format!(
        "{}  report:\n    inputs: {{run: eval}}\n",
        TINY.replace("[eval]", "[report]")
    ));
    for (arguments, texts) in [
        (
            &["why", "report"][..],
            &[
                "report: shows eval; a run writes the page again if results change",
                "\n  eval: waits for",
            ][..],
        ),
        (&["plan"], &["shows eval"]),
        (&["graph"], &["report (displays the run)  ← eval\n"]),
        (&["graph", "--format", "dot"], &["[label=\"report\", shape=note]", "n4 -> n5"]),
    ] {
        let stdout = project.ok(arguments);
        assert!(texts.iter().all(|text| stdout.contains(text)), "{arguments:?}: {stdout}");
    }
    project.run(&["why", "reprot"]).fails(2, &["no stage \"reprot\" in this plan"]);
    project
        .run(&["why", "evla"])
        .fails(2, &["no stage \"evla\" in this plan; did you mean eval? known: demo-scene, eval"]);
}

/// Estimates use the sizes of images that no stage has written yet.
#[test]
fn times_are_estimated_before_a_run() {
    let project = Project::tiny();
    let plan = project.ok(&["plan"]);
    // Five stages (demo scene, preparation, training, rendering, scoring), and the total.
    let times = plan.lines().filter(|line| line.contains("of processor time")).count();
    assert_eq!(times, 6, "{plan}");
    let total = plan.lines().last().unwrap();
    for text in ["about ", " on ", "at most ", "MB of memory for a stage"] {
        assert!(total.contains(text) && !total.contains("without"), "{text}: {total}");
    }
    let advice = project.ok(&["advise", "-p", "test_views=1", "--minutes", "100"]);
    for text in ["12 training views", "1 view of", "training ", "rendering ", "scoring "] {
        assert!(advice.contains(text), "{text}: {advice}");
    }
    for quality in ["draft ", "fast ", "balanced ", "best "] {
        let line = advice.lines().find(|line| line.starts_with(quality)).unwrap();
        // The project has no refinement, so its column is empty.
        assert_eq!((line.matches(" MB").count(), line.matches('–').count()), (4, 1), "{line}");
    }
    assert!(advice.trim_end().ends_with("-p test_views=1 -p quality=best"), "{advice}");
    let advice = project.ok(&["advise", "--minutes", "0"]);
    assert!(advice.contains("no quality fits into 0 minutes"), "{advice}");
    let advice = project.ok(&["advise", "--memory", "20M"]);
    assert!(advice.contains("no quality fits into 20M of memory; draft needs "), "{advice}");
    assert!(advice.trim_end().ends_with("-p quality=draft"), "{advice}");
    let advice = project.ok(&["advise", "--memory", "20G"]);
    assert!(advice.trim_end().ends_with("-p quality=best --memory 20G"), "{advice}");
    assert!(project.ok(&["advise"]).trim_end().ends_with("-p quality=balanced"));
}

/// Before `prep` has run, estimates look at cameras and at the borders of three photographs. After
/// it, they and the run's records have the scene's own background, here of photographs that
/// deceive.
#[test]
fn estimates_follow_the_photographs() {
    let project = Project::tiny();
    for (name, backdrop, layout, kind) in [
        ("white", false, "around", "object in front of a plain background"),
        ("wall", true, "forward", "opaque scene, photographed from one side"),
        ("yard", true, "around", "opaque scene around the cameras"),
    ] {
        let parameters = json!({
            "form": "transforms", "backdrop": backdrop, "layout": layout, "size": 32, "train": 9,
            "test": 1, "samples_per_axis": 1,
        });
        let made = stage("demo-scene", &parameters.to_string(), &[], &project.path(name), &[]);
        assert_eq!(made.code, 0, "{}", made.stderr);
        let advice = project.ok(&["advise", "-i", &format!("dataset={name}")]);
        assert!(advice.contains(kind), "{name}: {advice}");
    }
    std::fs::remove_file(project.path("yard/artifact.json")).unwrap();
    let transforms = std::fs::read(project.path("yard/transforms.json")).unwrap();
    let transforms: Value = serde_json::from_slice(&transforms).unwrap();
    let white = Rgba8::new(32, 32, vec![255; 4 * 32 * 32]);
    for frame in [0, 3, 6] {
        let photograph = transforms["frames"][frame]["file_path"].as_str().unwrap();
        write_png(&project.path("yard").join(photograph), &white).unwrap();
    }
    let dataset = ["-i", "dataset=yard"];
    let advice = project.ok(&[&["advise"], &dataset[..]].concat());
    assert!(advice.contains("object in front of a plain background"), "{advice}");
    project.ok(&[&["run", "train-ss", "-p", "lr_width=12"], &dataset[..]].concat());
    let records = project.store_listing().into_iter().filter(|path| path.ends_with(".json"));
    let records = records
        .map(|path| -> Value { serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap() });
    let trainings: Vec<Value> = records.filter(|record| record["stage"] == "train-ss").collect();
    assert_eq!(trainings.len(), 1);
    assert_eq!(trainings[0]["model"]["scene"], "unbounded", "{}", trainings[0]);
    let advice = project.ok(&[&["advise", "-p", "lr_width=12"], &dataset[..]].concat());
    assert!(advice.contains("opaque scene around the cameras"), "{advice}");
}

/// Estimates for a camera path use the number and size of frames in its parameters or its file.
#[test]
fn views_along_a_path_are_estimated() {
    let project = Project::shipped(&["video"], "");
    let estimate = |arguments: &[&str]| {
        let plan = project.ok(&[&["plan", "video"], arguments].concat());
        let line = plan.lines().find(|line| line.starts_with("path-views ")).unwrap();
        line.rsplit_once("; about ").unwrap_or_else(|| panic!("{plan}")).1.to_owned()
    };
    let default_estimate = estimate(&[]);
    assert!(default_estimate.contains(" of processor time, "), "{default_estimate}");
    assert_ne!(estimate(&["-p", "frames=1200"]), default_estimate);
    project.write(
        "path/camera_path.json",
        r#"{"render_width": 4000, "render_height": 3000, "camera_path": [{}]}"#,
    );
    assert_ne!(estimate(&["-i", "camera-path.path=path"]), default_estimate);
}

/// A run prints its estimate before the first stage, after each stage and at the end.
#[test]
fn a_run_is_compared_with_its_estimate() {
    let project = Project::tiny();
    let run = project.run(&["run"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let mut lines = run.stderr.lines();
    let before = lines.find(|line| line.starts_with("nerf-sr: about ")).unwrap();
    assert!(before.contains("by stage: demo-scene ") && before.contains(", train-ss "), "{before}");
    for stage in ["demo-scene", "prep", "train-ss", "render-depth", "eval"] {
        let done = format!("{stage}: done in ");
        let line = run.stderr.lines().find(|line| line.starts_with(&done)).unwrap();
        assert!(line.contains("; estimated ") && line.contains(" MB"), "{line}");
    }
    let end = run.stdout.lines().last().unwrap();
    assert!(end.contains("5 of 5 stages ran") && end.contains(", estimated "), "{end}");
    let again = project.run(&["run"]);
    assert!(!again.stderr.contains("about "), "{}", again.stderr);
}

#[test]
fn a_run_with_a_stage_beyond_the_free_memory_is_refused_before_its_start() {
    let project = Project::tiny();
    let refused = project.run(&["run", "--memory", "50M"]);
    refused.fails(2, &["train-ss needs about ", "and 52.4 MB are free, so nothing was run"]);
    assert!(!refused.stderr.contains("done in"), "{}", refused.stderr);
    let limited = project.command(&["run"]).env("NERF_SR_MEMORY", "40000000").output().unwrap();
    common::Finished::of(limited).fails(2, &["and 40.0 MB are free, so nothing was run"]);
    assert_eq!(project.store_listing(), Vec::<String>::new());
}

/// A stage that ran with a quality is cached for the quality's parameters.
#[test]
fn a_quality_has_the_key_of_its_parameters() {
    let project = Project::tiny();
    let message = "no quality \"good\"; choose draft, fast, balanced or best";
    project.run(&["plan", "-p", "quality=good"]).fails(2, &["-p quality=good: ", message]);
    project.ok(&["run", "-p", "quality=fast"]);
    let parameters = [
        "rays_per_pixel=4.8",
        "opaque_ray_factor=0.42",
        "pixel_importance=20",
        "cells_per_pixel=1.6",
        "supersample_warmup=0.4",
        "min_rays=1000000",
        "max_rays=8000000",
        "render-depth.samples_per_axis=1",
    ];
    let arguments: Vec<&str> = parameters.iter().flat_map(|parameter| ["-p", parameter]).collect();
    let status = project.ok(&[&["status", "eval"], &arguments[..]].concat());
    assert!(status.lines().all(|line| line.contains(" cached ")), "{status}");
    assert!(!project.ok(&["status", "eval"]).lines().all(|line| line.contains(" cached ")));
}

/// A run executes the actions that its plan lists as `will run`, no cached actions, and possibly
/// waiting ones. Equal parameter values have equal keys.
#[test]
fn a_run_follows_its_plan() {
    let project = Project::tiny();
    project.replace("{lr_width: 24, scale: 2}", "{lr_width: 24, scale: 2, kernel: box}");
    let action_count =
        || project.store_listing().iter().filter(|name| name.ends_with(".json")).count();
    for (arguments, expected_runs) in [
        (&[][..], 2),
        (&[], 0),
        // Equal values in other notations, and explicit defaults.
        (
            &[
                "-p",
                "prep.scale=2.0",
                "-p",
                "lr_width=24.0",
                "-p",
                "demo-scene.size=48e0",
                "-p",
                "demo-scene.seed=0",
            ],
            0,
        ),
        (&["-p", "prep.scale=3", "-p", "prep.scale=2", "-p", "near=", "-p", "lens=follow"], 0),
        // An explicit value differs from a default that `prep` chooses by data set.
        (&["-p", "lr_source=downscaled"], 1),
        (&["-p", "demo-scene.train=11", "-p", "demo-scene.train=12"], 0),
        (&["-p", "kernel=box,bicubic"], 1),
        (&["-p", "demo-scene.samples_per_axis=1", "-p", "kernel=box,bicubic"], 3),
        (&["-p", "demo-scene.samples_per_axis=1,2", "-p", "kernel=box,bicubic"], 0),
    ] {
        let arguments = [&["prep"], arguments].concat();
        let plan = project.ok(&[&["plan"], &arguments[..]].concat());
        let count = |text: &str| plan.lines().filter(|line| line.contains(text)).count();
        let (will_run, waits, before) = (count("will run"), count("waits for"), action_count());
        project.ok(&[&["run"], &arguments[..]].concat());
        let ran = action_count() - before;
        assert!(
            (will_run..=will_run + waits).contains(&ran) && ran == expected_runs,
            "{arguments:?}: {ran} ran of\n{plan}"
        );
        let after = project.ok(&[&["plan"], &arguments[..]].concat());
        assert!(after.lines().all(|line| line.contains("cached")), "{after}");
    }
    for verb in ["plan", "run"] {
        let finished =
            project.run(&[verb, "prep", "-p", "kernel=lanczos", "-p", "prep.kernel=box"]);
        assert!(
            finished.code == 0
                && finished.stderr.contains("-p kernel=lanczos: overridden by -p prep.kernel=box"),
            "{}",
            finished.stderr
        );
    }
}

#[test]
fn utf16_is_refused_with_advice_and_a_byte_order_mark_is_accepted() {
    let project = Project::new("");
    let utf16: Vec<u8> =
        std::iter::once(0xfeff).chain(TINY.encode_utf16()).flat_map(u16::to_le_bytes).collect();
    std::fs::write(project.path("pipeline.yaml"), utf16).unwrap();
    project
        .run(&["plan"])
        .fails(2, &["pipeline.yaml:1: not UTF-8 (maybe UTF-16); save it as UTF-8"]);
    project.write("pipeline.yaml", &format!("\u{feff}{}", TINY.replace('\n', "\r\n")));
    project.ok(&["plan"]);
    project.write("pipeline.yaml", "default: [../x]\nstages:\n  ../x: {run: report}\n");
    project
        .run(&["plan"])
        .fails(2, &["pipeline.yaml:3: stage \"../x\": choose a name of 1 to 100 bytes"]);
}

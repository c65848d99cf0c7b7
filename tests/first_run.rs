//! From nothing to views: `nerf-sr init`, a build without libtorch, and installed programs.

#![allow(missing_docs, reason = "a test")]
mod common;
#[path = "common/forms.rs"]
mod forms;
#[path = "common/installed.rs"]
mod installed;

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::SystemTime;

use common::{Finished, Project, bin, root};
use forms::{FORMS, WIDTH, as_colmap};

/// A folder without a pipeline.
fn empty() -> Project {
    let project = Project::new("");
    std::fs::remove_file(project.path("pipeline.yaml")).unwrap();
    project
}

/// Parameters of a short training; all others are those of the written pipeline.
const SHORT: [&str; 12] = [
    "-p",
    "train-ss.rays=4000",
    "-p",
    "n_levels=2",
    "-p",
    "cells_per_pixel=0.64",
    "-p",
    "log2_hashmap_size=10",
    "-p",
    "march_steps=64",
    "-p",
    "train-ss.hidden_dim=16",
];

#[test]
fn what_init_writes_runs_as_it_is() {
    let project = empty();
    let demo = "Blender (transforms_train.json): 21 photographs".to_owned();
    let mut folders = vec![("data", demo, "downscaled")];
    for form in FORMS {
        (form.write)(&project);
        folders.push((form.name, format!("{}: 20 photographs", form.found), form.lr_source));
    }
    for (folder, found, lr_source) in folders {
        let pipeline = format!("of-{folder}/pipeline.yaml");
        std::fs::create_dir(project.path(&format!("of-{folder}"))).unwrap();
        let said = project.ok(&["--pipeline", &pipeline, "init", folder]);
        assert!(said.contains(&format!("found: {found} of {WIDTH}×{WIDTH}\n")), "{said}");
        assert!(
            said.contains(&format!("sizes: photographs {WIDTH}×{WIDTH}; training at")),
            "{said}"
        );
        let text = std::fs::read_to_string(project.path(&pipeline)).unwrap();
        assert!(text.contains(&format!("lr_source: {lr_source}")), "{text}");
        let run = [&["--pipeline", pipeline.as_str(), "run"][..], &SHORT].concat();
        let said = project.ok(&run);
        assert!(said.contains("eval: ") && said.contains("index.html"), "{said}");
        for target in ["refined", "video", "registered", "reference-refine", "hr-finetune"] {
            project.ok(&["--pipeline", &pipeline, "plan", target]);
        }
    }
}

/// Experiments run on the scene of `init`, also where the pipeline trains on the photographs.
#[test]
fn experiments_run_in_a_folder_of_init() {
    let project = empty();
    as_colmap(&project);
    let said = project.ok(&["init", "colmap"]);
    assert!(said.contains("wrote: pipeline.yaml, pipelines/ (") && said.contains("experiments/ ("));
    for name in
        ["quality", "ablation", "tradeoff", "refine-table", "refine-ablation", "paper-table"]
    {
        project.ok(&["plan", name]);
    }
    project.ok(&[&["run", "seeds", "-p", "train-ss.seed=1,2"][..], &SHORT].concat());
    let table = std::fs::read_to_string(project.path("out/seeds/table.md")).unwrap();
    assert_eq!(table.lines().filter(|line| line.starts_with("| ")).count(), 4, "{table}");
    project.run(&["plan", "quality", "--scene", "lego"]).fails(2, &["no scene lego", "--data"]);
    // Protocols downscale the photographs.
    let prep = || {
        let nodes = project.nodes(&["quality", "--protocol", "24x2"]);
        nodes.into_iter().find(|node| node["stage"] == "prep").unwrap()["key"].clone()
    };
    let key = prep();
    project.replace("lr_source: photographs", "lr_source: null");
    assert_eq!(prep(), key);
}

/// Commented parameters are correct, too: without their `#` the pipeline works.
#[test]
fn what_init_leaves_commented_out_is_right() {
    let project = empty();
    as_colmap(&project);
    project.ok(&["init", "colmap"]);
    let text = std::fs::read_to_string(project.path("pipeline.yaml")).unwrap();
    let commented = "      # ";
    let parameters = text.lines().filter_map(|line| line.strip_prefix(commented)).count();
    assert!(parameters >= 4, "{text}");
    std::fs::create_dir(project.path("weights")).unwrap();
    for file in ["squeezenet1_1.safetensors", "lpips_linear_squeeze_v0.1.safetensors"] {
        project.write(&format!("weights/{file}"), "");
    }
    project.write("pipeline.yaml", &text.replace(commented, "      "));
    project.ok(&["plan"]);
}

#[test]
fn init_overwrites_nothing() {
    let project = empty();
    as_colmap(&project);
    project.write("pipelines/video.yaml", "mine");
    project.run(&["init", "colmap"]).fails(2, &["pipelines/video.yaml exists"]);
    assert!(!project.path("pipeline.yaml").exists(), "all or nothing");
    std::fs::remove_file(project.path("pipelines/video.yaml")).unwrap();
    std::os::unix::fs::symlink("nowhere", project.path("pipeline.yaml")).unwrap();
    project.run(&["init", "colmap"]).fails(2, &["pipeline.yaml exists"]);
    std::fs::remove_file(project.path("pipeline.yaml")).unwrap();
    project.ok(&["init", "colmap"]);
    let before = std::fs::read(project.path("pipeline.yaml")).unwrap();
    project.run(&["init", "colmap"]).fails(2, &["pipeline.yaml exists and was not changed"]);
    assert_eq!(std::fs::read(project.path("pipeline.yaml")).unwrap(), before);
}

#[test]
fn folders_that_init_refuses() {
    let project = empty();
    as_colmap(&project);
    std::fs::create_dir(project.path("nothing")).unwrap();
    for folder in ["loose", "cameraless/images"] {
        std::fs::create_dir_all(project.path(folder)).unwrap();
        std::fs::copy(
            project.path("colmap/images/r_0.png"),
            project.path(&format!("{folder}/a b.PNG")),
        )
        .unwrap();
    }
    project.run(&["init", "nothing"]).fails(3, &["nothing: no data set; expected"]);
    project.run(&["init", "nowhere"]).fails(3, &["nowhere: no such folder"]);
    project
        .run(&["init", "loose"])
        .fails(3, &["loose: 1 image, but no cameras", "move them to 'loose/images'", "colmap"]);
    project
        .run(&["init", "cameraless"])
        .fails(3, &["cameraless: 1 image, but no cameras", "--image_path 'cameraless/images'"]);
    let inside = project.command(&["init", "."]).current_dir(project.path("colmap")).output();
    Finished::of(inside.unwrap()).fails(2, &["can't be inside the data set"]);
    project.run(&["plan"]).fails(2, &["pipeline.yaml: No such file", "`nerf-sr init DIR`"]);
    assert!(!project.path("pipelines").exists() && !project.path("colmap/.nerf-sr").exists());
}

/// Whatever a folder is called, the pipeline finds it: beside the pipeline, below it or elsewhere.
#[test]
fn folders_with_odd_names() {
    let project = empty();
    as_colmap(&project);
    for name in ["my photos", "Bäume: \"#1\"", "{rays}{dataset}", "-p", "it's", "yes/no"] {
        let (home, data) = (project.path("home"), project.path(&format!("home/{name}")));
        std::fs::create_dir_all(data.parent().unwrap()).unwrap();
        std::fs::rename(project.path("colmap"), &data).unwrap();
        for (at, folder) in
            [(home.clone(), format!("./{name}")), (home.join("x"), format!("../{name}"))]
        {
            std::fs::create_dir_all(&at).unwrap();
            let verbs = [&["init", folder.as_str()][..], &["plan"], &["plan", "paper-table"]];
            for verb in verbs {
                let output = project.command(verb).current_dir(&at).output().unwrap();
                let finished = Finished::of(output);
                assert_eq!(finished.code, 0, "{name}: {}", finished.stderr);
            }
        }
        std::fs::rename(&data, project.path("colmap")).unwrap();
        std::fs::remove_dir_all(&home).unwrap();
    }
}

/// Within ten seconds the runner reports that a silent stage is alive. The stage works until this
/// report, or for one or two minutes.
#[test]
fn a_silent_stage_shows_that_it_lives() {
    let project = Project::new("default: [quiet]\nstages:\n  quiet: {run: ./quiet}\n");
    let describes = r#"{"name": "quiet", "version": "1", "code": "1", "summary": "Waits.",
        "parameters": {"type": "object"}, "inputs": {}, "output": {"kind": "text"}}"#;
    let works = "for i in $(seq 600); do [ -e seen ] && break; sleep 0.1; done
        while [ $1 != --output ]; do shift; done; mkdir $2; echo x > $2/x";
    let script =
        format!("#!/bin/sh\nif [ $1 = describe ]; then echo '{describes}'; else {works}; fi\n");
    project.program("quiet", &script);
    let mut child = project.spawn(&["run"]);
    let mut said = Vec::new();
    for line in BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok) {
        if line.starts_with("quiet: running for ") {
            project.write("seen", "");
        }
        said.push(line);
    }
    assert_eq!(child.wait().unwrap().code(), Some(0), "{said:?}");
    let first = said.iter().find_map(|line| seconds_running(line));
    assert!(first.is_some_and(|seconds| (1..=10).contains(&seconds)), "{said:?}");
}

fn seconds_running(line: &str) -> Option<u32> {
    let rest = line.strip_prefix("quiet: running for ")?;
    rest.split(|c: char| !c.is_ascii_digit()).next()?.parse().ok()
}

/// Programs built without libtorch that are as new as the sources: `make demo` leaves them.
fn without_libtorch() -> Option<PathBuf> {
    let folder = root().join("target/without-libtorch");
    let built = modified(&folder.join("eval"));
    let sources = ["Cargo.lock", "Cargo.toml", ".cargo/config.toml"].map(|file| root().join(file));
    let walked = walkdir::WalkDir::new(root().join("stages")).into_iter().flatten();
    let files = walked.map(walkdir::DirEntry::into_path).filter(|path| path.is_file());
    if files.chain(sources).all(|file| modified(&file) < built) {
        return Some(folder);
    }
    eprintln!(
        "skipped: no build without libtorch that is as new as the sources; `make demo` in an empty target makes one"
    );
    None
}

fn modified(file: &Path) -> Option<SystemTime> {
    file.metadata().ok()?.modified().ok()
}

fn run_small(programs: &Path, project: &Project, arguments: &[&str]) -> Finished {
    let mut command = Command::new(programs.join("nerf-sr"));
    command.args(arguments).current_dir(project.path(".")).env_remove("NERF_SR_STORE");
    Finished::of(command.output().unwrap())
}

/// A stage's builds with and without libtorch give the same key and bytes: after `make demo`,
/// `make build` leaves the demo cached.
#[test]
fn a_build_without_libtorch_makes_what_the_whole_one_makes() {
    let Some(programs) = without_libtorch() else { return };
    let project = Project::fast();
    let made = run_small(&programs, &project, &["run"]);
    assert_eq!(made.code, 0, "{}", made.stderr);
    assert!(project.ok(&["run"]).contains("all 5 stages are cached"));
    let names = ["demo-scene", "prep", "train-ss", "render-depth", "eval"];
    let outputs = |store: &[&str]| names.map(|stage| project.output_of(stage, store));
    project.ok(&["--store", "other", "run"]);
    assert_eq!(outputs(&[]), outputs(&["--store", "other"]));
    // What needs libtorch is refused, with the command that builds it.
    for file in ["squeezenet1_1.safetensors", "lpips_linear_squeeze_v0.1.safetensors"] {
        project.write(&format!("weights/{file}"), "");
    }
    for arguments in [
        &["run", "-i", "weights=weights"][..],
        &["run", "-p", "train-ss.field=mlp"],
        &["run", "--device", "cuda:0"],
    ] {
        run_small(&programs, &project, arguments).fails(2, &["libtorch", "run `make build`"]);
    }
    project.replace("default: [report]", "default: [refine]");
    project.replace("  eval:\n", "  refine:\n    inputs: {views: render-depth}\n  eval:\n");
    run_small(&programs, &project, &["run"])
        .fails(2, &["pipeline.yaml:", "stage refine: ", "refine isn't built; run `make build`"]);
    assert_eq!(
        run_small(&programs, &project, &["run", "eval"]).code,
        0,
        "ignored by targets that don't use it"
    );
}

fn run_bare(prefix: &Path, project: &Project, program: &str, arguments: &[&str]) -> Finished {
    let mut command = Command::new(prefix.join(program));
    command.env_clear().args(arguments).current_dir(project.path("."));
    Finished::of(command.output().unwrap())
}

/// Installed programs run from any folder, with nothing of the environment.
#[test]
fn installed_programs_run_from_any_folder() {
    let project = Project::fast();
    let prefix = project.path("usr");
    if !installed::install(&prefix) {
        return;
    }
    let ran = run_bare(&prefix, &project, "bin/nerf-sr", &["run"]);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    assert!(project.ok(&["run"]).contains("all 5 stages are cached"), "one key, wherever it lies");
    // A program that can't do without libtorch.
    let described = run_bare(&prefix, &project, "lib/nerf-sr/refine", &["describe"]);
    assert_eq!(described.code, 0, "{}", described.stderr);
    let is_there = |file: &str| assert!(prefix.join("share").join(file).is_file(), "{file}");
    let remote = bin("nerf-sr").with_file_name("nerf-sr-remote").exists();
    for name in ["nerf-sr"].into_iter().chain(remote.then_some("nerf-sr-remote")) {
        let version = run_bare(&prefix, &project, &format!("bin/{name}"), &["--version"]);
        assert_eq!(version.stdout, format!("{name} {}\n", env!("CARGO_PKG_VERSION")));
        is_there(&format!("bash-completion/completions/{name}"));
        is_there(&format!("zsh/site-functions/_{name}"));
        is_there(&format!("fish/vendor_completions.d/{name}.fish"));
        is_there(&format!("man/man1/{name}.1"));
    }
    is_there("man/man1/nerf-sr-run.1");
    checked(&["bash", "-n"], &prefix.join("share/bash-completion/completions/nerf-sr"));
    checked(
        &["groff", "-Kutf8", "-man", "-Tutf8", "-ww", "-z"],
        &prefix.join("share/man/man1/nerf-sr-run.1"),
    );
}

/// The archive of `make dist` has a licence text for each linked crate, for Rust and for libtorch.
#[test]
fn every_linked_crate_has_its_licence() {
    let project = Project::tiny();
    let folder = project.path("licences");
    let libtorch = root().join(".libtorch");
    if !libtorch.join("licenses").is_dir() {
        eprintln!("skipped: no licences in {}", libtorch.display());
        return;
    }
    let mut command = Command::new("python3");
    command.arg(root().join("scripts/licences.py")).arg(&folder).arg(libtorch);
    let copied = Finished::of(command.output().unwrap());
    assert_eq!(copied.code, 0, "{}", copied.stderr);
    let files = |path: &str| -> Vec<PathBuf> {
        let found = std::fs::read_dir(folder.join(path)).unwrap();
        found.map(|entry| entry.unwrap().path()).collect()
    };
    let list = std::fs::read_to_string(folder.join("crates.txt")).unwrap();
    assert!(list.contains("\nblake3 ") && list.contains("\ntch "), "{list}");
    assert!(!list.contains("\nproptest "), "only tests use it");
    assert_eq!(files("crates").len(), list.lines().count());
    for line in list.lines() {
        let (name, _) = line.split_once(": ").unwrap();
        let texts = files(&format!("crates/{}", name.replace(' ', "-")));
        let bytes = |path: &PathBuf| std::fs::metadata(path).unwrap().len();
        assert!(texts.iter().any(|text| text.is_dir() || bytes(text) > 100), "{name}");
    }
    assert!(files("libtorch").len() >= 3 && files("rust").len() >= 2);
}

/// Has a tool check a file, where the tool is there; it finds nothing.
fn checked(tool: &[&str], file: &Path) {
    match Command::new(tool[0]).args(&tool[1..]).arg(file).output() {
        Ok(output) => {
            let words = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success() && words.is_empty(), "{}: {words}", file.display());
        }
        Err(_) => eprintln!("skipped: no {} to check {}", tool[0], file.display()),
    }
}

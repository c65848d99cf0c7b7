//! First use: `nerf-sr init`, a build without libtorch, and installed programs.

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

/// Returns a project without a pipeline file.
fn project_without_pipeline() -> Project {
    let project = Project::new("");
    std::fs::remove_file(project.path("pipeline.yaml")).unwrap();
    project
}

/// Parameters of a short training, which override those of the pipeline file.
const SHORT_TRAINING: [&str; 12] = [
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
fn pipelines_of_init_run_unchanged() {
    let project = project_without_pipeline();
    let demo = "Blender (transforms_train.json): 21 photographs".to_owned();
    let mut folders = vec![("data", demo, "downscaled")];
    for form in FORMS {
        (form.write)(&project);
        folders.push((form.name, format!("{}: 20 photographs", form.found), form.lr_source));
    }
    for (folder, found, lr_source) in folders {
        let pipeline = format!("of-{folder}/pipeline.yaml");
        std::fs::create_dir(project.path(&format!("of-{folder}"))).unwrap();
        let stdout = project.ok(&["--pipeline", &pipeline, "init", folder]);
        assert!(stdout.contains(&format!("found: {found} of {WIDTH}×{WIDTH}\n")), "{stdout}");
        assert!(
            stdout.contains(&format!("sizes: photographs {WIDTH}×{WIDTH}; training at")),
            "{stdout}"
        );
        let text = std::fs::read_to_string(project.path(&pipeline)).unwrap();
        assert!(text.contains(&format!("lr_source: {lr_source}")), "{text}");
        let run = [&["--pipeline", pipeline.as_str(), "run"][..], &SHORT_TRAINING].concat();
        let stdout = project.ok(&run);
        assert!(stdout.contains("eval: ") && stdout.contains("index.html"), "{stdout}");
        for target in ["refined", "video", "registered", "reference-refine", "hr-finetune"] {
            project.ok(&["--pipeline", &pipeline, "plan", target]);
        }
    }
}

/// Experiments run on the data set of `init`, also if the pipeline trains on the photographs.
#[test]
fn experiments_run_in_a_folder_of_init() {
    let project = project_without_pipeline();
    as_colmap(&project);
    let stdout = project.ok(&["init", "colmap"]);
    assert!(
        stdout.contains("wrote: pipeline.yaml, pipelines/ (") && stdout.contains("experiments/ (")
    );
    for name in
        ["quality", "ablation", "tradeoff", "refine-table", "refine-ablation", "paper-table"]
    {
        project.ok(&["plan", name]);
    }
    project.ok(&[&["run", "seeds", "-p", "train-ss.seed=1,2"][..], &SHORT_TRAINING].concat());
    let table = std::fs::read_to_string(project.path("out/seeds/table.md")).unwrap();
    assert_eq!(table.lines().filter(|line| line.starts_with("| ")).count(), 4, "{table}");
    project.run(&["plan", "quality", "--scene", "lego"]).fails(2, &["no scene lego", "--data"]);
    // A protocol downscales the photographs, whatever `lr_source` is.
    let prep_key = || {
        let nodes = project.nodes(&["quality", "--protocol", "24x2"]);
        nodes.into_iter().find(|node| node["stage"] == "prep").unwrap()["key"].clone()
    };
    let before = prep_key();
    project.replace("lr_source: photographs", "lr_source: null");
    assert_eq!(prep_key(), before);
}

/// A pipeline of `init` is also valid without the `#` before its commented parameters.
#[test]
fn commented_parameters_of_init_are_valid() {
    let project = project_without_pipeline();
    as_colmap(&project);
    project.ok(&["init", "colmap"]);
    let text = std::fs::read_to_string(project.path("pipeline.yaml")).unwrap();
    let prefix = "      # ";
    let parameters = text.lines().filter_map(|line| line.strip_prefix(prefix)).count();
    assert!(parameters >= 4, "{text}");
    std::fs::create_dir(project.path("weights")).unwrap();
    for file in ["squeezenet1_1.safetensors", "lpips_linear_squeeze_v0.1.safetensors"] {
        project.write(&format!("weights/{file}"), "");
    }
    project.write("pipeline.yaml", &text.replace(prefix, "      "));
    project.ok(&["plan"]);
}

#[test]
fn init_overwrites_nothing() {
    let project = project_without_pipeline();
    as_colmap(&project);
    project.write("pipelines/video.yaml", "mine");
    project.run(&["init", "colmap"]).fails(2, &["pipelines/video.yaml exists"]);
    assert!(!project.path("pipeline.yaml").exists(), "init wrote a part of its files");
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
fn init_refuses_unusable_folders() {
    let project = project_without_pipeline();
    as_colmap(&project);
    std::fs::create_dir(project.path("nothing")).unwrap();
    for folder in ["loose", "cameraless/images"] {
        std::fs::create_dir_all(project.path(folder)).unwrap();
        for name in ["a b.PNG", "c.png"] {
            let copy = project.path(&format!("{folder}/{name}"));
            std::fs::copy(project.path("colmap/images/r_0.png"), copy).unwrap();
        }
    }
    project.run(&["init", "nothing"]).fails(3, &["nothing: no data set; expected"]);
    project.run(&["init", "nowhere"]).fails(3, &["nowhere: no such folder"]);
    project
        .run(&["init", "loose"])
        .fails(3, &["loose: 2 images, but no cameras", "move them to 'loose/images'", "colmap"]);
    project
        .run(&["init", "cameraless"])
        .fails(3, &["cameraless: 2 images, but no cameras", "--image_path 'cameraless/images'"]);
    let inside = project.command(&["init", "."]).current_dir(project.path("colmap")).output();
    Finished::of(inside.unwrap()).fails(2, &["can't be inside the data set"]);
    project.run(&["plan"]).fails(2, &["pipeline.yaml: No such file", "`nerf-sr init DIR`"]);
    assert!(!project.path("pipelines").exists() && !project.path("colmap/.nerf-sr").exists());
}

/// A pipeline finds a data set with any name, in the pipeline's folder or next to this folder.
#[test]
fn data_sets_with_odd_names_are_found() {
    let project = project_without_pipeline();
    as_colmap(&project);
    for name in ["my photos", "Bäume: \"#1\"", "{rays}{dataset}", "-p", "it's", "yes/no"] {
        let (parent, data) = (project.path("home"), project.path(&format!("home/{name}")));
        std::fs::create_dir_all(data.parent().unwrap()).unwrap();
        std::fs::rename(project.path("colmap"), &data).unwrap();
        for (pipeline_folder, argument) in
            [(parent.clone(), format!("./{name}")), (parent.join("x"), format!("../{name}"))]
        {
            std::fs::create_dir_all(&pipeline_folder).unwrap();
            let verbs = [&["init", argument.as_str()][..], &["plan"], &["plan", "paper-table"]];
            for verb in verbs {
                let output = project.command(verb).current_dir(&pipeline_folder).output().unwrap();
                let finished = Finished::of(output);
                assert_eq!(finished.code, 0, "{name}: {}", finished.stderr);
            }
        }
        std::fs::rename(&data, project.path("colmap")).unwrap();
        std::fs::remove_dir_all(&parent).unwrap();
    }
}

/// Within ten seconds the runner reports that a silent stage is running. The stage works until this
/// report, or for one or two minutes.
#[test]
fn a_silent_stage_is_reported_as_running() {
    let project = Project::new("default: [quiet]\nstages:\n  quiet: {run: ./quiet}\n");
    let description = r#"{"name": "quiet", "version": "1", "code": "1", "summary": "Waits.",
        "parameters": {"type": "object"}, "inputs": {}, "output": {"kind": "text"}}"#;
    let work = "for i in $(seq 600); do [ -e seen ] && break; sleep 0.1; done
        while [ $1 != --output ]; do shift; done; mkdir $2; echo x > $2/x";
    let script =
        format!("#!/bin/sh\nif [ $1 = describe ]; then echo '{description}'; else {work}; fi\n");
    project.program("quiet", &script);
    let mut child = project.spawn(&["run"]);
    let mut lines = Vec::new();
    for line in BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok) {
        if line.starts_with("quiet: running for ") {
            project.write("seen", "");
        }
        lines.push(line);
    }
    assert_eq!(child.wait().unwrap().code(), Some(0), "{lines:?}");
    let first = lines.iter().find_map(|line| seconds_running(line));
    assert!(first.is_some_and(|seconds| (1..=10).contains(&seconds)), "{lines:?}");
}

fn seconds_running(line: &str) -> Option<u32> {
    let rest = line.strip_prefix("quiet: running for ")?;
    rest.split(|c: char| !c.is_ascii_digit()).next()?.parse().ok()
}

/// Returns the folder of the programs that `make demo` built without libtorch, if they are newer
/// than the sources.
fn programs_without_libtorch() -> Option<PathBuf> {
    let folder = root().join("target/without-libtorch");
    let built = modified(&folder.join("eval"));
    let sources = ["Cargo.lock", "Cargo.toml", ".cargo/config.toml"].map(|file| root().join(file));
    let entries = walkdir::WalkDir::new(root().join("stages")).into_iter().flatten();
    let files = entries.map(walkdir::DirEntry::into_path).filter(|path| path.is_file());
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

fn run_without_libtorch(programs: &Path, project: &Project, arguments: &[&str]) -> Finished {
    let mut command = Command::new(programs.join("nerf-sr"));
    command.args(arguments).current_dir(project.path(".")).env_remove("NERF_SR_STORE");
    Finished::of(command.output().unwrap())
}

/// A stage's builds with and without libtorch give equal keys and bytes: after `make demo`,
/// `make build` leaves the demo cached.
#[test]
fn builds_with_and_without_libtorch_write_equal_artifacts() {
    let Some(programs) = programs_without_libtorch() else { return };
    let project = Project::fast();
    let finished = run_without_libtorch(&programs, &project, &["run"]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    assert!(project.ok(&["run"]).contains("all 5 stages are cached"));
    let names = ["demo-scene", "prep", "train-ss", "render-depth", "eval"];
    let outputs = |store: &[&str]| names.map(|stage| project.output_of(stage, store));
    project.ok(&["--store", "other", "run"]);
    assert_eq!(outputs(&[]), outputs(&["--store", "other"]));
    // Options that need libtorch are refused, and the message names the build command.
    for file in ["squeezenet1_1.safetensors", "lpips_linear_squeeze_v0.1.safetensors"] {
        project.write(&format!("weights/{file}"), "");
    }
    for arguments in [
        &["run", "-i", "weights=weights"][..],
        &["run", "-p", "train-ss.field=mlp"],
        &["run", "--device", "cuda:0"],
    ] {
        run_without_libtorch(&programs, &project, arguments)
            .fails(2, &["libtorch", "run `make build`"]);
    }
    project.replace("default: [report]", "default: [refine]");
    project.replace("  eval:\n", "  refine:\n    inputs: {views: render-depth}\n  eval:\n");
    run_without_libtorch(&programs, &project, &["run"])
        .fails(2, &["pipeline.yaml:", "stage refine: ", "refine isn't built; run `make build`"]);
    assert_eq!(
        run_without_libtorch(&programs, &project, &["run", "eval"]).code,
        0,
        "targets without `refine` must run"
    );
}

fn run_without_environment(
    prefix: &Path,
    project: &Project,
    program: &str,
    arguments: &[&str],
) -> Finished {
    let mut command = Command::new(prefix.join(program));
    command.env_clear().args(arguments).current_dir(project.path("."));
    Finished::of(command.output().unwrap())
}

/// Installed programs run from any folder, with an empty environment.
#[test]
fn installed_programs_run_from_any_folder() {
    let project = Project::fast();
    let prefix = project.path("usr");
    if !installed::install(&prefix) {
        return;
    }
    let finished = run_without_environment(&prefix, &project, "bin/nerf-sr", &["run"]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    assert!(
        project.ok(&["run"]).contains("all 5 stages are cached"),
        "keys must not depend on the programs' folder"
    );
    // `refine` needs libtorch.
    let described = run_without_environment(&prefix, &project, "lib/nerf-sr/refine", &["describe"]);
    assert_eq!(described.code, 0, "{}", described.stderr);
    let assert_shared_file =
        |file: &str| assert!(prefix.join("share").join(file).is_file(), "{file}");
    let has_remote = bin("nerf-sr").with_file_name("nerf-sr-remote").exists();
    for name in ["nerf-sr"].into_iter().chain(has_remote.then_some("nerf-sr-remote")) {
        let version =
            run_without_environment(&prefix, &project, &format!("bin/{name}"), &["--version"]);
        assert_eq!(version.stdout, format!("{name} {}\n", env!("CARGO_PKG_VERSION")));
        assert_shared_file(&format!("bash-completion/completions/{name}"));
        assert_shared_file(&format!("zsh/site-functions/_{name}"));
        assert_shared_file(&format!("fish/vendor_completions.d/{name}.fish"));
        assert_shared_file(&format!("man/man1/{name}.1"));
    }
    assert_shared_file("man/man1/nerf-sr-run.1");
    check_file(&["bash", "-n"], &prefix.join("share/bash-completion/completions/nerf-sr"));
    check_file(
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
    assert!(!list.contains("\nproptest "), "only tests use proptest");
    assert_eq!(files("crates").len(), list.lines().count());
    for line in list.lines() {
        let (name, _) = line.split_once(": ").unwrap();
        let texts = files(&format!("crates/{}", name.replace(' ', "-")));
        let size = |path: &PathBuf| std::fs::metadata(path).unwrap().len();
        assert!(texts.iter().any(|text| text.is_dir() || size(text) > 100), "{name}");
    }
    assert!(files("libtorch").len() >= 3 && files("rust").len() >= 2);
}

/// Checks a file with a tool, if installed; the tool must succeed and print nothing to stderr.
fn check_file(tool: &[&str], file: &Path) {
    match Command::new(tool[0]).args(&tool[1..]).arg(file).output() {
        Ok(output) => {
            let stderr = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success() && stderr.is_empty(), "{}: {stderr}", file.display());
        }
        Err(_) => eprintln!("skipped: no {} to check {}", tool[0], file.display()),
    }
}

//! Messages for a new user: errors before anything runs, and progress.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::Path;

use common::{Project, demo_train, stage, stage_command};
use serde_json::{Value, json};

/// Creates a project with the stage `upsample`, and an empty folder for weights.
fn upsampling_project() -> Project {
    let project = Project::tiny();
    let blocks = "
  upsample:
    inputs: {views: render-depth, cameras: prep/cameras}
  eval-upsampled:
    extends: eval
    inputs: {views: upsample, truth: prep/truth}
";
    let text = std::fs::read_to_string(project.path("pipeline.yaml")).unwrap();
    project.write("pipeline.yaml", &(text + blocks));
    std::fs::create_dir(project.path("weights")).unwrap();
    project
}

/// Weights, scales and folders that a later stage can't use are reported before the first stage
/// runs.
#[test]
fn every_input_is_checked_before_anything_runs() {
    let project = upsampling_project();
    let weights = ["-i", "upsample.weights=weights"];
    for (arguments, code, words) in [
        (
            [&weights[..], &["-p", "method=imdn"]].concat(),
            3,
            &["upsample", "weights", "no file imdn_x2.safetensors"][..],
        ),
        ([&weights[..], &["-p", "method=liif"]].concat(), 3, &["no file liif.safetensors"]),
        (
            [&weights[..], &["-p", "method=swinir", "-p", "upsample.file=mine.st"]].concat(),
            3,
            &["no file mine.st"],
        ),
        (
            [&weights[..], &["-p", "method=imdn", "-p", "scale=5"]].concat(),
            2,
            &["imdn has networks for scales 2, 3, 4 only"],
        ),
        (vec!["-i", "eval.weights=weights"], 3, &["eval", "weights", "no LPIPS network found"]),
        (vec!["-i", "eval.weights=nowhere"], 3, &["nowhere", "no such folder"]),
    ] {
        let run = [&["run", "eval-upsampled"], &arguments[..]].concat();
        project.run(&run).fails(code, words);
        assert_eq!(project.store_listing(), Vec::<String>::new(), "{arguments:?}");
    }
}

/// `64k` means 64000 and gives an equal key.
#[test]
fn whole_numbers_may_have_a_suffix() {
    let project = Project::tiny();
    let keys = |arguments: &[&str]| -> Vec<Value> {
        let nodes = project.nodes(arguments);
        nodes.into_iter().map(|mut node| node["key"].take()).collect()
    };
    let expected = keys(&["-p", "demo-scene.seed=64000"]);
    assert_eq!(keys(&["-p", "demo-scene.seed=64k"]), expected);
    assert_ne!(keys(&["-p", "demo-scene.seed=65k"]), expected);
    project.run(&["plan", "-p", "train-ss.rays=30X"]).fails(2, &["\"30X\" is not a whole number"]);
}

/// Returns a node of a run's record that a sink displays.
fn node(project: &Project, stage: &str, kind: &str) -> Value {
    let folder = project.artifact(stage, &[]);
    json!({"stage": stage, "point": "", "is_shown": true, "program": stage, "kind": kind,
        "key": "k", "output": folder.file_name().unwrap().to_str().unwrap(), "folder": folder,
        "parameters": {}, "inputs": {}, "started_unix": 1_790_000_000, "seconds": 3.5,
        "threads": 2})
}

/// Runs a slowed stage alone and checks that progress is reported.
#[track_caller]
fn check_progress(project: &Project, name: &str, inputs: &[(&str, &Path)]) {
    let output = project.path(&format!("{name}.out"));
    let mut command = stage_command(name, "{}", inputs, &output, &["--progress", "json"]);
    command.env("NERF_SR_SLOW_UNTIL", format!("0 {}", project.path("never").display()));
    command.env("NERF_SR_STOP_AFTER", "2");
    let finished = common::Finished::of(command.output().unwrap());
    assert!(finished.stdout.contains(r#""event":"progress""#), "{name}: {}", finished.stderr);
}

#[test]
fn sinks_and_export_report_progress() {
    let project = Project::fast();
    project.ok(&["run"]);
    for (sink, kind, stage) in [
        ("report", "metrics", "eval"),
        ("table", "metrics", "eval"),
        ("video", "views", "render-depth"),
    ] {
        let run = project.path(&format!("{sink}.run"));
        std::fs::create_dir(&run).unwrap();
        let nodes: Vec<Value> = (0..4).map(|_| node(&project, stage, kind)).collect();
        let record = json!({"home": project.path("out"), "command": ["nerf-sr", "run"],
            "data_sets": ["demo-scene"], "nodes": nodes});
        std::fs::write(run.join("run.json"), record.to_string()).unwrap();
        check_progress(&project, sink, &[("run", &run)]);
    }
    let [field, scene] = ["train-ss", "prep"].map(|stage| project.artifact(stage, &[]));
    let cameras = scene.join("cameras");
    check_progress(&project, "export", &[("field", &field), ("cameras", &cameras)]);
}

/// Progress must describe its PSNR as one of training pixels, not of test views.
#[test]
fn progress_names_the_pixels_of_its_psnr() {
    let project = Project::tiny();
    let train = demo_train(&project, 6);
    let (inputs, field) = ([("scene", train.as_path())], project.path("field"));
    let parameters = r#"{"rays": 20000}"#;
    let training = stage("train-ss", parameters, &inputs, &field, &["--progress", "json"]);
    assert_eq!(training.code, 0, "{}", training.stderr);
    assert!(training.stdout.contains("PSNR of training pixels "), "{}", training.stdout);
}

/// `-i init=train-ss` is the field that the command trains without its parameters for `train-ss`.
#[test]
fn init_by_a_stages_name_fine_tunes_its_field() {
    let project = Project::tiny();
    let arguments =
        ["train-ss", "-i", "init=train-ss", "-p", "rays=2k", "-p", "combine=average_weights"];
    let message = "train-ss has no artifact yet; run it first";
    project.run(&[&["run"], &arguments[..]].concat()).fails(2, &[message]);
    project.ok(&["run", "train-ss"]);
    let initial = project.artifact("train-ss", &["train-ss"]);
    project.ok(&[&["run"], &arguments[..]].concat());
    let finetuned = project.artifact("train-ss", &arguments);
    let log = std::fs::read(finetuned.join("training.json")).unwrap();
    let log: Value = serde_json::from_slice(&log).unwrap();
    assert!(
        log["rays"].as_u64().is_some_and(|rays| rays < 10_000) && initial != finetuned,
        "{log}"
    );
}

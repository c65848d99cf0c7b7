//! Messages to a new user: problems before anything runs, and progress of every stage.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::Path;

use common::{Project, demo_train, stage, stage_command};
use serde_json::{Value, json};

/// A project whose photographs are enlarged by a network.
fn enlarging() -> Project {
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

/// Weights, scales and folders that a later stage can't use are known before the first stage runs.
#[test]
fn every_input_is_checked_before_anything_runs() {
    let project = enlarging();
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

/// `12k` is 12000, on the command line and in a file, and has its key.
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

/// A node of a run's record that a sink shows.
fn node(project: &Project, stage: &str, kind: &str) -> Value {
    let folder = project.artifact(stage, &[]);
    json!({"stage": stage, "point": "", "is_shown": true, "program": stage, "kind": kind,
        "key": "k", "output": folder.file_name().unwrap().to_str().unwrap(), "folder": folder,
        "parameters": {}, "inputs": {}, "started_unix": 1_790_000_000, "seconds": 3.5,
        "threads": 2})
}

/// Runs a stage by itself, slowed, until it has reported a percentage.
#[track_caller]
fn shows_a_percentage(project: &Project, name: &str, inputs: &[(&str, &Path)]) {
    let output = project.path(&format!("{name}.out"));
    let mut command = stage_command(name, "{}", inputs, &output, &["--progress", "json"]);
    command.env("NERF_SR_SLOW_UNTIL", format!("0 {}", project.path("never").display()));
    command.env("NERF_SR_STOP_AFTER", "2");
    let finished = common::Finished::of(command.output().unwrap());
    assert!(finished.stdout.contains(r#""event":"progress""#), "{name}: {}", finished.stderr);
}

#[test]
fn sinks_and_export_show_a_percentage() {
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
        shows_a_percentage(&project, sink, &[("run", &run)]);
    }
    let [field, scene] = ["train-ss", "prep"].map(|stage| project.artifact(stage, &[]));
    let cameras = scene.join("cameras");
    shows_a_percentage(&project, "export", &[("field", &field), ("cameras", &cameras)]);
}

/// A training's progress says what its PSNR is of: not of test views.
#[test]
fn progress_says_what_its_psnr_is_of() {
    let project = Project::tiny();
    let train = demo_train(&project, 6);
    let (inputs, field) = ([("scene", train.as_path())], project.path("field"));
    let parameters = r#"{"rays": 20000}"#;
    let training = stage("train-ss", parameters, &inputs, &field, &["--progress", "json"]);
    assert_eq!(training.code, 0, "{}", training.stderr);
    assert!(training.stdout.contains("PSNR of training pixels "), "{}", training.stdout);
}

/// `-i init=train-ss` is the field of the same command, without the parameters of `train-ss`.
#[test]
fn a_stages_name_continues_its_training() {
    let project = Project::tiny();
    let more =
        ["train-ss", "-i", "init=train-ss", "-p", "rays=2k", "-p", "combine=average_weights"];
    let words = "train-ss has no artifact yet; run it first";
    project.run(&[&["run"], &more[..]].concat()).fails(2, &[words]);
    project.ok(&["run", "train-ss"]);
    let first = project.artifact("train-ss", &["train-ss"]);
    project.ok(&[&["run"], &more[..]].concat());
    let second = project.artifact("train-ss", &more);
    let log = std::fs::read(second.join("training.json")).unwrap();
    let log: Value = serde_json::from_slice(&log).unwrap();
    assert!(log["rays"].as_u64().is_some_and(|rays| rays < 10_000) && first != second, "{log}");
}

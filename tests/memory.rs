//! Stages whose memory grows with a parameter log the memory that they need, and refuse to begin if
//! less is free.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::{Path, PathBuf};

use common::large::Small;
use common::{Finished, stage_command};
use serde_json::json;

/// Stage, parameters, inputs, and the message if 100 MB are free.
type Case = (&'static str, &'static str, &'static [(&'static str, &'static str)], &'static str);

const CASES: [Case; 3] = [
    (
        "demo-scene",
        r#"{"size": 2048, "aspect": 0.25}"#,
        &[],
        "rendering needs 536.9 MB of memory, and 100.0 MB are free; choose a smaller size, or end \
        other programs",
    ),
    (
        "export",
        r#"{"resolution": 512}"#,
        &[("field", "field"), ("cameras", "scene/train-cameras")],
        "MB of memory, and 100.0 MB are free; choose a smaller resolution or size, or end other \
        programs",
    ),
    (
        "viewer",
        r#"{"resolution": 512}"#,
        &[("run", "field-run")],
        "baking needs 2.1 GB of memory, and 100.0 MB are free; choose a smaller resolution, or end other programs",
    ),
];

#[test]
fn work_larger_than_memory_is_refused_before_it_begins() {
    let small = Small::new();
    let scene = json!({"scene": {"folder": small.path("scene/train")}});
    small.record("field-run", &[small.node("train-ss", "field", "field", &scene)]);
    for (name, params, inputs, message) in CASES {
        let folders: Vec<(&str, PathBuf)> =
            inputs.iter().map(|(input, folder)| (*input, small.path(folder))).collect();
        let inputs: Vec<(&str, &Path)> =
            folders.iter().map(|(input, folder)| (*input, folder.as_path())).collect();
        let output = small.path("out");
        let mut command = stage_command(name, params, &inputs, &output, &["--threads", "2"]);
        let finished = Finished::of(command.env("NERF_SR_MEMORY", "100000000").output().unwrap());
        finished.fails(2, &[name, message]);
        assert!(!output.exists());
    }
}

#[test]
fn large_memory_use_is_logged() {
    let folder = tempfile::tempdir().unwrap();
    let (params, output) = (r#"{"size": 2048, "aspect": 0.25}"#, folder.path().join("out"));
    let options = ["--threads", "4", "--progress", "plain"];
    let mut command = stage_command("demo-scene", params, &[], &output, &options);
    let stopped = Finished::of(command.env("NERF_SR_STOP_AFTER", "1").output().unwrap());
    stopped.fails(130, &["demo-scene: interrupted"]);
    assert!(stopped.stderr.contains("memory: about 1.1 GB for rendering"), "{}", stopped.stderr);
}

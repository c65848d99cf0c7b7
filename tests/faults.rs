//! Kills at any moment: finished artifacts stay complete, unfinished actions resume, and the bytes
//! are equal.

#![allow(missing_docs, reason = "a test")]
mod common;

use common::{
    Finished, Project, checkpoints, demo_train, kill_again_and_again, last_checkpoint, manifest,
    signal, stage, stage_command, wait_until,
};

/// Parameters of a training with several checkpoints, the first after a second, that contain all
/// optional state.
const PARAMS: &str = r#"{"supervision": "kernel", "exposure": true, "pose_refinement": true, "ensemble": 2, "rays": 200000, "n_levels": 4, "cells_per_pixel": 1.28, "log2_hashmap_size": 12, "hidden_dim": 16, "march_steps": 256, "max_rays_per_step": 2048, "samples_per_step": 16384}"#;
/// Progress, in rays, at which the second member is being trained. The first member's rays count
/// twice, since given and refined poses are compared.
const SLOW_FROM: u64 = 240_000;

#[test]
fn training_killed_at_any_moment_ends_in_the_same_bytes() {
    let project = Project::tiny();
    let train = demo_train(&project, 8);
    let inputs = [("scene", train.as_path())];
    let expected = project.path("whole");
    assert_eq!(stage("train-ss", PARAMS, &inputs, &expected, &[]).code, 0);

    let (output, work) = (project.path("killed"), project.path("work"));
    let more = ["--work", work.to_str().unwrap()];
    kill_again_and_again(
        "train-ss",
        PARAMS,
        &inputs,
        &output,
        &work,
        SLOW_FROM,
        &[100, 0, 300, 20, 700],
    );
    let finished = stage("train-ss", PARAMS, &inputs, &output, &more);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    assert_eq!(manifest(&output), manifest(&expected));
}

#[test]
fn an_interrupted_stage_leaves_a_checkpoint_and_exits_with_130() {
    let project = Project::tiny();
    let train = demo_train(&project, 8);
    let inputs = [("scene", train.as_path())];
    let (output, work) = (project.path("out"), project.path("work"));
    let more = ["--work", work.to_str().unwrap(), "--progress", "plain"];
    let stopped = stage_command("train-ss", PARAMS, &inputs, &output, &more)
        .env("NERF_SR_STOP_AFTER", "20000")
        .output()
        .unwrap();
    let finished = Finished::of(stopped);
    assert_eq!(finished.code, 130, "{}", finished.stderr);
    assert!(finished.stderr.contains("interrupted; run again to resume"), "{}", finished.stderr);
    let checkpoint = checkpoints(&work).pop().expect("no checkpoint");
    assert!(!output.exists());
    // A truncated checkpoint is reported and skipped.
    let bytes = std::fs::read(&checkpoint).unwrap();
    std::fs::write(&checkpoint, &bytes[..bytes.len() / 2]).unwrap();
    let restarted = stage("train-ss", PARAMS, &inputs, &output, &more);
    assert_eq!(restarted.code, 0, "{}", restarted.stderr);
    assert!(
        restarted.stderr.contains("checkpoint.safetensors: incomplete checkpoint; starting over"),
        "{}",
        restarted.stderr
    );
    let expected = project.path("whole");
    assert_eq!(stage("train-ss", PARAMS, &inputs, &expected, &[]).code, 0);
    assert_eq!(manifest(&output), manifest(&expected));
}

/// Starts a run, and sends a signal after a condition has become true.
fn run_and_signal(project: &Project, name: &str, mut condition: impl FnMut() -> bool) -> Finished {
    let mut child = project.spawn(&["run"]);
    wait_until(|| condition() || child.try_wait().unwrap().is_some());
    signal(&child, name);
    Finished::of(child.wait_with_output().unwrap())
}

#[test]
fn a_killed_or_interrupted_runner_resumes() {
    let project = Project::tiny();
    project.replace("rays: 60000", "rays: 1500000");
    // The first run is killed after a stage has begun, the second interrupted during training.
    let partial = project.path(".nerf-sr/partial");
    let has_begun = || partial.read_dir().is_ok_and(|mut entries| entries.next().is_some());
    let killed = run_and_signal(&project, "-KILL", has_begun);
    assert_eq!(killed.code, -1, "the kill came too late: {}", killed.stderr);
    let interrupted = run_and_signal(&project, "-INT", || last_checkpoint(&partial).is_some());
    let log = interrupted.stderr;
    assert!(interrupted.code == 130 && log.contains("interrupted"), "{log}");
    let status = project.ok(&["status"]);
    assert!(status.contains("has a checkpoint to resume from"), "{status}{log}");
    let last = project.run(&["run"]);
    assert_eq!(last.code, 0, "{}", last.stderr);
    assert!(last.stderr.contains("resuming from step"), "{}", last.stderr);
    assert!(project.ok(&["verify"]).contains("5 artifacts, 0 damaged"));
    let undisturbed =
        Project::new(&std::fs::read_to_string(project.path("pipeline.yaml")).unwrap());
    undisturbed.ok(&["run"]);
    assert_eq!(project.output_of("eval", &[]), undisturbed.output_of("eval", &[]));
}

#[test]
fn stages_with_truncated_records_run_again() {
    let project = Project::tiny();
    project.ok(&["run"]);
    let actions = project.path(".nerf-sr/actions");
    for entry in std::fs::read_dir(&actions).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "json") {
            let bytes = std::fs::read(&path).unwrap();
            std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        }
    }
    assert!(project.ok(&["run"]).contains("5 of 5 stages ran"));
}

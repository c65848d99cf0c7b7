//! Kills at any moment: what was finished stays whole, what wasn't goes on, and the bytes come out
//! equal.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::process::Stdio;
use std::time::Duration;

use common::{
    Finished, Project, checkpoints, demo_train, kill_again_and_again, last_checkpoint, manifest,
    signal, stage, stage_command, wait_until,
};

/// Long enough for several checkpoints, the first after about a second; with all that a checkpoint
/// may hold.
const PARAMS: &str = r#"{"supervision": "kernel", "exposure": true, "pose_refinement": true, "ensemble": 2, "rays": 300000, "n_levels": 4, "max_resolution": 64, "log2_hashmap_size": 12, "hidden_dim": 16, "march_steps": 256, "max_rays_per_step": 2048, "samples_per_step": 16384}"#;

#[test]
fn training_killed_at_any_moment_ends_in_the_same_bytes() {
    let project = Project::tiny();
    let train = demo_train(&project, 8);
    let inputs = [("scene", train.as_path())];
    let whole = project.path("whole");
    assert_eq!(stage("train-ss", PARAMS, &inputs, &whole, &[]).code, 0);

    let (output, work) = (project.path("killed"), project.path("work"));
    let more = ["--work", work.to_str().unwrap()];
    let resumed =
        kill_again_and_again("train-ss", PARAMS, &inputs, &output, &work, &[100, 0, 300, 20, 700]);
    assert!(resumed > 0, "no kill came after a checkpoint; lengthen the training");
    if !output.exists() {
        let finished = stage("train-ss", PARAMS, &inputs, &output, &more);
        assert_eq!(finished.code, 0, "{}", finished.stderr);
    }
    assert_eq!(manifest(&output), manifest(&whole));
}

#[test]
fn an_interrupted_stage_leaves_a_checkpoint_and_says_130() {
    let project = Project::tiny();
    let train = demo_train(&project, 8);
    let inputs = [("scene", train.as_path())];
    let (output, work) = (project.path("out"), project.path("work"));
    let more = ["--work", work.to_str().unwrap()];
    let child = stage_command("train-ss", PARAMS, &inputs, &output, &more)
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // Its folder is made just before the first step.
    wait_until(|| work.join("member-0").is_dir());
    std::thread::sleep(Duration::from_millis(100));
    signal(&child, "-TERM");
    let finished = Finished::of(child.wait_with_output().unwrap());
    assert_eq!(finished.code, 130, "{}", finished.stderr);
    assert!(
        finished.stderr.contains("interrupted; run again to go on from here"),
        "{}",
        finished.stderr
    );
    let checkpoint = checkpoints(&work).pop().expect("it left a checkpoint");
    assert!(!output.exists());
    // A checkpoint cut short is said and left out, not trusted.
    let bytes = std::fs::read(&checkpoint).unwrap();
    std::fs::write(&checkpoint, &bytes[..bytes.len() / 2]).unwrap();
    assert_eq!(stage("train-ss", PARAMS, &inputs, &output, &more).code, 0);
    let whole = project.path("whole");
    assert_eq!(stage("train-ss", PARAMS, &inputs, &whole, &[]).code, 0);
    assert_eq!(manifest(&output), manifest(&whole));
}

#[test]
fn a_runner_killed_or_interrupted_goes_on() {
    let project = Project::tiny();
    project.replace("rays: 60000", "rays: 1500000");
    let spawn =
        || project.command(&["run"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    for (name, milliseconds) in [("-KILL", 150), ("-KILL", 900), ("-INT", 1200)] {
        let child = spawn();
        std::thread::sleep(Duration::from_millis(milliseconds));
        // However slow the machine is just now, the interruption comes while something is being
        // trained.
        wait_until(|| {
            name != "-INT" || last_checkpoint(&project.path(".nerf-sr/partial")).is_some()
        });
        signal(&child, name);
        let finished = Finished::of(child.wait_with_output().unwrap());
        if name == "-INT" {
            assert_eq!(finished.code, 130, "{}", finished.stderr);
            assert!(finished.stderr.contains("interrupted"), "{}", finished.stderr);
            let status = project.ok(&["status"]);
            assert!(
                status.contains("has a checkpoint to go on from"),
                "{status}{}",
                finished.stderr
            );
        }
    }
    let last = project.run(&["run"]);
    assert_eq!(last.code, 0, "{}", last.stderr);
    assert!(last.stderr.contains("going on from step"), "{}", last.stderr);
    assert!(project.ok(&["verify"]).contains("5 artifacts, 0 damaged"));
    let undisturbed =
        Project::new(&std::fs::read_to_string(project.path("pipeline.yaml")).unwrap());
    undisturbed.ok(&["run"]);
    assert_eq!(project.output_of("eval", &[]), undisturbed.output_of("eval", &[]));
}

#[test]
fn a_record_that_was_cut_short_is_made_again() {
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

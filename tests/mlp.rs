//! The paper's field in the stages, at a small size: equal bytes, checkpoints, collapse, errors.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::Path;

use common::{Finished, Project, demo_train, manifest, stage, stage_command};
use pixels::Image;

/// Parameters of a small version of the paper's field, trained long enough to be interrupted.
const PARAMS: &str = r#"{"field": "mlp", "hidden_dim": 16, "layers": 5, "coarse_samples": 8,
    "fine_samples": 8, "max_rays_per_step": 128, "rays": 20000, "precrop_steps": 20}"#;

/// Returns a folder's only view, over white.
fn single_image(views: &Path) -> Image {
    let files: Vec<_> = views.join("images").read_dir().unwrap().map(Result::unwrap).collect();
    assert_eq!(files.len(), 1, "{files:?}");
    let image = pixels::read_premultiplied(&files[0].path()).unwrap().over(1.0);
    assert_eq!((image.width, image.height), (48, 48));
    image
}

fn weights(folder: &Path, member: u32) -> Option<Vec<u8>> {
    std::fs::read(folder.join(format!("field-{member}.safetensors"))).ok()
}

/// Training writes equal bytes at one and two threads, and after an interruption.
#[test]
fn threads_and_interruptions_leave_bytes_unchanged() {
    let project = Project::tiny();
    let train = demo_train(&project, 6);
    let inputs = [("scene", train.as_path())];
    let [one_thread, two_threads, stopped, work] =
        ["one", "two", "stopped", "work"].map(|name| project.path(name));
    assert_eq!(stage("train-ss", PARAMS, &inputs, &one_thread, &["--threads", "1"]).code, 0);
    assert_eq!(stage("train-ss", PARAMS, &inputs, &two_threads, &["--threads", "2"]).code, 0);
    assert_eq!(manifest(&one_thread), manifest(&two_threads));

    let arguments = ["--work", work.to_str().unwrap(), "--progress", "plain"];
    let interrupted = stage_command("train-ss", PARAMS, &inputs, &stopped, &arguments)
        .env("NERF_SR_STOP_AFTER", "10000")
        .output()
        .unwrap();
    assert_eq!(interrupted.status.code(), Some(130));
    assert!(!stopped.exists() && work.join("member-0/checkpoint.safetensors").exists());
    let resumed = stage("train-ss", PARAMS, &inputs, &stopped, &arguments);
    assert_eq!(resumed.code, 0, "{}", resumed.stderr);
    assert!(resumed.stderr.contains("resuming from step "), "{}", resumed.stderr);
    assert_eq!(manifest(&one_thread), manifest(&stopped));

    // A fine-tuned field is written next to the initial one, or as the mean of both.
    let (ensemble, averaged) = (project.path("beside"), project.path("averaged"));
    let inputs = [("scene", train.as_path()), ("init", one_thread.as_path())];
    let fine_tuning_params = PARAMS.replace("20000", "2000");
    assert_eq!(stage("train-ss", &fine_tuning_params, &inputs, &ensemble, &[]).code, 0);
    assert_eq!(
        stage(
            "train-ss",
            &fine_tuning_params.replace('{', r#"{"combine": "average_weights", "#),
            &inputs,
            &averaged,
            &[]
        )
        .code,
        0
    );
    let [initial, fine_tuned, mean] =
        [weights(&one_thread, 0), weights(&ensemble, 1), weights(&averaged, 0)];
    assert!(weights(&ensemble, 0) == initial && weights(&averaged, 1).is_none());
    assert!(initial != fine_tuned && initial != mean && fine_tuned != mean);

    // `render-depth` renders this field without a parameter for its kind.
    let (cameras, views) = (project.path("scene/cameras"), project.path("views"));
    let rendered =
        stage("render-depth", "{}", &[("field", &one_thread), ("cameras", &cameras)], &views, &[]);
    assert_eq!(rendered.code, 0, "{}", rendered.stderr);
    // The short training reaches 10.9 dB; an all-white image has 9.2.
    let psnr = eval::psnr(&single_image(&views), &single_image(&project.path("scene/truth")));
    assert!(psnr > 10.0, "{psnr} dB");
}

fn train_at_high_rate(project: &Project, train: &Path, seed: u64) -> Finished {
    let params = PARAMS.replace(
        r#""max_rays_per_step": 128, "rays": 20000, "precrop_steps": 20"#,
        &format!(
            r#""rays": 4000, "precrop_steps": 0, "learning_rate": 0.03, "seed": {seed},
            "max_rays_per_step": 16"#
        ),
    );
    stage("train-ss", &params, &[("scene", train)], &project.path("trained"), &[])
}

/// At a high learning rate the network collapses for some seeds, and the stage reports this.
#[test]
fn a_collapse_is_reported() {
    let project = Project::tiny();
    let train = demo_train(&project, 6);
    let collapsed = (0..20)
        .map(|seed| train_at_high_rate(&project, &train, seed))
        .find(|finished| finished.code != 0);
    collapsed
        .expect("some seed collapses")
        .fails(4, &["network has collapsed", "try another seed"]);
}

#[test]
fn wrong_arguments_give_one_line_errors() {
    let project = Project::tiny();
    let train = demo_train(&project, 6);
    let out = project.path("out");
    let inputs = [("scene", train.as_path())];
    stage("train-ss", PARAMS, &inputs, &out, &["--device", "cuda:99"])
        .fails(2, &["--device cuda:99"]);
    stage("train-ss", PARAMS, &inputs, &out, &["--device", "gpu"])
        .fails(2, &["--device gpu", "cuda:N"]);
    stage("train-ss", "{}", &inputs, &out, &["--device", "cuda:99"])
        .fails(2, &["--device cuda:99"]);
    let on_gpu = stage("train-ss", r#"{"rays": 1000}"#, &inputs, &out, &["--device", "cuda:0"]);
    if on_gpu.code != 0 {
        on_gpu.fails(2, &["--device cuda:0", "omit --device"]);
    }
    stage("train-ss", r#"{"field": "mlp", "n_levels": 4}"#, &inputs, &out, &[])
        .fails(2, &["parameter n_levels", "belongs to field: grid"]);
    stage("train-ss", r#"{"fine_samples": 8}"#, &inputs, &out, &[])
        .fails(2, &["parameter fine_samples", "belongs to field: mlp"]);
}

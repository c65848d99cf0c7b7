//! The paper's own field through the stages, small: bytes, checkpoints, collapse, errors.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::Path;

use common::{Finished, Project, demo_train, manifest, stage, stage_command};
use pixels::Image;

/// All of the published shape, in miniature; long enough to be stopped on the way.
const PARAMS: &str = r#"{"field": "mlp", "hidden_dim": 16, "layers": 5, "coarse_samples": 8,
    "fine_samples": 8, "max_rays_per_step": 128, "rays": 20000, "precrop_steps": 20}"#;

/// The only view of a folder over white.
fn only_picture(views: &Path) -> Image {
    let files: Vec<_> = views.join("images").read_dir().unwrap().map(Result::unwrap).collect();
    assert_eq!(files.len(), 1, "{files:?}");
    let picture = pixels::read_premultiplied(&files[0].path()).unwrap().over(1.0);
    assert_eq!((picture.width, picture.height), (48, 48));
    picture
}

fn weights(folder: &Path, member: u32) -> Option<Vec<u8>> {
    std::fs::read(folder.join(format!("field-{member}.safetensors"))).ok()
}

/// Equal bytes at one and two threads, and after an interruption.
#[test]
fn trains_to_the_same_bytes_however_it_is_run() {
    let project = Project::tiny();
    let train = demo_train(&project, 6);
    let inputs = [("scene", train.as_path())];
    let [one, two, stopped, work] =
        ["one", "two", "stopped", "work"].map(|name| project.path(name));
    assert_eq!(stage("train-ss", PARAMS, &inputs, &one, &["--threads", "1"]).code, 0);
    assert_eq!(stage("train-ss", PARAMS, &inputs, &two, &["--threads", "2"]).code, 0);
    assert_eq!(manifest(&one), manifest(&two));

    let more = ["--work", work.to_str().unwrap()];
    let half_way = stage_command("train-ss", PARAMS, &inputs, &stopped, &more)
        .env("NERF_SR_STOP_AFTER", "10000")
        .output()
        .unwrap();
    assert_eq!(half_way.status.code(), Some(130));
    assert!(!stopped.exists() && work.join("member-0/checkpoint.safetensors").exists());
    assert_eq!(stage("train-ss", PARAMS, &inputs, &stopped, &more).code, 0);
    assert_eq!(manifest(&one), manifest(&stopped));

    // A field initialised from it is written next to it, or their mean is.
    let (beside, averaged) = (project.path("beside"), project.path("averaged"));
    let inputs = [("scene", train.as_path()), ("init", one.as_path())];
    let on = PARAMS.replace("20000", "2000");
    assert_eq!(stage("train-ss", &on, &inputs, &beside, &[]).code, 0);
    assert_eq!(
        stage(
            "train-ss",
            &on.replace('{', r#"{"combine": "average_weights", "#),
            &inputs,
            &averaged,
            &[]
        )
        .code,
        0
    );
    let [initial, trained, mean] = [weights(&one, 0), weights(&beside, 1), weights(&averaged, 0)];
    assert!(weights(&beside, 0) == initial && weights(&averaged, 1).is_none());
    assert!(initial != trained && initial != mean && trained != mean);

    // `render-depth` doesn't know which field it has.
    let (cameras, views) = (project.path("scene/cameras"), project.path("views"));
    let rendered =
        stage("render-depth", "{}", &[("field", &one), ("cameras", &cameras)], &views, &[]);
    assert_eq!(rendered.code, 0, "{}", rendered.stderr);
    // The short training has 10.9 dB; an all-white image has 9.2.
    let psnr = eval::psnr(&only_picture(&views), &only_picture(&project.path("scene/truth")));
    assert!(psnr > 10.0, "{psnr} dB");
}

fn trained(project: &Project, train: &Path, seed: u64) -> Finished {
    let params = PARAMS.replace(
        r#""max_rays_per_step": 128, "rays": 20000, "precrop_steps": 20"#,
        &format!(
            r#""rays": 4000, "precrop_steps": 0, "learning_rate": 0.03, "seed": {seed},
            "max_rays_per_step": 16"#
        ),
    );
    stage("train-ss", &params, &[("scene", train)], &project.path("trained"), &[])
}

/// A high rate kills a network under some seeds, and the stage says so.
#[test]
fn a_collapse_is_told() {
    let project = Project::tiny();
    let train = demo_train(&project, 6);
    let collapsed = (0..20).map(|seed| trained(&project, &train, seed)).find(|one| one.code != 0);
    collapsed
        .expect("some seed collapses")
        .fails(4, &["network has collapsed", "try another seed"]);
}

#[test]
fn mistakes_are_one_line() {
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

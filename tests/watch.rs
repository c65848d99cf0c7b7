//! A running training is rendered from its checkpoints (`--from-checkpoint`, `--watch`), and its
//! result stays equal.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::Path;
use std::process::Command;

use common::{Finished, Project, demo_train, manifest, stage, stage_command};
use serde_json::json;

const PARAMETERS: &str = r#"{"rays": 60000, "n_levels": 4, "cells_per_pixel": 1.28, "log2_hashmap_size": 12,
    "hidden_dim": 16, "march_steps": 128, "max_rays_per_step": 2048, "samples_per_step": 16384}"#;

/// Returns the command of a training with checkpoints.
fn training_command(project: &Project, scene: &Path, output: &str, more: &[&str]) -> Command {
    let work = project.path("work");
    let arguments = [&["--work", work.to_str().unwrap()], more].concat();
    stage_command("train-ss", PARAMETERS, &[("scene", scene)], &project.path(output), &arguments)
}

fn run_training(project: &Project, scene: &Path, output: &str, more: &[&str]) -> Finished {
    Finished::of(training_command(project, scene, output, more).output().unwrap())
}

/// The latest checkpoint of a stopped training becomes a field that can be rendered; the training
/// resumes to equal bytes.
#[test]
fn a_checkpoint_becomes_a_field() {
    let project = Project::tiny();
    let scene = demo_train(&project, 8);
    let (work, uninterrupted) = (project.path("work"), project.path("whole"));
    let work_folder = work.to_str().unwrap().to_owned();
    run_training(&project, &scene, "early", &["--from-checkpoint"])
        .fails(3, &["--work", "no complete checkpoint"]);
    assert!(!project.path("early").exists());

    let stopped = training_command(&project, &scene, "stopped", &[])
        .env("NERF_SR_STOP_AFTER", "30000")
        .output()
        .unwrap();
    assert_eq!(Finished::of(stopped).code, 130);
    let finished = run_training(&project, &scene, "field", &["--from-checkpoint"]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    let training = std::fs::read(project.path("field/training.json")).unwrap();
    let training: serde_json::Value = serde_json::from_slice(&training).unwrap();
    let rays = training["rays"].as_u64().unwrap();
    // The last step reaches the count; a step has at most `max_rays_per_step`.
    assert!((30_000..30_000 + 2_048).contains(&rays), "{rays} rays");
    let cameras = project.path("scene/cameras");
    let inputs = [("field", project.path("field")), ("cameras", cameras)];
    let inputs = inputs.each_ref().map(|(name, folder)| (*name, folder.as_path()));
    let rendered = stage("render-depth", r#"{"size": 8}"#, &inputs, &project.path("views"), &[]);
    assert_eq!(rendered.code, 0, "{}", rendered.stderr);

    assert_eq!(run_training(&project, &scene, "resumed", &[]).code, 0);
    let finished = stage("train-ss", PARAMETERS, &[("scene", &scene)], &uninterrupted, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    assert_eq!(manifest(&uninterrupted), manifest(&project.path("resumed")));

    // A stage without checkpoints refuses the option.
    let arguments = ["--work", &work_folder, "--from-checkpoint"];
    let finished = stage("demo-scene", "{}", &[], &project.path("no"), &arguments);
    finished.fails(2, &["--from-checkpoint: stage demo-scene doesn't support this option"]);
}

const RAYS: [&str; 2] = ["-p", "train-ss.rays=600000"];
/// Number of rays after which the training slows down until the first look, because looks may take
/// only a fiftieth of the time.
const SLOW_FROM_RAYS: &str = "300000";

fn psnr(look: &str) -> f64 {
    let (_, rest) = look.split_once("PSNR ").unwrap();
    rest.split_whitespace().next().unwrap().parse::<f64>().unwrap()
}

/// Returns the maximum difference of a look's PSNR from the final one, in dB. Measured: 17.9 after
/// 26,000 rays, 20.8 after 73,000, 21.5 after 314,000, finally 21.6. Slow machines look early.
fn max_difference(look: &str) -> f64 {
    let (_, rest) = look.split_once(" view (").unwrap();
    let rays = rest.split_whitespace().next().unwrap().replace(',', "");
    if rays.parse::<u64>().unwrap() < 70_000 { 8.0 } else { 1.5 }
}

#[test]
fn a_watched_training_reports_scores_and_gives_equal_bytes() {
    let project = Project::tiny();
    let arguments = [&["run", "eval"], RAYS.as_slice()].concat();
    project.ok(&["run", "prep"]);
    let views = project.json("prep", "truth/views.json", &[]);
    let view_name = views["views"][1]["camera"]["name"].as_str().unwrap().to_owned();
    let watch = format!("--watch={view_name}");
    let picture = project.path("out/watch/train-ss.png");
    let mut command = project.command(&[arguments.as_slice(), &[watch.as_str()]].concat());
    command.env("NERF_SR_SLOW_UNTIL", format!("{SLOW_FROM_RAYS} {}", picture.display()));
    let watched = Finished::of(command.output().unwrap());
    assert_eq!(watched.code, 0, "{}", watched.stderr);
    let prefix = format!("train-ss: view {view_name}: ");
    let looks: Vec<&str> = watched.stderr.lines().filter(|l| l.starts_with(&prefix)).collect();
    assert!(!looks.is_empty(), "no look in:\n{}", watched.stderr);
    let last = looks[looks.len() - 1];
    assert!(looks[0].ends_with("out/watch/train-ss.png"), "{looks:?}");
    let image = pixels::read_png(&picture).unwrap();
    assert_eq!((image.width, image.height), (48, 48));
    assert_eq!(std::fs::read_dir(project.path(".nerf-sr/sinks")).map_or(0, Iterator::count), 0);

    // The last look is near the final PSNR, and the bytes equal those of an unwatched training.
    let scores = project.json("eval", "metrics.json", &RAYS);
    let is_watched = |view: &&serde_json::Value| view["name"] == json!(view_name);
    let view = scores["views"].as_array().unwrap().iter().find(is_watched).unwrap();
    let final_psnr = view["scores"]["psnr"].as_f64().unwrap();
    assert!(
        (final_psnr - psnr(last)).abs() < max_difference(last),
        "final PSNR {final_psnr} dB; {last}"
    );
    let watched_output = project.output_of("train-ss", &RAYS);
    let unwatched = Project::tiny();
    unwatched.ok(&arguments);
    assert_eq!(watched_output, unwatched.output_of("train-ss", &RAYS));
}

#[test]
fn a_run_continues_if_its_training_cannot_be_watched() {
    let project = Project::tiny();
    let unscored = project.run(&["run", "train-ss", "--watch"]);
    assert_eq!(unscored.code, 0, "{}", unscored.stderr);
    assert!(unscored.stderr.contains("train-ss: not watched: no stage of this run can score"));
    let unknown = project.run(&["run", "eval", "-p", "train-ss.seed=2", "--watch=nowhere"]);
    assert_eq!(unknown.code, 0, "{}", unknown.stderr);
    let line = unknown.stderr.lines().find(|line| line.contains("not watched")).unwrap();
    assert!(line.starts_with("train-ss: not watched: no view nowhere; known: r_0"), "{line}");
    let slurm = project.run(&["run", "--executor", "slurm", "--watch"]);
    slurm.fails(2, &["--watch", "--executor local"]);
}

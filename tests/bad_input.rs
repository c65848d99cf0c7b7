//! Bad input causes a one-line error with cause and location, an exit code by kind, and no partial
//! files in the store.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::Path;

use common::{Project, TINY, stage};

/// Generates a small data set, which a test then damages.
fn dataset(project: &Project) -> std::path::PathBuf {
    let folder = project.path("data");
    let finished = stage(
        "demo-scene",
        r#"{"size": 32, "train": 4, "test": 2, "samples_per_axis": 1}"#,
        &[],
        &folder,
        &[],
    );
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    std::fs::remove_file(folder.join("artifact.json")).unwrap();
    folder
}

const PREP_PIPELINE: &str = "
default: [prep]
stages:
  prep:
    inputs: {dataset: ./data}
    parameters: {lr_width: 16, scale: 2}
";

/// Damages a data set, runs `prep` and asserts an error and an empty store.
#[track_caller]
fn assert_refused(
    damage: impl FnOnce(&Project, &Path),
    arguments: &[&str],
    code: i32,
    texts: &[&str],
) {
    let project = Project::new(PREP_PIPELINE);
    let folder = dataset(&project);
    damage(&project, &folder);
    project.run(&[&["run"], arguments].concat()).fails(code, texts);
    assert_eq!(project.store_listing(), Vec::<String>::new(), "the store isn't empty");
}

fn edit(file: &Path, from: &str, to: &str) {
    let text = std::fs::read_to_string(file).unwrap();
    assert!(text.contains(from), "{text}");
    std::fs::write(file, text.replacen(from, to, 1)).unwrap();
}

fn first_matrix_number(folder: &Path) -> String {
    let text = std::fs::read_to_string(folder.join("transforms_train.json")).unwrap();
    let start = text.find("\"transform_matrix\"").unwrap();
    let rest = &text[start..];
    rest[rest.find(|c: char| c.is_ascii_digit() || c == '-').unwrap()..]
        .split(',')
        .next()
        .unwrap()
        .trim()
        .to_owned()
}

#[test]
fn unusable_datasets_are_refused() {
    assert_refused(
        |_, d| std::fs::remove_dir_all(d).unwrap(),
        &[],
        3,
        &["input dataset", "data", "no such folder; name an existing one"],
    );
    assert_refused(
        |_, d| std::fs::remove_file(d.join("transforms_test.json")).unwrap(),
        &["-p", "split=given"],
        2,
        &["parameter split", "choose holdout or paper"],
    );
    assert_refused(
        |_, d| std::fs::remove_file(d.join("train/r_2.png")).unwrap(),
        &[],
        3,
        &["transforms_train.json: frame 2", "r_2.png not found"],
    );
    assert_refused(
        |_, d| {
            let png = std::fs::read(d.join("train/r_1.png")).unwrap();
            std::fs::write(d.join("train/r_1.png"), &png[..png.len() / 2]).unwrap();
        },
        &[],
        3,
        &["frame r_1", "train/r_1.png", "incomplete or damaged image"],
    );
    assert_refused(
        |_, d| edit(&d.join("transforms_train.json"), &first_matrix_number(d), "NaN"),
        &[],
        3,
        &["transforms_train.json: frame 0", "is NaN"],
    );
    assert_refused(
        |_, d| edit(&d.join("transforms_test.json"), "0.6911112", "3.2"),
        &[],
        3,
        &["camera_angle_x is 3.2", "must be between 0 and π"],
    );
    assert_refused(
        |_, d| {
            std::fs::write(
                d.join("transforms_train.json"),
                r#"{"camera_angle_x": 0.7, "frames": []}"#,
            )
            .unwrap();
        },
        &[],
        3,
        &["transforms_train.json", "`frames` is empty"],
    );
}

#[test]
fn invalid_parameters_are_refused() {
    assert_refused(
        |_, _| {},
        &["-p", "lr_width=64", "-p", "scale=1"],
        2,
        &["lr_width = 64 and scale = 1 give HR images of 64 pixels", "32 pixels wide"],
    );
    assert_refused(
        |_, _| {},
        &["-p", "lr_width=0"],
        2,
        &["stage prep", "parameter lr_width", "minimum"],
    );
    assert_refused(|_, _| {}, &["-p", "kernel=gauss"], 2, &["parameter kernel", "lanczos"]);
    assert_refused(|_, _| {}, &["-p", "near=5", "-p", "far=3"], 2, &["near", "far = 3"]);
}

#[test]
fn unwritable_outputs_are_reported() {
    let project = Project::new(PREP_PIPELINE);
    let folder = dataset(&project);
    // A file in place of the store's parent folder: root may write to any existing folder.
    project.write("taken", "");
    project.run(&["run", "--store", "taken/store"]).fails(1, &["cannot open the store", "--store"]);
    let inputs = [("dataset", folder.as_path())];
    stage("prep", r#"{"lr_width": 16}"#, &inputs, &project.path("taken/out"), &[])
        .fails(2, &["--params"]);
    project.write("p.json", r#"{"lr_width": 16}"#);
    let output = std::process::Command::new(common::bin("prep"))
        .args(["--params", "p.json", "--output", "taken/out", "--input", "dataset=data"])
        .current_dir(project.path("."))
        .output()
        .unwrap();
    common::Finished::of(output).fails(1, &["--output taken/out", "cannot create the folder"]);
}

/// The store is a small tmpfs, which only root can mount, as in CI; otherwise the test is skipped.
#[test]
fn a_full_disk_leaves_only_complete_artifacts() {
    let project = Project::new(TINY);
    let disk = project.path("disk");
    std::fs::create_dir(&disk).unwrap();
    let mounted = std::process::Command::new("mount")
        .args(["-t", "tmpfs", "-o", "size=120k", "tmpfs"])
        .arg(&disk)
        .output();
    if !mounted.is_ok_and(|m| m.status.success()) {
        eprintln!("skipped: a tmpfs can't be mounted here (it needs root)");
        return;
    }
    let store = disk.join("store");
    let finished = project.run(&["run", "--store", store.to_str().unwrap()]);
    // Artifacts finished before the disk was full are complete; the store has no others.
    let verified = project.run(&["verify", "--store", store.to_str().unwrap()]);
    let count = |folder: &str| std::fs::read_dir(store.join(folder)).unwrap().count();
    let (objects, actions) = (count("objects"), count("actions"));
    let partial = count("partial");
    std::process::Command::new("umount").arg(&disk).status().unwrap();
    finished.fails(1, &["No space left on device"]);
    assert!(
        verified.stdout.contains(&format!("{objects} artifacts, 0 damaged")),
        "{}",
        verified.stdout
    );
    assert!(objects < 3 && actions <= 2 * objects && partial <= 1, "{objects} {actions} {partial}");
}

#[test]
fn a_damaged_file_of_an_artifact_is_named() {
    let project = Project::tiny();
    project.ok(&["run"]);
    let scene = project.output_of("prep", &[]).remove(0);
    let image = project.object(&scene).join("train/images/r_3.png");
    let mut bytes = std::fs::read(&image).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&image, bytes).unwrap();
    let before = project.store_listing();
    project.run(&["run", "-p", "seed=1"]).fails(2, &["-p seed", "demo-scene.seed, train-ss.seed"]);
    // Training reads the damaged image.
    project
        .run(&["run", "-p", "train-ss.seed=1"])
        .fails(3, &["train/images/r_3.png", "blake3 differs", "nerf-sr verify --remove"]);
    assert_eq!(project.store_listing(), before);
    project.run(&["verify"]).fails_on_stdout(3, &["train/images/r_3.png"]);
    project.run(&["verify", "--remove"]).fails_on_stdout(3, &["removed"]);
    let run = project.ok(&["run", "-p", "train-ss.seed=1"]);
    assert!(
        run.contains("4 of 5 stages ran"),
        "expected prep, training, rendering and scoring: {run}"
    );
    assert_eq!(project.output_of("prep", &[]), [scene]);
}

impl common::Finished {
    #[track_caller]
    fn fails_on_stdout(&self, code: i32, texts: &[&str]) {
        assert_eq!(self.code, code, "{}", self.stdout);
        assert!(texts.iter().all(|text| self.stdout.contains(text)), "{}", self.stdout);
    }
}

#[test]
fn invalid_pipelines_are_refused() {
    for (from, to, line, text) in [
        (
            "    inputs: {dataset: demo-scene}",
            "    inputs: {dataset: demo-scene}\n    imputs: {}",
            8,
            "imputs",
        ),
        ("  eval:\n", "  eval: {}\n  eval:\n", 15, "duplicate entry"),
        ("{dataset: demo-scene}", "{dataset: demo}", 7, "no stage \"demo\""),
        ("{dataset: demo-scene}", "{}", 6, "input dataset is missing"),
        ("{dataset: demo-scene}", "{dataset: demo-scene, masks: ./m}", 7, "no input \"masks\""),
        (
            "prep/train}",
            "prep/test}",
            10,
            "no subtree \"test\"; known: cameras, downscaled, references, train, train-cameras, \
            truth",
        ),
        (
            "prep/train}",
            "prep/truth}",
            10,
            "takes kind scene/train, but prep/truth has kind scene/truth",
        ),
        (
            "{dataset: demo-scene}",
            "{dataset: render-depth}",
            7,
            "takes kind dataset, but render-depth has kind views",
        ),
        ("lr_width: 24", "lr_width: twenty", 8, "parameter lr_width"),
        ("lr_width: 24", "lr_width: -3", 8, "parameter lr_width"),
        ("lr_width: 24", "lr_widht: 24", 8, "parameter lr_widht: unknown"),
        ("default: [eval]", "default: [all]", 0, "default: no stage"),
        ("  eval:\n", "  eval:\n    run: ./nowhere\n", 0, "set `run:`"),
        ("default: [eval]", "default: [eval", 0, ""),
    ] {
        let project = Project::new(&TINY.replacen(from, to, 1));
        let location =
            if line == 0 { "pipeline.yaml".to_owned() } else { format!("pipeline.yaml:{line}") };
        project.run(&["run"]).fails(2, &[&location, text]);
        assert_eq!(project.store_listing(), Vec::<String>::new());
    }
}

#[test]
fn a_cycle_is_named() {
    let script = "#!/bin/sh\necho \
        '{\"name\":\"x\",\"version\":\"1\",\"code\":\"1\",\"summary\":\"\",\"parameters\":{\"type\":\"object\"},\"inputs\":{\"a\":{\"kinds\":[\"k\"],\"summary\":\"\"}},\"output\":{\"kind\":\"k\"}}'\n";
    let project = Project::new(
        "default: [one]\nstages:\n  one: {run: ./x, inputs: {a: two}}\n  two: \
        {run: ./x, inputs: {a: three}}\n  three: {run: ./x, inputs: {a: one}}\n",
    );
    project.write("x", script);
    std::process::Command::new("chmod").arg("+x").arg(project.path("x")).status().unwrap();
    project
        .run(&["run"])
        .fails(2, &["pipeline.yaml:", "inputs form a cycle", "one ← two ← three ← one"]);
}

#[test]
fn invalid_command_lines_are_refused() {
    let project = Project::tiny();
    for (arguments, text) in [
        (&["run", "nowhere"][..], "no stage \"nowhere\""),
        (&["run", "-p", "kernal=box"], "no stage has this parameter"),
        (&["run", "-p", "kernel"], "expected NAME=VALUE"),
        (&["run", "-i", "nothing=."], "no stage has this input"),
        (&["run", "-j", "0"], "at least 1"),
        (&["why", "nowhere"], "no stage \"nowhere\""),
    ] {
        project.run(arguments).fails(2, &[text]);
    }
    stage(
        "prep",
        r#"{"lr_width": 16, "x": 1}"#,
        &[("dataset", Path::new("."))],
        &project.path("o"),
        &[],
    )
    .fails(2, &["parameter x", "unknown"]);
    stage("prep", r#"{"lr_width": 16"#, &[("dataset", Path::new("."))], &project.path("o"), &[])
        .fails(2, &["--params", "line 1"]);
    stage("prep", "{}", &[], &project.path("o"), &[]).fails(2, &["input dataset is missing"]);
    stage("prep", "{}", &[("data", Path::new("."))], &project.path("o"), &[])
        .fails(2, &["--input data", "known: dataset"]);
    stage("prep", "{}", &[("dataset", Path::new("/nowhere"))], &project.path("o"), &[])
        .fails(3, &["/nowhere", "no such folder"]);
    stage("prep", "{}", &[("dataset", Path::new("."))], &project.path("."), &[])
        .fails(2, &["--output"]);
}

#[test]
fn a_folder_without_a_dataset_is_refused() {
    assert_refused(
        |_, d| {
            std::fs::remove_file(d.join("transforms_test.json")).unwrap();
            std::fs::remove_file(d.join("transforms_train.json")).unwrap();
        },
        &[],
        3,
        &["data: no data set", "transforms.json (instant-ngp", "LLFF", "COLMAP"],
    );
    // Blender's format defines a split, a single `transforms.json` doesn't.
    assert_refused(
        |_, d| {
            std::fs::remove_file(d.join("transforms_test.json")).unwrap();
            std::fs::rename(d.join("transforms_train.json"), d.join("transforms.json")).unwrap();
        },
        &["-p", "split=given"],
        2,
        &["parameter split", "choose holdout or paper"],
    );
}

//! Unusual data sets: names, encodings, poses and images. Usable data is used, unusable data is
//! refused with a message that names the file or frame, and suspicious data causes a warning.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use common::{Project, manifest, stage};
use serde_json::{Value, json};

const PREP_PIPELINE: &str = "
default: [prep]
stages:
  prep:
    inputs: {dataset: ./data}
    parameters: {scale: 2}
";

/// Creates a demo scene as a user's folder, and a project that prepares the folder. Returns project
/// and folder.
fn project(size: u32, train: u32) -> (Project, PathBuf) {
    let project = Project::new(PREP_PIPELINE);
    let folder = project.path("data");
    let params =
        format!(r#"{{"size": {size}, "train": {train}, "test": 2, "samples_per_axis": 1}}"#);
    let finished = stage("demo-scene", &params, &[], &folder, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    std::fs::remove_file(folder.join("artifact.json")).unwrap();
    (project, folder)
}

/// Changes the list of training views.
fn edit(folder: &Path, change: impl FnOnce(&mut Value)) {
    let path = folder.join("transforms_train.json");
    let mut list: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    change(&mut list);
    std::fs::write(path, list.to_string()).unwrap();
}

fn pose(list: &mut Value, frame: usize) -> &mut Value {
    &mut list["frames"][frame]["transform_matrix"]
}

#[test]
fn names_from_files_are_printed_without_control_characters() {
    let (project, folder) = project(16, 4);
    let name = "\u{1b}]0;PWN\u{7}\u{1b}[31m\nred";
    edit(&folder, |list| list["frames"][1]["file_path"] = json!(format!("./train/{name}")));
    let is_plain = |text: &str| !text.replace('\n', "").contains(char::is_control);
    let missing = project.run(&["run"]);
    missing.fails(
        3,
        &[
            r"frame 1 (./train/\u{1b}]0;PWN\u{7}\u{1b}[31m\nred)",
            "not found; restore or rename the file",
        ],
    );
    assert!(is_plain(&missing.stderr) && is_plain(&missing.stdout), "{}", missing.stderr);
    // The image may have this name; its view's name has no control characters.
    std::fs::rename(folder.join("train/r_1.png"), folder.join(format!("train/{name}.png")))
        .unwrap();
    let scene = project.path("scene");
    let finished = stage("prep", "{}", &[("dataset", &folder)], &scene, &["--threads", "1"]);
    assert!(finished.code == 0 && is_plain(&finished.stderr), "{}", finished.stderr);
    assert!(scene.join("train/images/_]0;PWN__[31m_red.png").is_file());
}

/// A file name is ignored if no frame names the file.
#[test]
fn names_that_are_not_utf8_are_ignored_or_refused() {
    let (project, folder) = project(16, 4);
    let path = folder.join("train").join(OsStr::from_bytes(b"\xff\xfe.png"));
    std::fs::copy(folder.join("train/r_2.png"), &path).unwrap();
    let finished = stage("prep", "{}", &[("dataset", &folder)], &project.path("scene"), &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    let list = std::fs::read_to_string(folder.join("transforms_train.json")).unwrap();
    let bytes: Vec<u8> = list.replace("r_2", "\u{fffd}").into_bytes();
    let position = bytes.windows(3).position(|w| w == "\u{fffd}".as_bytes()).unwrap();
    std::fs::write(
        folder.join("transforms_train.json"),
        [&bytes[..position], b"\xff\xfe", &bytes[position + 3..]].concat(),
    )
    .unwrap();
    let refused = stage("prep", "{}", &[("dataset", &folder)], &project.path("other"), &[]);
    refused.fails(
        3,
        &[
            "transforms_train.json: line",
            r"./train/\xff\xfe",
            "is not UTF-8; save the file as UTF-8",
        ],
    );
}

/// Prepares a data set and returns the scene's manifest.
fn prepared_manifest(project: &Project, folder: &Path, name: &str) -> String {
    let scene = project.path(name);
    let finished = stage("prep", "{}", &[("dataset", folder)], &scene, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    manifest(&scene)
}

#[test]
fn a_byte_order_mark_and_crlf_are_accepted_and_utf16_is_refused() {
    let (project, folder) = project(16, 4);
    let plain = prepared_manifest(&project, &folder, "plain");
    let path = folder.join("transforms_train.json");
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, format!("\u{feff}{}", text.replace('\n', "\r\n"))).unwrap();
    assert_eq!(prepared_manifest(&project, &folder, "marked"), plain);
    let utf16: Vec<u8> =
        format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect();
    std::fs::write(&path, utf16).unwrap();
    project.run(&["run"]).fails(3, &["transforms_train.json: file is UTF-16; save it as UTF-8"]);
}

/// Damage to the list of training views, exit code, and texts of the message.
type Damage = (fn(&mut Value), i32, &'static [&'static str]);

#[test]
fn impossible_poses_are_refused() {
    let refusals: [Damage; 4] = [
        (
            |list| pose(list, 2)[0][3] = json!(1e30),
            3,
            &["frame 2 (./train/r_2)", "(1e30, ", "farther from the origin than 1e18"],
        ),
        (
            |list| {
                pose(list, 1).as_array_mut().unwrap()[..3]
                    .iter_mut()
                    .for_each(|row| row[0] = json!(-row[0].as_f64().unwrap()));
            },
            3,
            &[
                "frame 1 (./train/r_1)",
                "transform_matrix: camera_to_world is a reflection (its determinant is -1.000)",
            ],
        ),
        (
            |list| {
                let first = pose(list, 0).clone();
                (0..4).for_each(|i| *pose(list, i) = first.clone());
            },
            3,
            &["all 4 training views have the same pose"],
        ),
        (
            |list| pose(list, 3)[1][3] = json!("Infinity"),
            3,
            &["frame 3 (./train/r_3)", "camera_to_world[1][3] is infinite; poses must be finite"],
        ),
    ];
    for (damage, code, texts) in refusals {
        let (project, folder) = project(16, 4);
        edit(&folder, damage);
        // Python writes infinities without quotes.
        let path = folder.join("transforms_train.json");
        std::fs::write(
            &path,
            std::fs::read_to_string(&path).unwrap().replace("\"Infinity\"", "Infinity"),
        )
        .unwrap();
        project.run(&["run"]).fails(code, texts);
        assert_eq!(project.store_listing(), Vec::<String>::new());
    }
    let (project, folder) = project(1, 4);
    project
        .run(&["run"])
        .fails(2, &["scale = 2 gives LR and HR images the same width of 1 pixels"]);
    drop(folder);
}

/// Poses that are probably wrong are used, with a warning in the run's output, in the log and in
/// `scene.json`.
#[test]
fn suspicious_poses_cause_a_warning() {
    type Change = fn(&mut Value);
    let warnings: [(Change, &str); 4] = [
        (|_| {}, ""),
        (
            |list| list["frames"].as_array_mut().unwrap().truncate(1),
            "there is only 1 training view: depth cannot be estimated",
        ),
        (|list| pose(list, 2)[0][3] = json!(-3000.0), "training view r_2 is "),
        (
            |list| {
                (list["w"], list["h"], list["cx"], list["cy"]) =
                    (json!(32), json!(32), json!(8), json!(8));
            },
            "4 of 6 views have a principal point far from the image centre (first: training \
            view r_0 with (4.0, 4.0) in 16×16 pixels",
        ),
    ];
    for (change, warning) in warnings {
        let (project, folder) = project(16, 4);
        edit(&folder, change);
        let stdout = project.ok(&["run"]);
        let log = project.ok(&["log", "prep"]);
        let notes = project.json("prep", "scene.json", &[])["notes"].to_string();
        for text in [stdout, log, notes] {
            assert_eq!(text.contains("warning: "), !warning.is_empty(), "{text}");
            assert!(text.contains(warning), "{warning:?} not found in {text}");
        }
    }
}

/// Runs the pipeline and returns the numbers of training and test views.
fn view_counts(project: &Project, arguments: &[&str]) -> (u64, u64) {
    project.ok(&[&["run"], arguments].concat());
    let scene = project.json("prep", "scene.json", arguments);
    (scene["train"].as_u64().unwrap(), scene["test"].as_u64().unwrap())
}

#[test]
fn test_views_are_held_out_if_none_are_given() {
    let (project, folder) = project(16, 10);
    let test = folder.join("transforms_test.json");
    std::fs::write(&test, r#"{"camera_angle_x": 0.69, "frames": []}"#).unwrap();
    assert_eq!(view_counts(&project, &[]), (8, 2), "every eighth view is held out");
    std::fs::remove_file(&test).unwrap();
    assert_eq!(view_counts(&project, &[]), (8, 2));
    assert_eq!(view_counts(&project, &["-p", "split=holdout"]), (8, 2));
    assert_eq!(view_counts(&project, &["-p", "split=paper"]), (10, 9));
    project
        .run(&["run", "-p", "split=given"])
        .fails(2, &["parameter split", "choose holdout or paper"]);
}

#[test]
fn the_type_of_a_file_that_is_not_an_image_is_reported() {
    type Create = fn(&Path);
    let cases: [(Create, &str); 4] = [
        (|path| std::fs::create_dir(path).unwrap(), "r_1.png is a folder, not an image"),
        (
            |path| {
                assert!(std::process::Command::new("mkfifo").arg(path).status().unwrap().success());
            },
            "is a named pipe (FIFO), not an image",
        ),
        (|path| symlink("/dev/zero", path).unwrap(), "r_1.png is a device, not an image"),
        (
            |path| symlink("r_1.png", path).unwrap(),
            "r_1.png is a symbolic link that cannot be followed",
        ),
    ];
    for (create, message) in cases {
        let (project, folder) = project(16, 4);
        let image = folder.join("train/r_1.png");
        std::fs::remove_file(&image).unwrap();
        create(&image);
        let refused = stage("prep", "{}", &[("dataset", &folder)], &project.path("scene"), &[]);
        refused.fails(3, &["transforms_train.json: frame 1 (./train/r_1)", message]);
    }
}

#[test]
fn an_image_beyond_the_maximum_size_is_refused() {
    let (project, folder) = project(16, 4);
    // An EXR header has no checksum, so an image of one pixel can claim 20000 × 20000 pixels.
    let path = folder.join("train/huge.exr");
    let channels =
        ["R", "G", "B"].map(|name| pixels::Channel { name, sample_type: pixels::SampleType::Half });
    pixels::write_exr(&path, (1, 1), &channels, "", |_, _, samples| {
        samples.fill(0.5);
        Ok::<(), pixels::PixelError>(())
    })
    .unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    for window in [&b"dataWindow\0box2i\0"[..], b"displayWindow\0box2i\0"] {
        let start =
            bytes.windows(window.len()).position(|w| w == window).unwrap() + window.len() + 4;
        bytes[start + 8..start + 16]
            .copy_from_slice(&[19_999i32.to_le_bytes(), 19_999i32.to_le_bytes()].concat());
    }
    std::fs::write(&path, bytes).unwrap();
    edit(&folder, |list| list["frames"][1]["file_path"] = json!("./train/huge.exr"));
    project
        .run(&["run"])
        .fails(3, &["huge.exr", "20000×20000 pixels exceed the limit of 268435456"]);
}

const TRAINING_PIPELINE: &str = "
default: [report]
stages:
  demo-scene:
    parameters: {size: 32, train: 8, test: 2, samples_per_axis: 2}
  prep:
    inputs: {dataset: demo-scene}
    parameters: {lr_width: 16, scale: 2}
  train-ss:
    inputs: {scene: prep/train, references: prep/references}
    parameters: {rays: 8000, n_levels: 4, cells_per_pixel: 1, log2_hashmap_size: 11, hidden_dim: 16, march_steps: 128, max_rays_per_step: 1024, samples_per_step: 8192}
  render-depth:
    inputs: {field: train-ss, cameras: prep/cameras}
  eval:
    inputs: {views: render-depth, truth: prep/truth}
  report:
    inputs: {run: eval}
";

/// The LR photograph was downscaled from the reference, so both have equal exposures.
#[test]
fn a_reference_has_the_exposure_of_its_own_lr_photograph() {
    for kernel in ["lanczos", "average"] {
        let project = Project::new(TRAINING_PIPELINE);
        let arguments = ["-p", "train-ss.rays=600", "-p", &format!("kernel={kernel}")];
        project.ok(&[&["run", "train-ss"], &arguments[..]].concat());
        let log = project.ok(&[&["log", "train-ss"], &arguments[..]].concat());
        assert!(
            !log.contains("another exposure") && !log.contains("is left out"),
            "{kernel}: {log}"
        );
    }
}

/// Runs the pipeline with a parameter. Returns the field's weights, stderr, `training.json` and the
/// page.
fn run_with(project: &Project, parameter: &str) -> (Vec<u8>, String, Value, String) {
    let arguments = ["-p", parameter];
    let run = project.run(&[&["run"], &arguments[..]].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    let weights = std::fs::read(
        project.artifact("train-ss", &arguments).join(fields::FieldFile::member_file(0)),
    )
    .unwrap();
    let page = std::fs::read_to_string(project.path("out/report/index.html")).unwrap();
    (weights, run.stderr, project.json("train-ss", "training.json", &arguments), page)
}

/// With few rays, pose refinement moves cameras away and photographs don't match their neighbours.
/// The result is the field with the given poses.
#[test]
fn given_poses_are_used_if_refined_poses_are_no_better() {
    let project = Project::new(TRAINING_PIPELINE);
    let (given_weights, stderr, training, page) = run_with(&project, "pose_refinement=false");
    assert!(
        !stderr.contains("warning: ")
            && training.get("warnings").is_none()
            && !page.contains("id=\"warnings\""),
        "{stderr}"
    );
    let (weights, stderr, training, page) = run_with(&project, "pose_refinement=true");
    let warning =
        "given poses are used: photographs match their neighbours no better with refined poses";
    assert!(stderr.contains(&format!("warning: {warning}")), "{stderr}");
    assert!(training["warnings"][0].as_str().unwrap().starts_with(warning), "{training}");
    assert!(page.contains("id=\"warnings\"") && page.contains(warning));
    assert!(project.ok(&["log", "train-ss", "-p", "pose_refinement=true"]).contains(warning));
    let cameras: Value = project.json("prep", "train/views.json", &[]);
    let poses: Vec<Value> = cameras["views"]
        .as_array()
        .unwrap()
        .iter()
        .map(|view| view["camera"]["camera_to_world"].clone())
        .collect();
    assert_eq!(training["poses"], Value::Array(poses));
    assert!(weights == given_weights, "the field is the one with the given poses");
}

//! Odd data sets: names, text, poses and images as they happen to people. What can be used is used,
//! what can't be is refused by a line that names it, and what is likely wrong is warned of.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use common::{Project, manifest, stage};
use serde_json::{Value, json};

const FROM_FOLDER: &str = "
default: [prep]
stages:
  prep:
    inputs: {dataset: ./data}
    parameters: {scale: 2}
";

/// A demo scene as a user's folder, below a pipeline that prepares it.
fn project(size: u32, train: u32) -> (Project, PathBuf) {
    let project = Project::new(FROM_FOLDER);
    let folder = project.path("data");
    let params =
        format!(r#"{{"size": {size}, "train": {train}, "test": 2, "samples_per_axis": 1}}"#);
    let made = stage("demo-scene", &params, &[], &folder, &[]);
    assert_eq!(made.code, 0, "{}", made.stderr);
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
        &[r"frame 1 (./train/\u{1b}]0;PWN\u{7}\u{1b}[31m\nred)", "not found; remove the frame"],
    );
    assert!(is_plain(&missing.stderr) && is_plain(&missing.stdout), "{}", missing.stderr);
    // An image may have such a name; its view hasn't.
    std::fs::rename(folder.join("train/r_1.png"), folder.join(format!("train/{name}.png")))
        .unwrap();
    let scene = project.path("scene");
    let made = stage("prep", "{}", &[("dataset", &folder)], &scene, &["--threads", "1"]);
    assert!(made.code == 0 && is_plain(&made.stderr), "{}", made.stderr);
    assert!(scene.join("train/images/_]0;PWN__[31m_red.png").is_file());
}

/// A file that no frame names is nobody's business, whatever it is called.
#[test]
fn names_that_are_not_utf8_are_passed_over_or_named() {
    let (project, folder) = project(16, 4);
    let odd = folder.join("train").join(OsStr::from_bytes(b"\xff\xfe.png"));
    std::fs::copy(folder.join("train/r_2.png"), &odd).unwrap();
    let made = stage("prep", "{}", &[("dataset", &folder)], &project.path("scene"), &[]);
    assert_eq!(made.code, 0, "{}", made.stderr);
    let list = std::fs::read_to_string(folder.join("transforms_train.json")).unwrap();
    let bytes: Vec<u8> = list.replace("r_2", "\u{fffd}").into_bytes();
    let place = bytes.windows(3).position(|w| w == "\u{fffd}".as_bytes()).unwrap();
    std::fs::write(
        folder.join("transforms_train.json"),
        [&bytes[..place], b"\xff\xfe", &bytes[place + 3..]].concat(),
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

fn prepared(project: &Project, folder: &Path, name: &str) -> String {
    let scene = project.path(name);
    let made = stage("prep", "{}", &[("dataset", folder)], &scene, &[]);
    assert_eq!(made.code, 0, "{}", made.stderr);
    manifest(&scene)
}

#[test]
fn text_as_other_editors_save_it() {
    let (project, folder) = project(16, 4);
    let plain = prepared(&project, &folder, "plain");
    let path = folder.join("transforms_train.json");
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, format!("\u{feff}{}", text.replace('\n', "\r\n"))).unwrap();
    assert_eq!(prepared(&project, &folder, "marked"), plain);
    let wide: Vec<u8> =
        format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect();
    std::fs::write(&path, wide).unwrap();
    project.run(&["run"]).fails(3, &["transforms_train.json: file is UTF-16; save it as UTF-8"]);
}

/// Damage to the list of training views, the exit code, and words of the refusal.
type Damage = (fn(&mut Value), i32, &'static [&'static str]);

#[test]
fn poses_that_cannot_be_are_refused() {
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
                let same = pose(list, 0).clone();
                (0..4).for_each(|i| *pose(list, i) = same.clone());
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
    for (damage, code, words) in refusals {
        let (project, folder) = project(16, 4);
        edit(&folder, damage);
        // Python writes infinities without quotes.
        let path = folder.join("transforms_train.json");
        std::fs::write(
            &path,
            std::fs::read_to_string(&path).unwrap().replace("\"Infinity\"", "Infinity"),
        )
        .unwrap();
        project.run(&["run"]).fails(code, words);
        assert_eq!(project.store_listing(), Vec::<String>::new());
    }
    let (project, folder) = project(1, 4);
    project
        .run(&["run"])
        .fails(2, &["scale = 2 gives LR and HR images the same width of 1 pixels"]);
    drop(folder);
}

/// Poses that are probably wrong are used, with a warning at once, in the log, in `scene.json` and
/// at the end.
#[test]
fn poses_that_look_wrong_are_warned_of() {
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
    for (change, words) in warnings {
        let (project, folder) = project(16, 4);
        edit(&folder, change);
        let said = project.ok(&["run"]);
        let logged = project.ok(&["log", "prep"]);
        let notes = project.json("prep", "scene.json", &[])["notes"].to_string();
        for text in [said, logged, notes] {
            // A log has it where it was said, and once more in the result.
            assert_eq!(text.contains("warning: "), !words.is_empty(), "{text}");
            assert!(text.contains(words), "{words} isn't in {text}");
        }
    }
}

fn counts(project: &Project, settings: &[&str]) -> (u64, u64) {
    project.ok(&[&["run"], settings].concat());
    let scene = project.json("prep", "scene.json", settings);
    (scene["train"].as_u64().unwrap(), scene["test"].as_u64().unwrap())
}

#[test]
fn training_views_alone_are_a_data_set() {
    let (project, folder) = project(16, 10);
    let test = folder.join("transforms_test.json");
    std::fs::write(&test, r#"{"camera_angle_x": 0.69, "frames": []}"#).unwrap();
    assert_eq!(counts(&project, &[]), (8, 2), "without frames, every eighth is held out");
    std::fs::remove_file(&test).unwrap();
    assert_eq!(counts(&project, &[]), (8, 2));
    assert_eq!(counts(&project, &["-p", "split=holdout"]), (8, 2));
    assert_eq!(counts(&project, &["-p", "split=paper"]), (10, 9));
    project
        .run(&["run", "-p", "split=given"])
        .fails(2, &["parameter split", "choose holdout or paper"]);
}

#[test]
fn what_stands_where_an_image_should_be_is_named() {
    type Put = fn(&Path);
    let cases: [(Put, &str); 4] = [
        (|at| std::fs::create_dir(at).unwrap(), "r_1.png is a folder, not an image"),
        (
            |at| assert!(std::process::Command::new("mkfifo").arg(at).status().unwrap().success()),
            "is a named pipe (FIFO), not an image",
        ),
        (|at| symlink("/dev/zero", at).unwrap(), "r_1.png is a device, not an image"),
        (
            |at| symlink("r_1.png", at).unwrap(),
            "r_1.png is a symbolic link that cannot be followed",
        ),
    ];
    for (put, words) in cases {
        let (project, folder) = project(16, 4);
        let image = folder.join("train/r_1.png");
        std::fs::remove_file(&image).unwrap();
        put(&image);
        let refused = stage("prep", "{}", &[("dataset", &folder)], &project.path("scene"), &[]);
        refused.fails(3, &["transforms_train.json: frame 1 (./train/r_1)", words]);
    }
}

#[test]
fn the_largest_size_is_said() {
    let (project, folder) = project(16, 4);
    // An EXR's header isn't summed up: an image of one pixel that says it has 20000 × 20000.
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
        let at = bytes.windows(window.len()).position(|w| w == window).unwrap() + window.len() + 4;
        bytes[at + 8..at + 16]
            .copy_from_slice(&[19_999i32.to_le_bytes(), 19_999i32.to_le_bytes()].concat());
    }
    std::fs::write(&path, bytes).unwrap();
    edit(&folder, |list| list["frames"][1]["file_path"] = json!("./train/huge.exr"));
    project
        .run(&["run"])
        .fails(3, &["huge.exr", "20000×20000 pixels exceed the limit of 268435456"]);
}

const TRAINED: &str = "
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

/// LR was made from that very image.
#[test]
fn a_reference_has_the_exposure_of_its_own_lr_photograph() {
    for kernel in ["lanczos", "average"] {
        let project = Project::new(TRAINED);
        let settings = ["-p", "train-ss.rays=600", "-p", &format!("kernel={kernel}")];
        project.ok(&[&["run", "train-ss"], &settings[..]].concat());
        let said = project.ok(&[&["log", "train-ss"], &settings[..]].concat());
        assert!(
            !said.contains("another exposure") && !said.contains("is left out"),
            "{kernel}: {said}"
        );
    }
}

fn trained_with(project: &Project, refined: &str) -> (Vec<u8>, String, Value, String) {
    let settings = ["-p", refined];
    let run = project.run(&[&["run"], &settings[..]].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    let weights = std::fs::read(
        project.artifact("train-ss", &settings).join(fields::FieldFile::member_file(0)),
    )
    .unwrap();
    let page = std::fs::read_to_string(project.path("out/report/index.html")).unwrap();
    (weights, run.stderr, project.json("train-ss", "training.json", &settings), page)
}

/// Few rays can't refine poses: cameras wander off, photographs don't match their neighbours, and
/// the field is the one with the given poses.
#[test]
fn poses_stay_where_refined_ones_are_no_better() {
    let project = Project::new(TRAINED);
    let (given, said, training, page) = trained_with(&project, "pose_refinement=false");
    assert!(
        !said.contains("warning: ")
            && training.get("warnings").is_none()
            && !page.contains("id=\"warnings\""),
        "{said}"
    );
    let (kept, said, training, page) = trained_with(&project, "pose_refinement=true");
    let words =
        "given poses are used: photographs match their neighbours no better with refined poses";
    assert!(said.contains(&format!("warning: {words}")), "{said}");
    assert!(training["warnings"][0].as_str().unwrap().starts_with(words), "{training}");
    assert!(page.contains("id=\"warnings\"") && page.contains(words));
    assert!(project.ok(&["log", "train-ss", "-p", "pose_refinement=true"]).contains(words));
    let cameras: Value = project.json("prep", "train/views.json", &[]);
    let poses: Vec<Value> = cameras["views"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v["camera"]["camera_to_world"].clone())
        .collect();
    assert_eq!(training["poses"], Value::Array(poses));
    assert!(kept == given, "the field is that with the given poses");
}

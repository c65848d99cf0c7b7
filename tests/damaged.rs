//! Damaged images and numbers in a data set are refused by a line that names the file: no missing
//! pixel becomes grey, black or transparent. Files that don't belong to a data set are ignored.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use common::{Finished, Project, stage, stage_command};
use exr::prelude::{Image, SpecificChannels, WritableImage as _, write_rgba_file};
use serde_json::{Value, json};

const PIPELINE: &str = "
default: [prep]
stages:
  prep:
    inputs: {dataset: ./data}
    parameters: {lr_width: 16, scale: 2}
";

/// Creates a pipeline that prepares a demo scene, and the scene as a user's folder.
fn project() -> (Project, PathBuf) {
    let project = Project::new(PIPELINE);
    let folder = project.path("data");
    let params = r#"{"size": 32, "train": 4, "test": 2, "samples_per_axis": 1}"#;
    let finished = stage("demo-scene", params, &[], &folder, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    std::fs::remove_file(folder.join("artifact.json")).unwrap();
    (project, folder)
}

/// Edits a list of frames, `transforms_*.json`.
fn edit_frames(path: &Path, change: impl FnOnce(&mut Value)) {
    let mut value: Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    change(&mut value);
    std::fs::write(path, value.to_string()).unwrap();
}

fn edit_training(folder: &Path, change: impl FnOnce(&mut Value)) {
    edit_frames(&folder.join("transforms_train.json"), change);
}

/// Encodes a JPEG of 32×32 pixels.
fn jpeg(is_progressive: bool) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 90);
    encoder.set_progressive(is_progressive);
    let samples: Vec<u8> = (0..32 * 32 * 3).map(|i: usize| (i * 7 + i * i / 31) as u8).collect();
    encoder.encode(&samples, 32, 32, jpeg_encoder::ColorType::Rgb).unwrap();
    bytes
}

/// Replaces an image by a JPEG without its last 300 bytes.
fn write_cut_jpeg(path: &Path, is_progressive: bool) {
    let bytes = jpeg(is_progressive);
    std::fs::write(path, &bytes[..bytes.len() - 300]).unwrap();
}

/// Writes an EXR whose pixels are grey except `bad` in column 3 of row 5.
fn write_exr(path: &Path, bad: (f32, f32, f32, f32)) {
    let pixel = |x, y| if (x, y) == (3, 5) { bad } else { (0.5, 0.5, 0.5, 1.0) };
    write_rgba_file(path, 32, 32, pixel).unwrap();
}

/// Damage to a data set, and texts of the refusal.
type Damage = (fn(&Path), &'static [&'static str]);

const DAMAGES: &[Damage] = &[
    (
        |data| write_cut_jpeg(&data.join("train/r_1.png"), false),
        &["frame r_1", "data/train/r_1.png: cut short or damaged: ", " of 32 rows are missing;"],
    ),
    (
        |data| write_cut_jpeg(&data.join("test/r_1.png"), true),
        &[
            "frame r_1",
            "data/test/r_1.png: cut short or damaged in scan ",
            "of all 32 rows is missing;",
        ],
    ),
    (
        |data| {
            write_exr(&data.join("train/bad.exr"), (0.5, f32::NAN, 0.5, 1.0));
            edit_training(data, |list| list["frames"][2]["file_path"] = json!("./train/bad.exr"));
        },
        &["frame bad", "data/train/bad.exr: channel G is NaN at column 3, row 5;"],
    ),
    (
        |data| {
            write_exr(&data.join("train/bad.exr"), (0.5, 0.5, 0.5, f32::NAN));
            edit_training(data, |list| list["frames"][2]["file_path"] = json!("./train/bad.exr"));
        },
        &["frame bad", "data/train/bad.exr: channel A is NaN at column 3, row 5;"],
    ),
    (
        |data| {
            write_exr(&data.join("test/bad.exr"), (f32::INFINITY, 0.5, 0.5, 1.0));
            edit_frames(&data.join("transforms_test.json"), |list| {
                list["frames"][0]["file_path"] = json!("./test/bad.exr");
            });
        },
        &["frame bad", "data/test/bad.exr: channel R is inf at column 3, row 5;"],
    ),
    (
        |data| {
            write_exr(&data.join("mask.exr"), (0.5, 0.5, f32::NEG_INFINITY, 1.0));
            edit_training(data, |list| list["frames"][0]["mask_path"] = json!("mask.exr"));
        },
        &["frame r_0", "data/mask.exr: channel B is -inf at column 3, row 5;"],
    ),
    (
        |data| {
            let depth = |bad: f32| {
                SpecificChannels::build().with_channel("A").with_channel("Z").with_pixel_fn(
                    move |at| (1.0f32, if (at.x(), at.y()) == (3, 5) { bad } else { 2.0f32 }),
                )
            };
            let image = Image::from_channels((32, 32), depth(f32::INFINITY));
            image.write().to_file(data.join("test/r_0_depth.exr")).unwrap();
        },
        &["frame r_0", "data/test/r_0_depth.exr: channel Z is inf at column 3, row 5;"],
    ),
    (
        |data| edit_training(data, |list| list["fl_x"] = json!(1e300)),
        &["transforms_train.json: frame 0 (./train/r_0): fx is 1e300 pixels, but the image's side"],
    ),
    (
        |data| edit_training(data, |list| list["frames"][3]["cx"] = json!(-1e12)),
        &["transforms_train.json: frame 3 (./train/r_3): cx is -1e12 pixels"],
    ),
    (
        |data| edit_training(data, |list| list["w"] = json!(1e308)),
        &["transforms_train.json: frame 0 (./train/r_0): w is 1e308;"],
    ),
    (
        |data| {
            edit_training(data, |list| {
                list["frames"][1]["file_path"] = json!("x".repeat(5_000_000));
            });
        },
        &["transforms_train.json: frame 1 (xxx", "x…): ", "path is too long (5000"],
    ),
    (
        |data| edit_training(data, |list| list["frames"][1]["fl_x"] = json!("y".repeat(5_000_000))),
        &[
            "transforms_train.json: frame 1 (./train/r_1): fl_x: expected a number, found \"yyy",
            "y…",
        ],
    ),
    (
        |data| {
            std::fs::remove_file(data.join("train/r_2.png")).unwrap();
            symlink("/unmounted/r_2.png", data.join("train/r_2.png")).unwrap();
        },
        &[
            "frame 2 (./train/r_2)",
            "r_2.png is a symbolic link to /unmounted/r_2.png, which does not exist",
        ],
    ),
    (
        |data| {
            std::fs::rename(data.join("train/r_2.png"), data.join("train/._r_2.png")).unwrap();
            edit_training(data, |list| list["frames"][2]["file_path"] = json!("train/._r_2.png"));
        },
        &[
            "frame 2 (train/._r_2.png)",
            "._r_2.png is named like editor and system files, which are ignored; restore or rename the file",
        ],
    ),
];

#[test]
fn damage_is_refused_with_its_file_and_position() {
    for (damage, texts) in DAMAGES {
        let (project, folder) = project();
        damage(&folder);
        let run = project.run(&["run"]);
        run.fails(3, texts);
        let longest = run.stderr.lines().map(str::len).max();
        assert!(longest < Some(1000), "{}", run.stderr);
        assert_eq!(project.store_listing(), Vec::<String>::new());
    }
}

#[test]
fn memory_is_checked_before_images_are_decoded() {
    let (project, folder) = project();
    let prepare = |memory: &str, output: &str| {
        let inputs = [("dataset", folder.as_path())];
        let (output, more) = (project.path(output), ["--threads", "2", "--progress", "plain"]);
        let mut command = stage_command("prep", r#"{"scale": 2}"#, &inputs, &output, &more);
        Finished::of(command.env("NERF_SR_MEMORY", memory).output().unwrap())
    };
    prepare("20000", "none").fails(
        2,
        &["frame r_0: preparing its image of 32×32 pixels needs 20.5 kB of memory, and 20.0 kB are"],
    );
    let one_thread = prepare("30000", "one");
    assert_eq!(one_thread.code, 0, "{}", one_thread.stderr);
    let text = format!("{}{}", one_thread.stdout, one_thread.stderr);
    assert!(
        text.contains("1 of 2 threads: preparing the largest image needs 20.5 kB of memory"),
        "{text}"
    );
    let two_threads = prepare("4000000000", "both");
    assert_eq!(
        (two_threads.code, common::manifest(&project.path("both"))),
        (0, common::manifest(&project.path("one")))
    );
}

/// Files of editors and systems, and broken links, may appear and disappear without a new run.
#[test]
fn files_that_do_not_belong_to_the_data_are_ignored() {
    let (project, folder) = project();
    symlink("me@host.123:4", folder.join(".#transforms_train.json")).unwrap();
    symlink("gone", folder.join("train/link.png")).unwrap();
    project.ok(&["run"]);
    let log = project.ok(&["log", "prep"]);
    assert!(log.contains("2 files ignored") && log.contains(".#transforms_train"), "{log}");
    std::fs::remove_file(folder.join(".#transforms_train.json")).unwrap();
    for name in [".DS_Store", "train/._r_0.png", ".~lock.transforms_train.json#", ".x.swp"] {
        std::fs::write(folder.join(name), "").unwrap();
    }
    let run = project.ok(&["run"]);
    assert!(run.contains("nothing to run"), "{run}");
}

#[test]
fn equal_file_names_in_different_folders_are_distinguished() {
    let (project, folder) = project();
    let names = ["a/b", "c/b", "a_b"];
    for (frame, name) in names.into_iter().enumerate() {
        let file = folder.join(format!("{name}.png"));
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::copy(folder.join("train/r_0.png"), file).unwrap();
        edit_training(&folder, |list| list["frames"][frame]["file_path"] = json!(name));
    }
    project.ok(&["run"]);
    let images = project.artifact("prep", &[]).join("train/images");
    assert!(["a__b.png", "c__b.png", "a_b.png"].iter().all(|name| images.join(name).is_file()));
}

//! Detection of scenes on a flat background, forward-facing scenes and unbounded scenes, also
//! without known depths.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::Path;

use common::{Project, data, stage};
use dataset::Dataset;
use pixels::{Filter, Rgba8, read_png, resize_pillow, write_png};
use serde_json::{Value, json};

/// Prepares a data set; returns the scene's background, kind of space and notes.
fn prepare(project: &Project, dataset: &Path, params: &Value) -> (String, String, String) {
    let scene = project.path("scene");
    std::fs::remove_dir_all(&scene).ok();
    let finished = stage("prep", &params.to_string(), &[("dataset", dataset)], &scene, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    let text = std::fs::read_to_string(scene.join("scene.json")).unwrap();
    let summary: Value = serde_json::from_str(&text).unwrap();
    let space = match &summary["bounds"]["space"] {
        Value::String(name) => name.clone(),
        Value::Object(fields) => fields.keys().next().unwrap().clone(),
        other => panic!("{other}"),
    };
    (summary["background"].as_str().unwrap().to_owned(), space, summary["notes"].to_string())
}

/// Returns the image names in a list of frames.
fn image_names(folder: &Path, file: &str) -> Vec<String> {
    let transforms: Value =
        serde_json::from_str(&std::fs::read_to_string(folder.join(file)).unwrap()).unwrap();
    let frames = transforms["frames"].as_array().unwrap();
    frames
        .iter()
        .map(|frame| {
            Path::new(frame["file_path"].as_str().unwrap())
                .file_name()
                .unwrap()
                .to_str()
                .unwrap()
                .to_owned()
        })
        .collect()
}

fn over_white(pixel: &[u8]) -> [u8; 4] {
    let alpha = u32::from(pixel[3]);
    let level = |c: usize| ((u32::from(pixel[c]) * alpha + 255 * (255 - alpha)) / 255) as u8;
    [level(0), level(1), level(2), 255]
}

/// Writes ten views per split of a Blender scene, composited over white.
fn write_on_white(source: &Path, folder: &Path) {
    for split in ["train", "test"] {
        std::fs::create_dir_all(folder.join(split)).unwrap();
        let text =
            std::fs::read_to_string(source.join(format!("transforms_{split}.json"))).unwrap();
        let mut transforms: Value = serde_json::from_str(&text).unwrap();
        let frames = transforms["frames"].as_array_mut().unwrap();
        *frames = frames.iter().step_by(frames.len() / 10).take(10).cloned().collect();
        std::fs::write(folder.join(format!("transforms_{split}.json")), transforms.to_string())
            .unwrap();
    }
    let (train, test) =
        (image_names(folder, "transforms_train.json"), image_names(folder, "transforms_test.json"));
    let dataset = Dataset::read(source).unwrap();
    let given_split = dataset.split.clone().unwrap();
    for (split, indices, names) in
        [("train", given_split.train, train), ("test", given_split.test, test)]
    {
        for index in indices {
            let frame = &dataset.frames[index];
            let name = frame.image.file_stem().unwrap().to_str().unwrap();
            if !names.iter().any(|selected| selected == name) {
                continue;
            }
            let image = frame.photograph().unwrap();
            let data = image.data.chunks_exact(4).flat_map(over_white).collect();
            write_png(
                &folder.join(split).join(format!("{name}.png")),
                &Rgba8::new(image.width, image.height, data),
            )
            .unwrap();
        }
    }
}

#[test]
fn objects_on_white_have_a_white_background_and_a_box() {
    let Some(data) = data() else { return };
    let project = Project::tiny();
    for scene in ["lego", "chair"] {
        let folder = project.path(scene);
        write_on_white(&data.join("nerf_synthetic").join(scene), &folder);
        let (background, space, notes) =
            prepare(&project, &folder, &json!({"lr_width": 50, "scale": 2}));
        assert_eq!((background.as_str(), space.as_str()), ("white", "box"), "{scene}: {notes}");
        assert!(
            notes.contains("borders are one flat colour (255 255 255) in 10 of 10 sampled views"),
            "{notes}"
        );
    }
}

/// Creates and prepares a demo scene; returns the values of [`prepare`].
fn prepare_demo(
    project: &Project,
    folder: &Path,
    layout: &str,
    backdrop: bool,
) -> (String, String, String) {
    std::fs::remove_dir_all(folder).ok();
    let params = json!({"form": "transforms", "backdrop": backdrop, "layout": layout,
        "size": 64, "aspect": 1.5, "train": 12, "test": 3,
        "samples_per_axis": 1});
    assert_eq!(stage("demo-scene", &params.to_string(), &[], folder, &[]).code, 0);
    prepare(project, folder, &json!({}))
}

#[test]
fn photographs_with_a_backdrop_are_opaque_and_unbounded() {
    let project = Project::tiny();
    let folder = project.path("photographs");
    let (background, space, notes) = prepare_demo(&project, &folder, "around", true);
    assert_eq!((background.as_str(), space.as_str()), ("opaque", "contraction"), "{notes}");
    assert!(notes.contains("of 12 sampled views: too few for a plain background"), "{notes}");
    let (background, space, notes) = prepare_demo(&project, &folder, "forward", true);
    assert_eq!((background.as_str(), space.as_str()), ("opaque", "ndc"), "{notes}");
    let (background, space, notes) = prepare_demo(&project, &folder, "around", false);
    assert_eq!((background.as_str(), space.as_str()), ("white", "box"), "{notes}");
    // A given background overrides the detected one.
    let (background, space, _) = prepare(&project, &folder, &json!({"background": "opaque"}));
    assert_eq!((background.as_str(), space.as_str()), ("opaque", "contraction"));
}

/// Enlarged photographs lack detail at their own size, but not after they are downscaled again.
#[test]
fn missing_detail_is_reported() {
    let project = Project::tiny();
    let folder = project.path("enlarged");
    let params = json!({"backdrop": true, "size": 96, "train": 8, "test": 2});
    assert_eq!(stage("demo-scene", &params.to_string(), &[], &folder, &[]).code, 0);
    let (_, _, notes) = prepare(&project, &folder, &json!({"lr_source": "photographs"}));
    assert!(!notes.contains("detail"), "{notes}");
    // A folder without a manifest counts as a user's own data.
    std::fs::remove_file(folder.join("artifact.json")).unwrap();
    for entry in std::fs::read_dir(folder.join("train")).unwrap() {
        let path = entry.unwrap().path();
        let image = read_png(&path).unwrap();
        write_png(&path, &resize_pillow(&image, 192, 192, Filter::Lanczos)).unwrap();
    }
    let (_, _, notes) =
        prepare(&project, &folder, &json!({"lr_source": "photographs", "split": "holdout"}));
    let note = "of the LR images' resolution: the photographs are enlarged, blurred";
    assert!(notes.contains(note), "{notes}");
    let summary = std::fs::read_to_string(project.path("scene/scene.json")).unwrap();
    let detail = serde_json::from_str::<Value>(&summary).unwrap()["detail"].as_f64().unwrap();
    assert!((0.3..0.7).contains(&detail), "{detail}");
    let (_, _, notes) = prepare(&project, &folder, &json!({"lr_width": 48, "scale": 2}));
    assert!(!notes.contains("detail"), "{notes}");
}

#[test]
fn fern_without_points_is_forward_facing() {
    let Some(data) = data() else { return };
    let project = Project::tiny();
    let (source, folder) = (data.join("nerf_llff_data/fern"), project.path("fern"));
    std::fs::create_dir_all(&folder).unwrap();
    for entry in std::fs::read_dir(&source).unwrap().map(|entry| entry.unwrap()) {
        if entry.file_name() != "sparse" {
            std::os::unix::fs::symlink(entry.path(), folder.join(entry.file_name())).unwrap();
        }
    }
    let (background, space, notes) =
        prepare(&project, &folder, &json!({"lr_width": 63, "scale": 2}));
    assert_eq!((background.as_str(), space.as_str()), ("opaque", "ndc"), "{notes}");
}

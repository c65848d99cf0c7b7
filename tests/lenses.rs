//! Lens models agree with COLMAP's own library, and a field trained on fisheye photographs is as
//! good as a field trained on a pinhole camera's.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

use common::{Project, stage};
use dataset::Dataset;
use glam::DVec3;
use scene::{Camera, Views};
use serde_json::{Value, json};

/// COLMAP's camera models and parameters, with distortion if the model has any.
const MODELS: &[(&str, &[f64])] = &[
    ("SIMPLE_RADIAL", &[500.0, 322.0, 238.0, -0.11]),
    ("RADIAL", &[500.0, 322.0, 238.0, -0.13, 0.04]),
    ("OPENCV", &[500.0, 510.0, 322.0, 238.0, -0.15, 0.05, 0.002, -0.003]),
    (
        "FULL_OPENCV",
        &[500.0, 510.0, 322.0, 238.0, 0.12, -0.06, 0.002, -0.003, 0.02, 0.18, -0.04, 0.01],
    ),
    ("SIMPLE_RADIAL_FISHEYE", &[280.0, 322.0, 238.0, -0.02]),
    ("RADIAL_FISHEYE", &[280.0, 322.0, 238.0, -0.02, 0.004]),
    ("OPENCV_FISHEYE", &[280.0, 285.0, 322.0, 238.0, -0.02, 0.006, -0.003, 0.0005]),
    (
        "THIN_PRISM_FISHEYE",
        &[280.0, 285.0, 322.0, 238.0, -0.02, 0.006, 0.001, -0.002, -0.003, 0.0005, 0.0, 0.0],
    ),
    ("SIMPLE_FISHEYE", &[280.0, 322.0, 238.0]),
    ("FISHEYE", &[280.0, 285.0, 322.0, 238.0]),
];
const SIZE: [u32; 2] = [640, 480];

/// Writes a COLMAP model with one image at the origin, axes right, down, forward, and reads its
/// camera.
fn read_camera(project: &Project, model: &str, parameters: &[f64]) -> Camera {
    let folder = project.path(model);
    let [width, height] = SIZE;
    let numbers: Vec<String> = parameters.iter().map(f64::to_string).collect();
    let cameras = format!("1 {model} {width} {height} {}\n", numbers.join(" "));
    project.write(&format!("{model}/sparse/0/cameras.txt"), &cameras);
    project.write(&format!("{model}/sparse/0/images.txt"), "1 1 0 0 0 0 0 0 1 a.png\n\n");
    std::fs::create_dir_all(folder.join("images")).unwrap();
    let image = pixels::Rgba8::new(640, 480, vec![255; 4 * 640 * 480]);
    pixels::write_png(&folder.join("images/a.png"), &image).unwrap();
    let set = Dataset::read(&folder).unwrap();
    let camera = set.frames[0].camera();
    camera.check().unwrap();
    camera
}

/// Returns image positions, corners included, and world points: first one on the camera's ray at
/// each position, then some up to 85° (fisheye) or 35° from the axis.
fn positions_and_points(camera: &Camera) -> (Vec<[f64; 2]>, Vec<DVec3>) {
    let [width, height] = SIZE.map(f64::from);
    let fractions =
        (0..=8).flat_map(|x| (0..=6).map(move |y| [f64::from(x) / 8.0, f64::from(y) / 6.0]));
    let positions: Vec<[f64; 2]> = fractions.map(|[x, y]| [x * width, y * height]).collect();
    let on_rays = positions.iter().map(|[x, y]| camera.ray(*x, *y).at(3.7));
    let max_angle = if camera.intrinsics.distortion.is_fisheye() { 85.0 } else { 35.0 };
    let around_axis = (0..60).map(|i| {
        let (angle, turn) = (f64::to_radians(max_angle * f64::from(i) / 59.0), f64::from(i) * 2.4);
        0.8 * DVec3::new(angle.sin() * turn.cos(), angle.sin() * turn.sin(), angle.cos())
    });
    (positions.clone(), on_rays.chain(around_axis).collect())
}

/// Returns pycolmap's image positions of points; `None` if pycolmap isn't installed.
fn project_by_pycolmap(entries: &[Value]) -> Option<Vec<Vec<[f64; 2]>>> {
    let python = |arguments: &[&str]| {
        let mut command = Command::new("python3");
        command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped());
        command
    };
    let import = python(&["-c", "import pycolmap"]).stderr(Stdio::null()).status();
    if !import.is_ok_and(|status| status.success()) {
        eprintln!("skipped: no pycolmap (python3 -m pip install pycolmap)");
        return None;
    }
    let script = common::root().join("scripts/project-colmap.py");
    let mut child = python(&[script.to_str().unwrap()]).spawn().unwrap();
    child.stdin.take().unwrap().write_all(json!(entries).to_string().as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success());
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

#[test]
fn lenses_project_as_pycolmap_does() {
    let project = Project::tiny();
    let cameras: Vec<Camera> =
        MODELS.iter().map(|(model, numbers)| read_camera(&project, model, numbers)).collect();
    let [width, height] = SIZE;
    let mut entries = Vec::new();
    for ((model, parameters), camera) in MODELS.iter().zip(&cameras) {
        let points: Vec<[f64; 3]> =
            positions_and_points(camera).1.iter().map(DVec3::to_array).collect();
        entries.push(json!({"model": model, "width": width, "height": height,
            "parameters": parameters, "points": points}));
    }
    let Some(expected) = project_by_pycolmap(&entries) else { return };
    for (((model, _), camera), expected) in MODELS.iter().zip(&cameras).zip(&expected) {
        let (positions, points) = positions_and_points(camera);
        assert_eq!(expected.len(), points.len());
        let mut max_distance: f64 = 0.0;
        for (i, (point, [x, y])) in points.iter().zip(expected).enumerate() {
            let (u, v, _) = camera.project(*point).unwrap();
            max_distance = max_distance.max((u - x).hypot(v - y));
            if let Some(position) = positions.get(i) {
                max_distance = max_distance.max((position[0] - x).hypot(position[1] - y));
            }
        }
        println!("{model}: {max_distance:.1e} pixels apart");
        assert!(max_distance < 1e-6, "{model}: {max_distance} pixels apart");
    }
}

/// Pipeline of a demo scene whose training views are 100° wide, with a training of seconds.
const WIDE: &str = "
default: [eval]
stages:
  demo-scene:
    parameters: {size: 40, train: 24, test: 6, samples_per_axis: 2, angle: 100}
  prep:
    inputs: {dataset: demo-scene}
  train-ss:
    inputs: {scene: prep/train}
    parameters: {rays: 600000, n_levels: 6, cells_per_pixel: 2.56, log2_hashmap_size: 14, hidden_dim: 16, march_steps: 192, max_rays_per_step: 2048, samples_per_step: 32768}
  render-depth:
    inputs: {field: train-ss, cameras: prep/cameras}
  eval:
    inputs: {views: render-depth, truth: prep/truth}
";

fn psnr(project: &Project, projection: &str) -> f64 {
    let metrics = project.json("eval", "metrics.json", &["-p", projection]);
    metrics["mean"]["psnr"].as_f64().unwrap()
}

/// Fisheye and pinhole photographs are 100° wide, from equal positions, with equally many pixels
/// per degree in the middle. Both fields are scored on the same pinhole views. The fisheye scene's
/// test views and camera path are a pinhole camera's.
#[test]
fn fisheye_photographs_are_as_good_as_a_pinhole_cameras() {
    let project = Project::new(WIDE);
    let [fisheye, pinhole] = ["projection=fisheye", "projection=perspective"].map(|projection| {
        project.ok(&["run", "-p", projection]);
        psnr(&project, projection)
    });
    println!("{fisheye:.2} dB from fisheye photographs, {pinhole:.2} dB from a pinhole's");
    assert!(pinhole > 20.0 && fisheye > pinhole - 0.3, "{fisheye} dB, a pinhole's {pinhole} dB");
    let arguments = ["-p", "projection=fisheye"];
    let scene = project.artifact("prep", &arguments);
    let is_fisheye = |subtree: &str| {
        let views = Views::read_folder(&scene.join(subtree)).unwrap();
        views.views.iter().all(|view| view.camera.intrinsics.distortion.is_fisheye())
    };
    assert_eq!(
        ["train", "downscaled", "cameras", "truth"].map(is_fisheye),
        [true, true, false, false]
    );
    let camera_path = project.path("film");
    let train = scene.join("train");
    assert_eq!(
        stage("camera-path", r#"{"frames": 1}"#, &[("cameras", &train)], &camera_path, &[]).code,
        0
    );
    let intrinsics = Views::read_folder(&camera_path).unwrap().views[0].camera.intrinsics;
    assert!(intrinsics.distortion.is_none());
    let [horizontal_angle, _] = intrinsics.pinhole_angles();
    assert!((99.0..=100.01).contains(&horizontal_angle), "{horizontal_angle}");
}

fn demo_fisheye(project: &Project, angle: u32) -> std::path::PathBuf {
    let data = project.path(&format!("data-{angle}"));
    let params = format!(
        r#"{{"size": 24, "train": 8, "test": 2, "samples_per_axis": 1, "form": "transforms",
            "projection": "fisheye", "angle": {angle}}}"#
    );
    assert_eq!(stage("demo-scene", &params, &[], &data, &[]).code, 0);
    data
}

fn notes(scene: &Path) -> Vec<String> {
    let text = std::fs::read(scene.join("scene.json")).unwrap();
    let scene: Value = serde_json::from_slice(&text).unwrap();
    serde_json::from_value(scene["notes"].clone()).unwrap()
}

/// Pixels more than 89° from the axis are masked and counted; with `lens: undo` nothing is masked,
/// and the pinhole camera's angle of view is logged.
#[test]
fn pixels_beyond_a_fisheye_lens_are_masked() {
    let project = Project::tiny();
    let data = demo_fisheye(&project, 160);
    let scene = project.path("scene");
    let finished = stage("prep", "{}", &[("dataset", &data)], &scene, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    let views = Views::read_folder(&scene.join("train")).unwrap();
    let mut masked = 0;
    for view in &views.views {
        let intrinsics = view.camera.intrinsics;
        let mask = view.mask.as_ref().unwrap();
        let mask = pixels::Mask::read(
            &scene.join("train").join(mask),
            (intrinsics.width as usize, intrinsics.height as usize),
        )
        .unwrap();
        for (i, counts) in mask.counts.iter().enumerate() {
            let position = [i % mask.width, i / mask.width].map(|v| v as f64 + 0.5);
            assert_eq!(
                *counts,
                !intrinsics.is_clamped(position),
                "pixel {i} of {}",
                view.camera.name
            );
        }
        masked += mask.counts.iter().filter(|counts| !**counts).count();
    }
    assert!(masked > 8, "{masked}");
    let expected = format!(
        "{masked} pixels of 8 photographs are more than 89° from the axis of a fisheye lens and are \
        masked"
    );
    assert!(notes(&scene).contains(&expected), "{expected}: {:?}", notes(&scene));
    // Black corners are not the scene's background, and a box may not contain the scene behind.
    let scene_json: Value =
        serde_json::from_slice(&std::fs::read(scene.join("scene.json")).unwrap()).unwrap();
    assert_eq!(scene_json["background"], "opaque");
    let undistorted = project.path("undone");
    let finished = stage("prep", r#"{"lens": "undo"}"#, &[("dataset", &data)], &undistorted, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    let beginning = "8 fisheye photographs are resampled to pinhole cameras with a field of view of \
        100.0°×100.0°";
    assert!(
        notes(&undistorted).iter().any(|note| note.starts_with(beginning)),
        "{:?}",
        notes(&undistorted)
    );
    let views = Views::read_folder(&undistorted.join("train")).unwrap();
    assert!(
        views.views.iter().all(|v| v.mask.is_none() && v.camera.intrinsics.distortion.is_none())
    );
}

/// NDC's frustum can't contain a fisheye view, and a lens whose polynomial folds back has no rays.
#[test]
fn ndc_and_folding_lenses_are_refused() {
    let project = Project::tiny();
    let data = demo_fisheye(&project, 120);
    let out = project.path("out");
    stage("prep", r#"{"space": "ndc"}"#, &[("dataset", &data)], &out, &[])
        .fails(2, &["parameter space: ndc", "fisheye", "contraction"]);
    let file = data.join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    let mut transforms: Value = serde_json::from_str(&text).unwrap();
    transforms["frames"][3]["k1"] = json!(-0.4);
    let folded = project.path("folded");
    std::fs::create_dir(&folded).unwrap();
    std::os::unix::fs::symlink(data.join("images"), folded.join("images")).unwrap();
    std::fs::write(folded.join("transforms.json"), transforms.to_string()).unwrap();
    stage("prep", "{}", &[("dataset", &folded)], &out, &[])
        .fails(3, &["frame train_3", "fisheye, k1 -0.4", "lens: undo"]);
}

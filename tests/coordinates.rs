//! One scene in other coordinates: moved, turned, in other units. Training, rendering and export
//! give the same results, in the coordinates of the input's cameras.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::{Path, PathBuf};

use artifact::GivenInput;
use common::splats::{read_ply, vectors};
use common::surfaces::Glb;
use common::{Project, stage};
use fields::{FIELD_FILE, FieldFile};
use glam::{DMat3, DVec3};
use radiance::{NormalizedRay, Ray, clip};
use scene::{Bounds, Views};
use serde_json::{Value, json};

/// Position of a town in UTM coordinates, in metres.
const UTM: DVec3 = DVec3::new(500_000.0, 4_649_776.0, 120.0);
/// Position of a town in ECEF coordinates, in metres.
const ECEF: DVec3 = DVec3::new(4_027_893.75, 307_045.625, 4_919_474.875);

/// Steps per unit of length; camera centres are rounded to steps, so that shifts are exact.
const STEPS_PER_UNIT: f64 = 1_048_576.0;

/// Number of training rays after which a field has begun to resemble the scene.
const FEW_RAYS: u32 = 20_000;
/// Number of training rays after which a field renders the scene recognisably.
const ENOUGH_RAYS: u32 = 250_000;

/// Position, orientation and unit of a scene in its coordinates.
#[derive(Clone, Copy)]
struct Placement {
    rotation: DMat3,
    scale: f64,
    shift: DVec3,
}

const IDENTITY: Placement = Placement { rotation: DMat3::IDENTITY, scale: 1.0, shift: DVec3::ZERO };

fn moved(shift: DVec3) -> Placement {
    Placement { shift, ..IDENTITY }
}

fn scaled(scale: f64) -> Placement {
    Placement { scale, ..IDENTITY }
}

impl Placement {
    fn transform_point(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.shift
    }

    /// Transforms a `transform_matrix`, whose camera centre is rounded first.
    fn transform_camera(&self, matrix: &mut Value) {
        let number = |matrix: &Value, r: usize, c: usize| matrix[r][c].as_f64().unwrap();
        let columns = [0, 1, 2, 3].map(|c| DVec3::from([0, 1, 2].map(|r| number(matrix, r, c))));
        let [right, up, back] = [0, 1, 2].map(|c| self.rotation * columns[c]);
        let centre = self.transform_point((STEPS_PER_UNIT * columns[3]).round() / STEPS_PER_UNIT);
        for row in 0..3 {
            matrix[row] = json!([right[row], up[row], back[row], centre[row]]);
        }
    }
}

/// Outputs of the stages for one data set.
struct Outputs {
    scene: PathBuf,
    field: PathBuf,
    views: PathBuf,
    psnr: f64,
}

/// Returns the parameters of `train-ss`.
fn training_parameters(rays: u32) -> String {
    let params = json!({
        "rays": rays,
        "n_levels": 4,
        "cells_per_pixel": 1.28,
        "log2_hashmap_size": 12,
        "hidden_dim": 16,
        "march_steps": 128,
        "max_rays_per_step": 2048,
        "samples_per_step": 16384,
    });
    params.to_string()
}

/// Places the demo scene, and prepares, trains, renders and scores it.
fn run_stages(project: &Project, name: &str, placement: &Placement, rays: u32) -> Outputs {
    let folder = |part: &str| project.path(&format!("{name}-{part}"));
    let [data, scene, field, views, scores] =
        ["data", "scene", "field", "views", "scores"].map(folder);
    write_placed(&demo_scene(project), &data, placement);
    let [train, cameras, truth] = ["train", "cameras", "truth"].map(|part| scene.join(part));
    run("prep", r#"{"lr_width": 24}"#, &[("dataset", &data)], &scene);
    run("train-ss", &training_parameters(rays), &[("scene", &train)], &field);
    run("render-depth", "{}", &[("field", &field), ("cameras", &cameras)], &views);
    run("eval", "{}", &[("views", &views), ("truth", &truth)], &scores);
    let psnr = read(&scores.join("metrics.json"))["mean"]["psnr"].as_f64().unwrap();
    Outputs { scene, field, views, psnr }
}

#[track_caller]
fn run(name: &str, params: &str, inputs: &[(&str, &Path)], output: &Path) {
    let finished = stage(name, params, inputs, output, &[]);
    assert_eq!(finished.code, 0, "{name}: {}", finished.stderr);
}

/// Returns the demo scene's folder, which is created on first use.
fn demo_scene(project: &Project) -> PathBuf {
    let folder = project.path("demo");
    if !folder.exists() {
        let params = r#"{"size": 48, "train": 16, "test": 4, "samples_per_axis": 2}"#;
        run("demo-scene", params, &[], &folder);
    }
    folder
}

/// Writes a copy of a data set with transformed cameras, linked images and no depth.
fn write_placed(from: &Path, to: &Path, placement: &Placement) {
    std::fs::create_dir_all(to).unwrap();
    for split in ["train", "test"] {
        let name = format!("transforms_{split}.json");
        let mut list = read(&from.join(&name));
        for frame in list["frames"].as_array_mut().unwrap() {
            frame.as_object_mut().unwrap().remove("depth_file_path");
            placement.transform_camera(&mut frame["transform_matrix"]);
        }
        std::fs::write(to.join(name), list.to_string()).unwrap();
        std::os::unix::fs::symlink(from.join(split), to.join(split)).unwrap();
    }
}

fn read(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Returns a field's bounds and training views.
fn bounds_and_views(outputs: &Outputs) -> (Bounds, Views) {
    let file: FieldFile = serde_json::from_value(read(&outputs.field.join(FIELD_FILE))).unwrap();
    let train = GivenInput::open("scene", &outputs.scene.join("train")).unwrap();
    (file.bounds, Views::read(&train).unwrap())
}

/// Returns the rays of all training pixels in the field's unit cube: origin, direction, and the
/// distances at which the ray enters and leaves the cube.
fn cube_rays(outputs: &Outputs) -> Vec<[f32; 8]> {
    let (bounds, views) = bounds_and_views(outputs);
    let positions =
        (0..24).flat_map(|y| (0..24).map(move |x| (f64::from(x) + 0.5, f64::from(y) + 0.5)));
    let mut rays = Vec::new();
    for view in views.views {
        for (x, y) in positions.clone() {
            let ray = Ray::new(&view.camera.ray(x, y), [0.0; 3]);
            let NormalizedRay { origin, direction, enter, leave, .. } = clip(&bounds, &ray);
            let ([a, b, c], [d, e, f]) = (origin, direction);
            rays.push([a, b, c, d, e, f, enter, leave]);
        }
    }
    rays
}

fn max_difference(a: &[[f32; 8]], b: &[[f32; 8]]) -> f32 {
    assert_eq!(a.len(), b.len());
    let pairs = a.as_flattened().iter().zip(b.as_flattened());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

fn weights(outputs: &Outputs) -> Vec<u8> {
    std::fs::read(outputs.field.join(FieldFile::member_file(0))).unwrap()
}

/// Shifts that are exact in f64, and powers of two as units, change no bit of a field. Exact shifts
/// change no bit of the rendered views either.
#[test]
fn exact_shifts_and_units_give_equal_bytes() {
    let project = Project::tiny();
    let here = run_stages(&project, "here", &IDENTITY, FEW_RAYS);
    let expected = weights(&here);
    for (i, shift) in [DVec3::new(1024.0, -0.25, 3.0), UTM, ECEF].into_iter().enumerate() {
        let there = run_stages(&project, &format!("moved-{i}"), &moved(shift), FEW_RAYS);
        assert!(weights(&there) == expected, "moved by {shift}");
        assert_eq!(cube_rays(&there), cube_rays(&here), "moved by {shift}");
        for view in Views::read_folder(&here.views).unwrap().views {
            let file = view.image.unwrap();
            let [a, b] =
                [&here, &there].map(|outputs| std::fs::read(outputs.views.join(&file)).unwrap());
            assert!(a == b, "{file}, moved by {shift}");
        }
        let bounds = bounds_and_views(&here).0.moved(shift);
        assert_eq!(bounds_and_views(&there).0, bounds);
    }
    for scale in [1.0 / 131_072.0, 65_536.0] {
        let there = run_stages(&project, &format!("scaled-{scale}"), &scaled(scale), FEW_RAYS);
        assert!(weights(&there) == expected, "times {scale}");
        assert_eq!(there.psnr, here.psnr);
    }
}

/// Other shifts and units, which round each camera, give equal rays to a millionth of the cube, and
/// equally good fields.
#[test]
fn other_coordinates_give_the_same_rays_and_quality() {
    let project = Project::tiny();
    let here = run_stages(&project, "here", &IDENTITY, ENOUGH_RAYS);
    let inexact = DVec3::new(0.1, 0.2, 0.3);
    let rotation = DMat3::from_axis_angle(DVec3::new(0.3, -0.5, 0.8).normalize(), 1.1);
    for (name, placement, tolerance) in [
        ("small", scaled(1e-5), 0.15),
        ("large", scaled(1e5), 0.15),
        ("utm", moved(UTM + inexact), 0.15),
        ("ecef", moved(ECEF + inexact), 0.15),
        // The cells of a rotated cube follow silhouettes less closely.
        ("turned", Placement { rotation, ..IDENTITY }, 0.6),
    ] {
        let there = run_stages(&project, name, &placement, ENOUGH_RAYS);
        println!("{name}: {:.3} dB, here {:.3} dB", there.psnr, here.psnr);
        assert!(
            (there.psnr - here.psnr).abs() <= tolerance,
            "{name}: {} {}",
            there.psnr,
            here.psnr
        );
        if name != "turned" {
            let difference = max_difference(&cube_rays(&there), &cube_rays(&here));
            assert!(difference <= 1e-6, "{name}: {difference}");
        }
    }
}

/// Exported points, splats and meshes of a scene far from the origin are in the input's coordinates
/// after their offset is added. Text files need no offset.
#[test]
fn exported_points_return_to_the_inputs_coordinates() {
    let project = Project::tiny();
    let export = |name: &str, placement: &Placement| {
        let outputs = run_stages(&project, name, placement, ENOUGH_RAYS);
        let (output, cameras) =
            (project.path(&format!("{name}-export")), outputs.scene.join("train-cameras"));
        let inputs = [("field", &*outputs.field), ("cameras", &*cameras)];
        let finished =
            stage("export", r#"{"resolution": 48}"#, &inputs, &output, &["--progress", "plain"]);
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        (output, finished.stderr, outputs)
    };
    let (here, stderr, _) = export("here", &IDENTITY);
    assert!(!here.join("offset.json").exists() && !stderr.contains("offset"), "{stderr}");
    let placement = Placement { scale: 64.0, ..moved(UTM) };
    let (there, stderr, outputs) = export("there", &placement);
    assert!(
        stderr.contains("points.ply, splats.ply, mesh.glb, mesh.ply lack the offset (5"),
        "{stderr}"
    );
    let size = bounds_and_views(&outputs).0.longest_side();
    let offset = read(&there.join("offset.json"));
    assert_eq!(offset["files"], json!(["points.ply", "splats.ply", "mesh.glb", "mesh.ply"]));
    let offset = DVec3::from([0, 1, 2].map(|i| offset["offset"][i].as_f64().unwrap()));
    let xyz = ["x", "y", "z"];
    let ply = |folder: &Path, file: &str| vectors(&read_ply(&folder.join(file)), xyz);
    let glb = |folder: &Path| Glb::read(&folder.join("mesh.glb")).positions;
    for (file, [local, expected]) in [
        ("points.ply", [&there, &here].map(|folder| ply(folder, "points.ply"))),
        ("splats.ply", [&there, &here].map(|folder| ply(folder, "splats.ply"))),
        ("mesh.glb", [&there, &here].map(|folder| glb(folder))),
        ("mesh.ply", [&there, &here].map(|folder| ply(folder, "mesh.ply"))),
        ("points3D.txt", [colmap_points(&there, offset), colmap_points(&here, DVec3::ZERO)]),
    ] {
        assert!(local.len() == expected.len() && local.len() > 100, "{file}");
        for (local, expected) in local.into_iter().zip(expected) {
            let error = (local + offset - placement.transform_point(expected)).length() / size;
            assert!(error <= 1e-6, "{file}: {local} + {offset}, {expected}");
        }
    }
    // Exported cameras equal the input's.
    let cameras = Views::read_folder(&outputs.scene.join("train-cameras")).unwrap().views;
    let frames = &read(&there.join("transforms.json"))["frames"];
    for (i, view) in cameras.iter().enumerate() {
        for (row, expected) in view.camera.camera_to_world.iter().enumerate() {
            assert_eq!(frames[i]["transform_matrix"][row], json!(expected));
        }
    }
    // Programs expect a camera file's points in the coordinates of its cameras.
    assert_eq!(read(&there.join("transforms.json")).get("ply_file_path"), None);
    assert_eq!(read(&here.join("transforms.json"))["ply_file_path"], "points.ply");
}

/// Returns the points of a COLMAP model, minus an offset.
fn colmap_points(folder: &Path, offset: DVec3) -> Vec<DVec3> {
    let text = std::fs::read_to_string(folder.join("colmap/sparse/0/points3D.txt")).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    let numbers = lines.map(|line| line.split(' ').map(|word| word.parse().unwrap()).collect());
    numbers.map(|n: Vec<f64>| DVec3::new(n[1], n[2], n[3]) - offset).collect()
}

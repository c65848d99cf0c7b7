//! One scene in other coordinates: moved, turned, in other units. What is trained, rendered and
//! exported is the same, and lies where the input's cameras say.

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

/// A town in UTM coordinates, and one in ECEF coordinates.
const UTM: DVec3 = DVec3::new(500_000.0, 4_649_776.0, 120.0);
const ECEF: DVec3 = DVec3::new(4_027_893.75, 307_045.625, 4_919_474.875);

/// Centres are multiples of its inverse, so that shifts are exact.
const GRID: f64 = 1_048_576.0;

/// Rays of a training that begins to see the scene, and of one that ends with a picture of it.
const FEW_RAYS: u32 = 20_000;
const ENOUGH_RAYS: u32 = 250_000;

/// Position, orientation and unit of a scene in its coordinates.
#[derive(Clone, Copy)]
struct Placement {
    turn: DMat3,
    scale: f64,
    shift: DVec3,
}

const HERE: Placement = Placement { turn: DMat3::IDENTITY, scale: 1.0, shift: DVec3::ZERO };

fn moved(shift: DVec3) -> Placement {
    Placement { shift, ..HERE }
}

fn scaled(scale: f64) -> Placement {
    Placement { scale, ..HERE }
}

impl Placement {
    fn of(&self, point: DVec3) -> DVec3 {
        self.scale * (self.turn * point) + self.shift
    }

    /// Places a `transform_matrix`.
    fn place(&self, matrix: &mut Value) {
        let number = |matrix: &Value, r: usize, c: usize| matrix[r][c].as_f64().unwrap();
        let columns = [0, 1, 2, 3].map(|c| DVec3::from([0, 1, 2].map(|r| number(matrix, r, c))));
        let [right, up, back] = [0, 1, 2].map(|c| self.turn * columns[c]);
        let centre = self.of((GRID * columns[3]).round() / GRID);
        for row in 0..3 {
            matrix[row] = json!([right[row], up[row], back[row], centre[row]]);
        }
    }
}

/// A data set and what is made of it.
struct Made {
    scene: PathBuf,
    field: PathBuf,
    views: PathBuf,
    psnr: f64,
}

/// Parameters of a training.
fn training(rays: u32) -> String {
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

/// Makes the data set, scene, field and views of a demo scene that is placed.
fn made(project: &Project, name: &str, placement: &Placement, rays: u32) -> Made {
    let folder = |part: &str| project.path(&format!("{name}-{part}"));
    let [data, scene, field, views, scores] =
        ["data", "scene", "field", "views", "scores"].map(folder);
    place(&demo(project), &data, placement);
    let [train, cameras, truth] = ["train", "cameras", "truth"].map(|part| scene.join(part));
    run("prep", r#"{"lr_width": 24}"#, &[("dataset", &data)], &scene);
    run("train-ss", &training(rays), &[("scene", &train)], &field);
    run("render-depth", "{}", &[("field", &field), ("cameras", &cameras)], &views);
    run("eval", "{}", &[("views", &views), ("truth", &truth)], &scores);
    let psnr = read(&scores.join("metrics.json"))["mean"]["psnr"].as_f64().unwrap();
    Made { scene, field, views, psnr }
}

#[track_caller]
fn run(name: &str, params: &str, inputs: &[(&str, &Path)], output: &Path) {
    let finished = stage(name, params, inputs, output, &[]);
    assert_eq!(finished.code, 0, "{name}: {}", finished.stderr);
}

/// The demo scene's folder, without depth.
fn demo(project: &Project) -> PathBuf {
    let folder = project.path("demo");
    if !folder.exists() {
        let params = r#"{"size": 48, "train": 16, "test": 4, "samples_per_axis": 2}"#;
        run("demo-scene", params, &[], &folder);
    }
    folder
}

/// Writes a data set with placed cameras, and links to the images of another.
fn place(from: &Path, to: &Path, placement: &Placement) {
    std::fs::create_dir_all(to).unwrap();
    for split in ["train", "test"] {
        let name = format!("transforms_{split}.json");
        let mut list = read(&from.join(&name));
        for frame in list["frames"].as_array_mut().unwrap() {
            frame.as_object_mut().unwrap().remove("depth_file_path");
            placement.place(&mut frame["transform_matrix"]);
        }
        std::fs::write(to.join(name), list.to_string()).unwrap();
        std::os::unix::fs::symlink(from.join(split), to.join(split)).unwrap();
    }
}

fn read(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Bounds of a field, and the views that it was trained on.
fn trained_in(made: &Made) -> (Bounds, Views) {
    let file: FieldFile = serde_json::from_value(read(&made.field.join(FIELD_FILE))).unwrap();
    let train = GivenInput::open("scene", &made.scene.join("train")).unwrap();
    (file.bounds, Views::read(&train).unwrap())
}

/// Rays of all training views in the field's unit cube, each by some numbers.
fn cube_rays(made: &Made) -> Vec<[f32; 8]> {
    let (bounds, views) = trained_in(made);
    let places =
        (0..24).flat_map(|y| (0..24).map(move |x| (f64::from(x) + 0.5, f64::from(y) + 0.5)));
    let mut rays = Vec::new();
    for view in views.views {
        for (x, y) in places.clone() {
            let ray = Ray::new(&view.camera.ray(x, y), [0.0; 3]);
            let NormalizedRay { origin, direction, enter, leave, .. } = clip(&bounds, &ray);
            let ([a, b, c], [d, e, f]) = (origin, direction);
            rays.push([a, b, c, d, e, f, enter, leave]);
        }
    }
    rays
}

fn farthest_apart(a: &[[f32; 8]], b: &[[f32; 8]]) -> f32 {
    assert_eq!(a.len(), b.len());
    let pairs = a.as_flattened().iter().zip(b.as_flattened());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// Weights of a field.
fn weights(made: &Made) -> Vec<u8> {
    std::fs::read(made.field.join(FieldFile::member_file(0))).unwrap()
}

/// Shifts that are exact in f64, and powers of two as units, change no bit of a field; shifts
/// change no bit of its views, either.
#[test]
fn exact_shifts_and_units_give_equal_bytes() {
    let project = Project::tiny();
    let here = made(&project, "here", &HERE, FEW_RAYS);
    let expected = weights(&here);
    for (i, shift) in [DVec3::new(1024.0, -0.25, 3.0), UTM, ECEF].into_iter().enumerate() {
        let there = made(&project, &format!("moved-{i}"), &moved(shift), FEW_RAYS);
        assert!(weights(&there) == expected, "moved by {shift}");
        assert_eq!(cube_rays(&there), cube_rays(&here), "moved by {shift}");
        for view in Views::read_folder(&here.views).unwrap().views {
            let file = view.image.unwrap();
            let [a, b] = [&here, &there].map(|made| std::fs::read(made.views.join(&file)).unwrap());
            assert!(a == b, "{file}, moved by {shift}");
        }
        let bounds = trained_in(&here).0.moved(shift);
        assert_eq!(trained_in(&there).0, bounds);
    }
    for scale in [1.0 / 131_072.0, 65_536.0] {
        let there = made(&project, &format!("scaled-{scale}"), &scaled(scale), FEW_RAYS);
        assert!(weights(&there) == expected, "times {scale}");
        assert_eq!(there.psnr, here.psnr);
    }
}

/// Other shifts and units, which round each camera, give the same rays to a millionth of the cube,
/// and fields that are as good.
#[test]
fn other_coordinates_give_the_same_rays_and_quality() {
    let project = Project::tiny();
    let here = made(&project, "here", &HERE, ENOUGH_RAYS);
    let rounded = DVec3::new(0.1, 0.2, 0.3);
    let turn = DMat3::from_axis_angle(DVec3::new(0.3, -0.5, 0.8).normalize(), 1.1);
    for (name, placement, most) in [
        ("small", scaled(1e-5), 0.15),
        ("large", scaled(1e5), 0.15),
        ("utm", moved(UTM + rounded), 0.15),
        ("ecef", moved(ECEF + rounded), 0.15),
        // The cells of a turned cube follow silhouettes less closely.
        ("turned", Placement { turn, ..HERE }, 0.6),
    ] {
        let there = made(&project, name, &placement, ENOUGH_RAYS);
        println!("{name}: {:.3} dB, here {:.3} dB", there.psnr, here.psnr);
        assert!((there.psnr - here.psnr).abs() <= most, "{name}: {} {}", there.psnr, here.psnr);
        if name != "turned" {
            let apart = farthest_apart(&cube_rays(&there), &cube_rays(&here));
            assert!(apart <= 1e-6, "{name}: {apart}");
        }
    }
}

/// Points, splats and mesh of a scene far from the origin come back to the input's coordinates with
/// their offset, and files with text need none.
#[test]
fn exported_points_return_to_the_inputs_coordinates() {
    let project = Project::tiny();
    let exported = |name: &str, placement: &Placement| {
        let made = made(&project, name, placement, ENOUGH_RAYS);
        let (output, cameras) =
            (project.path(&format!("{name}-export")), made.scene.join("train-cameras"));
        let inputs = [("field", &*made.field), ("cameras", &*cameras)];
        let finished =
            stage("export", r#"{"resolution": 48}"#, &inputs, &output, &["--progress", "plain"]);
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        (output, finished.stderr, made)
    };
    let (here, said, _) = exported("here", &HERE);
    assert!(!here.join("offset.json").exists() && !said.contains("offset"), "{said}");
    let placement = Placement { scale: 64.0, ..moved(UTM) };
    let (there, said, made) = exported("there", &placement);
    assert!(
        said.contains("points.ply, splats.ply, mesh.glb, mesh.ply lack the offset (5"),
        "{said}"
    );
    let size = trained_in(&made).0.longest_side();
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
            let off = (local + offset - placement.of(expected)).length() / size;
            assert!(off <= 1e-6, "{file}: {local} + {offset}, {expected}");
        }
    }
    // Cameras are the input's themselves.
    let cameras = Views::read_folder(&made.scene.join("train-cameras")).unwrap().views;
    let frames = &read(&there.join("transforms.json"))["frames"];
    for (i, view) in cameras.iter().enumerate() {
        for (row, expected) in view.camera.camera_to_world.iter().enumerate() {
            assert_eq!(frames[i]["transform_matrix"][row], json!(expected));
        }
    }
    // Programs take cameras and the points that they name to have one frame.
    assert_eq!(read(&there.join("transforms.json")).get("ply_file_path"), None);
    assert_eq!(read(&here.join("transforms.json"))["ply_file_path"], "points.ply");
}

/// Points of a COLMAP model, less an offset.
fn colmap_points(folder: &Path, offset: DVec3) -> Vec<DVec3> {
    let text = std::fs::read_to_string(folder.join("colmap/sparse/0/points3D.txt")).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    let numbers = lines.map(|line| line.split(' ').map(|word| word.parse().unwrap()).collect());
    numbers.map(|n: Vec<f64>| DVec3::new(n[1], n[2], n[3]) - offset).collect()
}

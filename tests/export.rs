//! `nerf-sr run export`: files that other programs open, compared with the demo scene's own surface
//! and images.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

use artifact::GivenInput;
use common::browser::run_in_browser;
use common::splats::{Splat, read_ply, read_splats, render_splats, vectors};
use common::surfaces::{Compared, Glb, compare, true_surface};
use common::{Finished, Project, stage};
use demo_scene::World;
use glam::DVec3;
use pixels::{Filter, Image, Resampling, psnr_of, read_premultiplied};
use scene::{Camera, View, Views};
use serde_json::Value;

/// Grid of points of the true surface.
const CELL: f64 = 0.008;
/// Factor by which splats are drawn wider than the images, as in a viewer's window, then shrunk.
const ENLARGED: u32 = 4;
/// Decibels of the splats after a short training, in the mean; 043 has figures.
const LEAST_SPLATS: f64 = 24.0;

/// Inputs of a measurement: the exported files, the cameras they were made from, and the test
/// images.
struct Exported {
    files: PathBuf,
    cameras: PathBuf,
    truth: PathBuf,
}

/// The demo scene after a short training.
fn short_training() -> Project {
    let project = Project::shipped(&["export"], "");
    project.replace("{size: 48, train: 12, test: 3, samples_per_axis: 2}", "{train: 40, test: 3}");
    project.replace("{lr_width: 24, scale: 2}", "{scale: 2}");
    let text = std::fs::read_to_string(project.path("base/pipeline.yaml")).unwrap();
    let line = text.lines().find(|line| line.contains("n_levels")).unwrap();
    project.replace(line, "    parameters: {rays: 800000}");
    project
}

#[test]
fn exported_files_show_the_demo_scene() {
    let project = short_training();
    let said = project.ok(&["run", "export"]);
    for words in [
        "export: ./out/export\n",
        "export: ./out/export/mesh.glb, ",
        "export: ./out/export/colmap/, 3 files, ",
    ] {
        assert!(said.contains(words), "{said}");
    }
    let exported = exported_by(&project, &["export"]);
    assert_eq!(
        std::fs::read(project.path("out/export/mesh.ply")).unwrap(),
        std::fs::read(exported.files.join("mesh.ply")).unwrap()
    );
    assert_near("mesh", exported.mesh());
    assert_near("points", exported.points());
    // By the reference renderer, over the field's background.
    assert_shown(&exported.splats(1.0), LEAST_SPLATS);
    if let Some(scores) = seen_in_viewer(&exported) {
        assert_shown(&scores, LEAST_SPLATS);
    }
    if let Some(read) = read_by_others(&exported) {
        assert_same_files(&exported, &read);
        assert_same_cameras(&exported, &read);
    }
}

fn exported_by(project: &Project, arguments: &[&str]) -> Exported {
    let folder = |stage: &str| project.artifact(stage, arguments);
    Exported {
        files: folder("exported"),
        cameras: folder("prep").join("train-cameras"),
        truth: folder("prep").join("truth"),
    }
}

fn cameras(folder: &Path) -> Vec<Camera> {
    let views = Views::read(&GivenInput::open("cameras", folder).unwrap()).unwrap();
    views.views.into_iter().map(|view| view.camera).collect()
}

/// A camera turned by 180° around the x axis.
fn turned_below(camera: &Camera) -> Camera {
    let [x, y, z] = camera.camera_to_world;
    Camera { camera_to_world: [x, y.map(|v| -v), z.map(|v| -v)], ..camera.clone() }
}

fn splats_score(splats: &[Splat], input: &GivenInput, background: f32, view: &View) -> f64 {
    let image = read_premultiplied(&input.path(view.image.as_ref().unwrap())).unwrap();
    let drawn = render_splats(splats, &enlarged(&view.camera), f64::from(background));
    psnr(&image.over(background), &shrunk(&drawn))
}

impl Exported {
    /// Returns the part of the true surface that the training cameras observe.
    fn true_surface(&self) -> Vec<(DVec3, DVec3)> {
        true_surface(&World::new(0), &cameras(&self.cameras), CELL)
    }

    /// Returns that part and the one that mirrored cameras below the scene's middle observe.
    fn whole_surface(&self) -> Vec<(DVec3, DVec3)> {
        let above = cameras(&self.cameras);
        let below = above.iter().map(turned_below).collect::<Vec<_>>();
        true_surface(&World::new(0), &[above, below].concat(), CELL)
    }

    fn mesh(&self) -> Compared {
        let mesh = Glb::read(&self.files.join("mesh.glb"));
        compare(&World::new(0), &self.true_surface(), &mesh.positions, &mesh.normals)
    }

    fn points(&self) -> Compared {
        let columns = read_ply(&self.files.join("points.ply"));
        let [positions, normals] =
            [["x", "y", "z"], ["nx", "ny", "nz"]].map(|names| vectors(&columns, names));
        compare(&World::new(0), &self.true_surface(), &positions, &normals)
    }

    /// PSNR of each test view over a grey level, as the splats are rendered.
    fn splats(&self, background: f32) -> Vec<f64> {
        let splats = read_splats(&self.files.join("splats.ply"));
        let input = GivenInput::open("truth", &self.truth).unwrap();
        let views = Views::read(&input).unwrap().views;
        views.iter().map(|view| splats_score(&splats, &input, background, view)).collect()
    }
}

fn enlarged(camera: &Camera) -> Camera {
    let k = camera.intrinsics;
    camera.resized(ENLARGED * k.width, ENLARGED * k.height)
}

/// An image of an enlarged camera at the camera's size.
fn shrunk(image: &Image) -> Image {
    let to = [image.width, image.height].map(|side| side / ENLARGED as usize);
    Resampling::new(Filter::Box, (image.width, image.height), (to[0], to[1])).apply(image)
}

fn psnr(a: &Image, b: &Image) -> f64 {
    let error = a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a - b).powi(2));
    psnr_of(error.sum::<f64>() / a.data.len() as f64)
}

/// Not farther than a hundredth of the scene, with nearly all normals outwards; 043 has figures.
#[track_caller]
fn assert_near(what: &str, compared: Compared) {
    println!("{what}: {compared:?}");
    assert!(compared.to_truth < 0.01 && compared.from_truth < 0.01, "{what}: {compared:?}");
    assert!(compared.outward >= 0.96, "{what}: {compared:?}");
}

/// Fails below `least` dB in the mean. A mirrored or upside-down scene has about 12 dB.
#[track_caller]
fn assert_shown(scores: &[f64], least: f64) {
    println!("splats: {}", in_words(scores));
    assert!(scores.iter().sum::<f64>() >= least * scores.len() as f64, "{}", in_words(scores));
}

fn viewer_score(input: &GivenInput, drawn: &Path, view: &View) -> f64 {
    let image = read_premultiplied(&input.path(view.image.as_ref().unwrap())).unwrap();
    let path = drawn.join(format!("{}.png", view.camera.name));
    let shown = read_premultiplied(&path).unwrap().over(0.0);
    // Nothing of the scene is in the corner.
    let background = shown.data[0];
    psnr(&image.over(background), &shrunk(&shown))
}

/// PSNR of each test view, as a viewer of others draws it, over the background that it draws. None
/// without a browser.
fn seen_in_viewer(exported: &Exported) -> Option<Vec<f64>> {
    let drawn = tempfile::tempdir().unwrap();
    let input = GivenInput::open("truth", &exported.truth).unwrap();
    let mut views = Views::read(&input).unwrap();
    views.views.iter_mut().for_each(|view| view.camera = enlarged(&view.camera));
    let cameras = drawn.path().join("views.json");
    artifact::write_json(&cameras, &views).unwrap();
    let files = [exported.files.join("splats.ply"), cameras];
    let said =
        run_in_browser("splats.mjs", files.iter().map(PathBuf::as_path).chain([drawn.path()]))?;
    let count = read_ply(&files[0])["x"].len();
    assert_eq!(said, serde_json::json!({"count": count, "problems": []}));
    Some(views.views.iter().map(|view| viewer_score(&input, drawn.path(), view)).collect())
}

/// Points of the true surface with their normals, as PLY text.
fn write_truth(path: &Path, surface: &[(DVec3, DVec3)]) {
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", surface.len());
    ["x", "y", "z", "nx", "ny", "nz"]
        .iter()
        .for_each(|name| text += &format!("property float {name}\n"));
    text += "end_header\n";
    for (p, n) in surface {
        text += &format!("{} {} {} {} {} {}\n", p.x, p.y, p.z, n.x, n.y, n.z);
    }
    std::fs::write(path, text).unwrap();
}

/// Returns the results of trimesh, plyfile and pycolmap; `None` if one isn't installed.
fn read_by_others(exported: &Exported) -> Option<Value> {
    let modules = "import trimesh, plyfile, scipy";
    let has = Command::new("python3").args(["-c", modules]).output();
    if !has.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: no trimesh, plyfile or scipy (python3 -m pip install them)");
        return None;
    }
    let folder = tempfile::tempdir().unwrap();
    let [all, seen] = ["all.ply", "seen.ply"].map(|name| folder.path().join(name));
    write_truth(&all, &exported.whole_surface());
    write_truth(&seen, &exported.true_surface());
    let mut command = Command::new("python3");
    command.arg(common::root().join("scripts/check-export.py"));
    command.arg(&exported.files).args([&all, &seen]);
    let read = Finished::of(command.output().unwrap());
    assert_eq!(read.code, 0, "{}", read.stderr);
    Some(serde_json::from_str(&read.stdout).unwrap())
}

/// Fails unless other programs read all points, splats and triangles, near the true surface.
fn assert_same_files(exported: &Exported, read: &Value) {
    let summary: Value =
        serde_json::from_slice(&std::fs::read(exported.files.join("export.json")).unwrap())
            .unwrap();
    for kind in ["mesh", "points", "splats"] {
        let figure = |name: &str| read[kind][name].as_f64().unwrap();
        let compared = Compared {
            to_truth: figure("to_truth"),
            from_truth: figure("from_truth"),
            outward: figure("outward"),
        };
        assert_near(&format!("{kind}, read by others"), compared);
    }
    assert_eq!(read["mesh"]["triangles"], summary["triangles"]);
    assert_eq!(read["mesh"]["has_colours"], true);
    assert_eq!(
        (&read["mesh"]["kind"], &read["mesh"]["is_white"]),
        (&"vertex".into(), &false.into())
    );
    assert_eq!(read["points"]["count"], summary["points"]);
    assert_eq!(read["splats"]["count"], summary["splats"]);
}

/// Every camera's pose, as pycolmap reads it.
fn assert_same_cameras(exported: &Exported, read: &Value) {
    let cameras = cameras(&exported.cameras);
    assert_eq!(read["frames"], cameras.len());
    let Some(colmap) = read.get("colmap") else {
        eprintln!("skipped: no pycolmap (python3 -m pip install pycolmap)");
        return;
    };
    for camera in &cameras {
        // Right, down, forward.
        let axes = camera.rotation();
        let [right, down, forward] = [axes.x_axis, -axes.y_axis, -axes.z_axis];
        let pose = &colmap["camera_to_world"][format!("{}.png", camera.name)];
        for row in 0..3 {
            let expected = [right[row], down[row], forward[row], camera.centre()[row]];
            for (column, expected) in expected.into_iter().enumerate() {
                let found = pose[row][column].as_f64().unwrap();
                assert!((found - expected).abs() < 1e-9, "{}: {pose}", camera.name);
            }
        }
    }
}

/// A tiny field, exported with some parameters by the stage alone.
fn tiny(project: &Project, params: &str, output: &str, more: &[&str]) -> Finished {
    project.ok(&["run", "train-ss"]);
    let (field, prep) = (project.artifact("train-ss", &[]), project.artifact("prep", &[]));
    let inputs = [("field", &*field), ("cameras", &prep.join("train-cameras"))];
    stage("export", params, &inputs, &project.path(output), more)
}

#[test]
fn any_number_of_threads_gives_the_same_files() {
    let project = Project::tiny();
    let params = r#"{"resolution": 48}"#;
    for (output, threads) in [("a", "1"), ("b", "3")] {
        let finished = tiny(&project, params, output, &["--threads", threads]);
        assert_eq!(finished.code, 0, "{}", finished.stderr);
    }
    let [a, b] = ["a", "b"].map(|output| common::manifest(&project.path(output)));
    assert_eq!(a, b);
    for file in
        ["points.ply", "splats.ply", "mesh.glb", "transforms.json", "colmap/sparse/0/images.txt"]
    {
        assert!(a.contains(file), "{file}: {a}");
    }
}

#[test]
fn the_mesh_may_be_left_out() {
    let project = Project::tiny();
    let some = r#"{"mesh": false, "max_points": 500}"#;
    assert_eq!(tiny(&project, some, "some", &[]).code, 0);
    let manifest = common::manifest(&project.path("some"));
    assert!(manifest.contains("points.ply") && !manifest.contains("mesh.glb"), "{manifest}");
    let count = read_ply(&project.path("some/points.ply"))["x"].len();
    assert!((100..=500).contains(&count), "{count} points");
}

/// Measures an artifact of `export`, `EXPORT`, that was made by the training cameras of a scene of
/// `prep`, `SCENE`: `docs/design/043-export.md` has the command.
#[test]
#[ignore = "measures folders given by EXPORT and SCENE"]
fn figures_of_the_demo_scene() {
    let [Some(files), Some(prep)] = ["EXPORT", "SCENE"].map(std::env::var_os) else {
        eprintln!("skipped: EXPORT and SCENE don't name an artifact of export and of prep");
        return;
    };
    let [files, prep] = [files, prep].map(PathBuf::from);
    let exported =
        Exported { files, cameras: prep.join("train-cameras"), truth: prep.join("truth") };
    println!("mesh: {:?}\npoints: {:?}", exported.mesh(), exported.points());
    for background in [1.0, 0.0] {
        println!("splats over {background}: {}", in_words(&exported.splats(background)));
    }
    if let Some(read) = read_by_others(&exported) {
        for kind in ["mesh", "points", "splats"] {
            println!("{kind}, read by others: {}", read[kind]);
        }
    }
    if let Some(scores) = seen_in_viewer(&exported) {
        println!("splats in the viewer: {}", in_words(&scores));
    }
}

fn in_words(scores: &[f64]) -> String {
    let mean = scores.iter().sum::<f64>() / scores.len() as f64;
    format!("{mean:.2} dB in the mean, {scores:.2?}")
}

//! Files of `nerf-sr run export`, also as other programs read them, compared with the demo scene's
//! true surface and images.

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

/// Cell size of the grid that spaces points of the true surface, in scene units.
const CELL_SIZE: f64 = 0.008;
/// Factor by which splats are rendered larger than the test images, as in a viewer's window.
const ENLARGEMENT: u32 = 4;
/// Minimum mean PSNR of splats after a short training, in dB; design note 043 has measurements.
const MIN_SPLAT_PSNR: f64 = 24.0;

/// Inputs of a comparison: the exported files, the training cameras and the test images.
struct Exported {
    files: PathBuf,
    cameras: PathBuf,
    truth: PathBuf,
}

/// Creates a project that trains briefly, on 40 views of the demo scene.
fn short_training_project() -> Project {
    let project = Project::shipped(&["export"], "");
    project.replace("{size: 48, train: 12, test: 3, samples_per_axis: 2}", "{train: 40, test: 3}");
    project.replace("{lr_width: 24, scale: 2}", "{scale: 2}");
    let text = std::fs::read_to_string(project.path("base/pipeline.yaml")).unwrap();
    let line = text.lines().find(|line| line.contains("n_levels")).unwrap();
    project.replace(line, "    parameters: {rays: 800000}");
    project
}

#[test]
fn exported_files_match_the_demo_scene() {
    let project = short_training_project();
    let output = project.ok(&["run", "export"]);
    for text in [
        "export: ./out/export\n",
        "export: ./out/export/mesh.glb, ",
        "export: ./out/export/colmap/, 3 files, ",
    ] {
        assert!(output.contains(text), "{output}");
    }
    let exported = exported_artifacts(&project, &["export"]);
    assert_eq!(
        std::fs::read(project.path("out/export/mesh.ply")).unwrap(),
        std::fs::read(exported.files.join("mesh.ply")).unwrap()
    );
    assert_near("mesh", exported.mesh_errors());
    assert_near("points", exported.point_errors());
    // The reference renderer, over the field's white background.
    assert_mean_psnr(&exported.splat_psnrs(1.0), MIN_SPLAT_PSNR);
    if let Some(psnrs) = viewer_psnrs(&exported) {
        assert_mean_psnr(&psnrs, MIN_SPLAT_PSNR);
    }
    if let Some(read) = read_by_other_programs(&exported) {
        assert_files_match(&exported, &read);
        assert_cameras_match(&exported, &read);
    }
}

fn exported_artifacts(project: &Project, arguments: &[&str]) -> Exported {
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

/// Returns a camera turned by 180° around the scene's x axis.
fn camera_below(camera: &Camera) -> Camera {
    let [x, y, z] = camera.camera_to_world;
    Camera { camera_to_world: [x, y.map(|v| -v), z.map(|v| -v)], ..camera.clone() }
}

fn splat_psnr(splats: &[Splat], input: &GivenInput, background: f32, view: &View) -> f64 {
    let image = read_premultiplied(&input.path(view.image.as_ref().unwrap())).unwrap();
    let drawn = render_splats(splats, &enlarged(&view.camera), f64::from(background));
    psnr(&image.over(background), &shrunk(&drawn))
}

impl Exported {
    /// Returns the part of the true surface that the training cameras observe.
    fn true_surface(&self) -> Vec<(DVec3, DVec3)> {
        true_surface(&World::new(0), &cameras(&self.cameras), CELL_SIZE)
    }

    /// Returns the part of the true surface that the cameras observe from above or, turned, below.
    fn surface_from_both_sides(&self) -> Vec<(DVec3, DVec3)> {
        let above = cameras(&self.cameras);
        let below = above.iter().map(camera_below).collect::<Vec<_>>();
        true_surface(&World::new(0), &[above, below].concat(), CELL_SIZE)
    }

    fn mesh_errors(&self) -> Compared {
        let mesh = Glb::read(&self.files.join("mesh.glb"));
        compare(&World::new(0), &self.true_surface(), &mesh.positions, &mesh.normals)
    }

    fn point_errors(&self) -> Compared {
        let columns = read_ply(&self.files.join("points.ply"));
        let [positions, normals] =
            [["x", "y", "z"], ["nx", "ny", "nz"]].map(|names| vectors(&columns, names));
        compare(&World::new(0), &self.true_surface(), &positions, &normals)
    }

    /// Returns the PSNR of each test view that is rendered from the splats over a grey level.
    fn splat_psnrs(&self, background: f32) -> Vec<f64> {
        let splats = read_splats(&self.files.join("splats.ply"));
        let input = GivenInput::open("truth", &self.truth).unwrap();
        let views = Views::read(&input).unwrap().views;
        views.iter().map(|view| splat_psnr(&splats, &input, background, view)).collect()
    }
}

fn enlarged(camera: &Camera) -> Camera {
    let k = camera.intrinsics;
    camera.resized(ENLARGEMENT * k.width, ENLARGEMENT * k.height)
}

/// Shrinks the image of an enlarged camera to the size of the original camera's image.
fn shrunk(image: &Image) -> Image {
    let [width, height] = [image.width, image.height].map(|side| side / ENLARGEMENT as usize);
    Resampling::new(Filter::Box, (image.width, image.height), (width, height)).apply(image)
}

fn psnr(a: &Image, b: &Image) -> f64 {
    let error = a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a - b).powi(2));
    psnr_of(error.sum::<f64>() / a.data.len() as f64)
}

/// Fails unless mean distances are below 1 % of the scene's size and at least 96 % of the normals
/// point outwards.
#[track_caller]
fn assert_near(name: &str, compared: Compared) {
    println!("{name}: {compared:?}");
    assert!(compared.to_truth < 0.01 && compared.from_truth < 0.01, "{name}: {compared:?}");
    assert!(compared.outward >= 0.96, "{name}: {compared:?}");
}

/// Fails if the mean PSNR is below `min` dB. A mirrored or upside-down scene has about 12 dB.
#[track_caller]
fn assert_mean_psnr(psnrs: &[f64], min: f64) {
    println!("splats: {}", format_psnrs(psnrs));
    assert!(psnrs.iter().sum::<f64>() >= min * psnrs.len() as f64, "{}", format_psnrs(psnrs));
}

fn viewer_psnr(input: &GivenInput, folder: &Path, view: &View) -> f64 {
    let image = read_premultiplied(&input.path(view.image.as_ref().unwrap())).unwrap();
    let path = folder.join(format!("{}.png", view.camera.name));
    let drawn = read_premultiplied(&path).unwrap().over(0.0);
    // The corner contains only the viewer's background.
    let background = drawn.data[0];
    psnr(&image.over(background), &shrunk(&drawn))
}

/// Returns the PSNR of each test view that another project's viewer draws, over the viewer's
/// background; `None` without a browser.
fn viewer_psnrs(exported: &Exported) -> Option<Vec<f64>> {
    let folder = tempfile::tempdir().unwrap();
    let input = GivenInput::open("truth", &exported.truth).unwrap();
    let mut views = Views::read(&input).unwrap();
    views.views.iter_mut().for_each(|view| view.camera = enlarged(&view.camera));
    let cameras = folder.path().join("views.json");
    artifact::write_json(&cameras, &views).unwrap();
    let files = [exported.files.join("splats.ply"), cameras];
    let report =
        run_in_browser("splats.mjs", files.iter().map(PathBuf::as_path).chain([folder.path()]))?;
    let count = read_ply(&files[0])["x"].len();
    assert_eq!(report, serde_json::json!({"count": count, "problems": []}));
    Some(views.views.iter().map(|view| viewer_psnr(&input, folder.path(), view)).collect())
}

/// Writes points of the true surface with their normals as a text PLY file.
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

/// Reads the exported files by trimesh, plyfile and, where installed, pycolmap. Returns `None` if
/// trimesh, plyfile or scipy isn't installed.
fn read_by_other_programs(exported: &Exported) -> Option<Value> {
    let modules = "import trimesh, plyfile, scipy";
    let imported = Command::new("python3").args(["-c", modules]).output();
    if !imported.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: no trimesh, plyfile or scipy (python3 -m pip install them)");
        return None;
    }
    let folder = tempfile::tempdir().unwrap();
    let [complete, observed] = ["all.ply", "seen.ply"].map(|name| folder.path().join(name));
    write_truth(&complete, &exported.surface_from_both_sides());
    write_truth(&observed, &exported.true_surface());
    let mut command = Command::new("python3");
    command.arg(common::root().join("scripts/check-export.py"));
    command.arg(&exported.files).args([&complete, &observed]);
    let read = Finished::of(command.output().unwrap());
    assert_eq!(read.code, 0, "{}", read.stderr);
    Some(serde_json::from_str(&read.stdout).unwrap())
}

/// Fails unless other programs read all points, splats and triangles, near the true surface.
fn assert_files_match(exported: &Exported, read: &Value) {
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

/// Fails unless pycolmap reads the training cameras' poses.
fn assert_cameras_match(exported: &Exported, read: &Value) {
    let cameras = cameras(&exported.cameras);
    assert_eq!(read["frames"], cameras.len());
    let Some(colmap) = read.get("colmap") else {
        eprintln!("skipped: no pycolmap (python3 -m pip install pycolmap)");
        return;
    };
    for camera in &cameras {
        // COLMAP's axes: right, down, forward.
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

/// Exports a tiny field by running the stage without the runner.
fn export_tiny(project: &Project, params: &str, output: &str, more: &[&str]) -> Finished {
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
        let finished = export_tiny(&project, params, output, &["--threads", threads]);
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
fn the_mesh_can_be_omitted() {
    let project = Project::tiny();
    let params = r#"{"mesh": false, "max_points": 500}"#;
    assert_eq!(export_tiny(&project, params, "some", &[]).code, 0);
    let manifest = common::manifest(&project.path("some"));
    assert!(manifest.contains("points.ply") && !manifest.contains("mesh.glb"), "{manifest}");
    let count = read_ply(&project.path("some/points.ply"))["x"].len();
    assert!((100..=500).contains(&count), "{count} points");
}

/// Prints errors of `EXPORT`, an artifact of `export` from the scene `SCENE` of `prep`.
/// `docs/design/043-export.md` has the command.
#[test]
#[ignore = "measures folders given by EXPORT and SCENE"]
fn errors_of_given_folders_are_printed() {
    let [Some(files), Some(prep)] = ["EXPORT", "SCENE"].map(std::env::var_os) else {
        eprintln!("skipped: EXPORT and SCENE don't name an artifact of export and of prep");
        return;
    };
    let [files, prep] = [files, prep].map(PathBuf::from);
    let exported =
        Exported { files, cameras: prep.join("train-cameras"), truth: prep.join("truth") };
    println!("mesh: {:?}\npoints: {:?}", exported.mesh_errors(), exported.point_errors());
    for background in [1.0, 0.0] {
        println!("splats over {background}: {}", format_psnrs(&exported.splat_psnrs(background)));
    }
    if let Some(read) = read_by_other_programs(&exported) {
        for kind in ["mesh", "points", "splats"] {
            println!("{kind}, read by others: {}", read[kind]);
        }
    }
    if let Some(psnrs) = viewer_psnrs(&exported) {
        println!("splats in the viewer: {}", format_psnrs(&psnrs));
    }
}

fn format_psnrs(psnrs: &[f64]) -> String {
    let mean = psnrs.iter().sum::<f64>() / psnrs.len() as f64;
    format!("{mean:.2} dB in the mean, {psnrs:.2?}")
}

//! A user's own photographs: every data set format gives equal cameras, and one command renders HR
//! views of LR photographs.

#![allow(missing_docs, reason = "a test")]
mod common;
#[path = "common/forms.rs"]
mod forms;

use std::path::Path;

use common::{Finished, Project, stage};
use forms::{ANGLE, FORMS, WIDTH, as_colmap, as_llff, as_transforms, photographs};
use glam::{DMat3, DQuat, DVec3};
use scene::{Distortion, Intrinsics};
use serde_json::{Value, json};

fn camera_numbers(view: &Value) -> Vec<f64> {
    let pose = view["camera"]["camera_to_world"]
        .as_array()
        .unwrap()
        .iter()
        .flat_map(|r| r.as_array().unwrap().clone());
    let intrinsics =
        view["camera"]["intrinsics"].as_object().unwrap().values().cloned().collect::<Vec<_>>();
    pose.chain(intrinsics).map(|n| n.as_f64().unwrap()).collect()
}

/// Returns the largest difference between the numbers of two views' cameras.
fn difference(a: &Value, b: &Value) -> f64 {
    let (a, b) = (camera_numbers(a), camera_numbers(b));
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

fn views(folder: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(folder.join("views.json")).unwrap();
    serde_json::from_str::<Value>(&text).unwrap()["views"].as_array().unwrap().clone()
}

/// Returns the mean PSNR at LR that a stage reports.
#[track_caller]
fn lr_psnr(project: &Project, stage: &str, settings: &[&str]) -> f64 {
    let metrics = project.json(stage, "metrics.json", settings);
    metrics["mean"]["low_resolution"]["psnr"].as_f64().unwrap()
}

#[test]
fn every_format_gives_equal_cameras_and_images() {
    let project = Project::tiny();
    let mut scenes = Vec::new();
    for form in FORMS {
        let folder = (form.write)(&project);
        let scene = project.path(&format!("scene-{}", form.name));
        let finished = stage(
            "prep",
            r#"{"lr_source": "photographs", "scale": 1.5}"#,
            &[("dataset", &folder)],
            &scene,
            &[],
        );
        assert_eq!(finished.code, 0, "{}: {}", form.name, finished.stderr);
        let summary = std::fs::read_to_string(scene.join("scene.json")).unwrap();
        for text in [
            "17 training views, 3 test views",
            "with assumed kernel box; HR is 48×48",
            "20 photographs",
        ] {
            assert!(summary.contains(text), "{text} isn't in {summary}");
        }
        scenes.push(scene);
    }
    for subtree in ["train", "cameras"] {
        let first = views(&scenes[0].join(subtree));
        assert_eq!(first.len(), if subtree == "train" { 17 } else { 3 });
        for scene in &scenes[1..] {
            let others = views(&scene.join(subtree));
            assert_eq!(others.len(), first.len(), "{subtree}");
            for (a, b) in first.iter().zip(others) {
                assert_eq!(a["camera"]["name"], b["camera"]["name"]);
                assert!(difference(a, &b) < 1e-6, "{subtree}: {a} {b}");
            }
        }
    }
    let image = |scene: &Path| std::fs::read(scene.join("train/images/r_3.png")).unwrap();
    assert!(scenes.iter().all(|s| image(s) == image(&scenes[0])));
}

/// A model written by COLMAP's own library must be readable, too.
#[test]
fn a_model_that_pycolmap_wrote_gives_the_same_cameras() {
    let project = Project::tiny();
    let folder = as_transforms(&project);
    let import = std::process::Command::new("python3").args(["-c", "import pycolmap"]).output();
    if !import.is_ok_and(|o| o.status.success()) {
        eprintln!("skipped: no pycolmap (python3 -m pip install pycolmap)");
        return;
    }
    let script = common::root().join("scripts/write-colmap.py");
    let colmap = project.path("pycolmap");
    photographs(&project, "pycolmap");
    let model = colmap.join("sparse/0");
    let written = std::process::Command::new("python3")
        .arg(script)
        .arg(&folder)
        .arg(&model)
        .output()
        .unwrap();
    assert!(written.status.success(), "{}", String::from_utf8_lossy(&written.stderr));
    let scenes = [folder, colmap].map(|folder| {
        let scene = folder.with_extension("scene");
        let finished = stage("prep", "{}", &[("dataset", &folder)], &scene, &[]);
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        scene
    });
    let [ours, theirs] = scenes.map(|scene| views(&scene.join("train")));
    assert_eq!([ours.len(), theirs.len()], [17, 17]);
    for (a, b) in ours.iter().zip(&theirs) {
        assert_eq!(a["camera"]["name"], b["camera"]["name"]);
        assert!(difference(a, b) < 1e-6, "{a} {b}");
    }
}

/// A COLMAP folder without options must give views at twice the photographs' size, scored at LR
/// because no HR photographs exist.
#[test]
fn one_command_renders_hr_views_of_lr_photographs() {
    let project = Project::tiny();
    as_colmap(&project);
    // One photograph is smaller than the others.
    let path = project.path("colmap/images/r_3.png");
    let small =
        pixels::resize_pillow(&pixels::read_png(&path).unwrap(), 20, 20, pixels::Filter::Box);
    pixels::write_png(&path, &small).unwrap();
    project.replace("    parameters: {lr_width: 24, scale: 2}\n", "");
    project.replace("default: [eval]", "default: [report]");
    project.replace("  eval:", "  report:\n    inputs: {run: eval}\n  eval:");
    project.replace("rays: 60000", "rays: 500000");
    project.ok(&["run", "-i", "dataset=./colmap"]);
    let metrics = project.json("eval", "metrics.json", &["-i", "dataset=./colmap"]);
    let mean = &metrics["mean"];
    assert!(mean.get("psnr").is_none() && mean.get("ssim").is_none(), "{mean}");
    // Far above an image of the mean colour, which wrong poses lead to.
    assert!(mean["low_resolution"]["psnr"].as_f64().unwrap() > 19.0, "{mean}");
    let page = std::fs::read_to_string(project.path("out/report/index.html")).unwrap();
    assert!(
        page.contains("\"width\":64,")
            && page.contains("PSNR at LR")
            && page.contains("\"kind\":\"low-resolution\"")
            && !page.contains("\"kind\":\"ground-truth\""),
        "unexpected width, score or images on the page"
    );
}

fn score_with(project: &Project, exposure: &str) -> (f64, Value) {
    // Exposures tint the white background, which then looks like a scene that continues.
    let settings = ["-i", "dataset=./transforms", "-p", "background=white", "-p", exposure];
    project.ok(&[&["run"], &settings[..]].concat());
    (lr_psnr(project, "eval", &settings), project.json("train-ss", "training.json", &settings))
}

/// Returns the exposure factors of a photograph's channels.
fn exposure_factors(photograph: usize) -> [f32; 3] {
    [0.7f32, 1.0 / 0.7].map(|f| [f, f.sqrt(), 1.0 / f.sqrt()])[photograph % 2]
}

const WHITE: &str = "background=white";

/// Trains a field on a data set with a setting, interrupted after each number of rays in `stops`.
/// Returns `training.json` and the weights.
fn train(project: &Project, dataset: &str, setting: &str, stops: &[&str]) -> (Value, Vec<u8>) {
    let dataset = format!("dataset={dataset}");
    let settings = ["-i", &dataset, "-p", WHITE, "-p", setting];
    let run = [&["run", "train-ss"], &settings[..]].concat();
    for rays in stops {
        let mut command = project.command(&run);
        let stopped = Finished::of(command.env("NERF_SR_STOP_AFTER", rays).output().unwrap());
        assert_eq!(stopped.code, 130, "{rays}: {}", stopped.stderr);
    }
    project.ok(&run);
    let folder = project.artifact("train-ss", &settings);
    let weights = std::fs::read(folder.join("field-0.safetensors")).unwrap();
    (project.json("train-ss", "training.json", &settings), weights)
}

/// Returns the sum of the absolute logarithmic errors of estimated exposures.
fn exposure_error(exposures: &[[f32; 3]]) -> f32 {
    exposures
        .iter()
        .enumerate()
        .flat_map(|(i, e)| (0..3).map(move |c| (e[c] / exposure_factors(i)[c]).ln().abs()))
        .sum()
}

fn copy_folder(from: &Path, to: &Path) {
    let status = std::process::Command::new("cp").arg("-r").args([from, to]).status().unwrap();
    assert!(status.success());
}

/// Photographs have different exposures and white balances; the field must have the mean exposure,
/// which the unmodified test photographs have.
#[test]
fn exposures_are_estimated() {
    let project = Project::tiny();
    let folder = as_transforms(&project);
    let file = folder.join("transforms.json");
    let transforms: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    copy_folder(&folder, &project.path("equal"));
    // Every eighth photograph is held out and unchanged; the others' factors have geometric mean 1.
    let frames =
        transforms["frames"].as_array().unwrap().iter().enumerate().filter(|(i, _)| i % 8 != 0);
    for (index, (_, frame)) in frames.enumerate() {
        let path = folder.join(frame["file_path"].as_str().unwrap());
        let mut image = pixels::read_png(&path).unwrap();
        for pixel in image.data.chunks_exact_mut(4) {
            (0..3).for_each(|c| {
                pixel[c] =
                    (f32::from(pixel[c]) * exposure_factors(index)[c]).round().min(255.0) as u8;
            });
        }
        pixels::write_png(&path, &image).unwrap();
    }
    project.replace("    parameters: {lr_width: 24, scale: 2}\n", "");
    project.replace("rays: 60000", "rays: 500000");
    let ((estimated, training), (ignored, _)) =
        (score_with(&project, "exposure=true"), score_with(&project, "exposure=false"));
    let exposures: Vec<[f32; 3]> = serde_json::from_value(training["exposures"].clone()).unwrap();
    println!("{estimated:.2} dB with exposures, {ignored:.2} dB without; {exposures:?}");
    // By default, the first quarter of the training measures exposures, which takes some hundred
    // steps. The field then equals that of a training with an explicit `exposure`. Stops are before
    // and during the measurement, and after the training has started over.
    project.replace("samples_per_step: 16384", "samples_per_step: 2048");
    for (dataset, explicit, expected, stops) in [
        ("./transforms", "exposure=true", true, &["3000", "60000", "200000"][..]),
        ("./equal", "exposure=false", false, &[]),
    ] {
        let (training, weights) = train(&project, dataset, "train-ss.seed=0", stops);
        assert_eq!(training["resolved"]["exposure"], json!(expected), "{dataset}");
        assert!(weights == train(&project, dataset, explicit, &[]).1, "{dataset}");
    }
    let (error, initial_error) =
        (exposure_error(&exposures), exposure_error(&vec![[1.0; 3]; exposures.len()]));
    assert!(
        !exposures.is_empty() && error < 0.5 * initial_error,
        "error {error}, with factors 1 {initial_error}: {exposures:?}"
    );
    assert!(estimated > ignored + 2.0, "{estimated} dB with exposures, {ignored} dB without");
    let with_alpha =
        ["run", "-i", "dataset=./transforms", "-p", "exposure=true", "-p", "background=alpha"];
    project.run(&with_alpha).fails(2, &["parameter exposure", "with prep.background alpha"]);
}

fn pixel_levels(image: &pixels::Rgba8, column: usize, row: usize) -> [f64; 4] {
    [0, 1, 2, 3].map(|c| f64::from(image.data[4 * (row * image.width + column) + c]))
}

/// Returns the `i`-th pixel of a pinhole camera's image as seen through a lens.
fn distorted_pixel(lens: &Intrinsics, pinhole: &pixels::Rgba8, i: usize) -> [u8; 4] {
    let (width, height) = (pinhole.width, pinhole.height);
    let position = lens.undistort([(i % width) as f64 + 0.5, (i / width) as f64 + 0.5]);
    pixels::sample_cubic((width, height), position, |x, y| pixel_levels(pinhole, x, y))
        .map(|level| (level + 0.5) as u8)
}

fn lens_psnr(project: &Project, lens: &str) -> f64 {
    // Through this lens, objects touch the image border, which looks like a scene that continues.
    let settings = ["-i", "dataset=./transforms", "-p", "background=white", "-p", lens];
    project.ok(&[&["run"], &settings[..]].concat());
    lr_psnr(project, "eval", &settings)
}

/// Photographs have lens distortion: rays that follow the lens, and undistorted images, must both
/// score better than a training without the distortion coefficients.
#[test]
fn lenses_are_followed_or_undone() {
    let project = Project::tiny();
    let folder = as_transforms(&project);
    let file = folder.join("transforms.json");
    let mut transforms: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let distortion = Distortion::brown([3.0, 0.0, 0.0], [0.0, 0.05]);
    let lens = Intrinsics { distortion, ..Intrinsics::from_angle_x(WIDTH, WIDTH, ANGLE) };
    (transforms["k1"], transforms["p2"]) =
        (json!(distortion.radial[0]), json!(distortion.tangential[1]));
    std::fs::write(&file, transforms.to_string()).unwrap();
    let size = WIDTH as usize;
    for frame in transforms["frames"].as_array().unwrap() {
        let path = folder.join(frame["file_path"].as_str().unwrap());
        let pinhole = pixels::read_png(&path).unwrap();
        pixels::write_png(
            &path,
            &pixels::Rgba8::new(
                size,
                size,
                (0..size * size).flat_map(|i| distorted_pixel(&lens, &pinhole, i)).collect(),
            ),
        )
        .unwrap();
    }
    project.replace("    parameters: {lr_width: 24, scale: 2}\n", "");
    project.replace("rays: 60000", "rays: 400000");
    let [followed, undone] = ["lens=follow", "lens=undo"].map(|lens| lens_psnr(&project, lens));
    let mut without_lens = transforms.clone();
    (without_lens["k1"], without_lens["p2"]) = (json!(0.0), json!(0.0));
    std::fs::write(&file, without_lens.to_string()).unwrap();
    let ignored = lens_psnr(&project, "lens=follow");
    std::fs::write(&file, transforms.to_string()).unwrap();
    println!("{followed:.2} dB followed, {undone:.2} dB undone, {ignored:.2} dB ignored");
    assert!(
        followed > ignored + 1.0 && undone > ignored + 1.0,
        "{followed} dB followed, {undone} dB undone, {ignored} dB ignored"
    );
    // The scene's cameras have distortion, those of a camera path don't.
    let cameras = project
        .artifact("prep", &["-i", "dataset=./transforms", "-p", "background=white"])
        .join("cameras");
    let film = project.path("film");
    assert_eq!(
        stage("camera-path", r#"{"frames": 1}"#, &[("cameras", &cameras)], &film, &[]).code,
        0
    );
    let has_distortion =
        |folder: &Path| views(folder)[0]["camera"]["intrinsics"].get("distortion").is_some();
    assert!(has_distortion(&cameras) && !has_distortion(&film));
    // This lens images nothing beyond 0.55 focal lengths from the axis: the corners have no ray.
    transforms["k1"] = json!(-1.1);
    std::fs::write(&file, transforms.to_string()).unwrap();
    project
        .run(&["run", "-i", "dataset=./transforms"])
        .fails(3, &["frame r_0", "k1 -1.1", "lens: undo"]);
    project.ok(&["run", "prep", "-i", "dataset=./transforms", "-p", "lens=undo"]);
}

/// Returns the PSNR at LR with given and with registered test poses.
fn psnr_given_and_registered(project: &Project, refinement: &str) -> [f64; 2] {
    let settings = ["eval", "eval-registered", "-i", "dataset=./transforms", "-p", refinement];
    project.ok(&[&["run"], &settings[..]].concat());
    ["eval", "eval-registered"].map(|stage| lr_psnr(project, stage, &settings))
}

/// Poses are off by about a pixel: only refined training poses together with registered test poses
/// may give the best score.
#[test]
fn poses_are_refined_and_test_views_registered() {
    let project = Project::shipped(&["registered"], "");
    let folder = as_transforms(&project);
    let file = folder.join("transforms.json");
    let mut transforms: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let mut rng = numerics::CounterRng::new(7, 1, 1);
    let mut random_vector =
        |size: f64| DVec3::from([0, 1, 2].map(|_| size * f64::from(2.0 * rng.uniform() - 1.0)));
    for frame in transforms["frames"].as_array_mut().unwrap() {
        let matrix: [[f64; 4]; 4] =
            serde_json::from_value(frame["transform_matrix"].clone()).unwrap();
        let turn = DMat3::from_quat(DQuat::from_scaled_axis(random_vector(0.02)));
        let axes =
            DMat3::from_cols_array_2d(&[0, 1, 2].map(|c| [0, 1, 2].map(|r| matrix[r][c]))) * turn;
        let shift = random_vector(0.08);
        let row =
            |r: usize| [axes.x_axis[r], axes.y_axis[r], axes.z_axis[r], matrix[r][3] + shift[r]];
        frame["transform_matrix"] = json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]);
    }
    std::fs::write(&file, transforms.to_string()).unwrap();
    project.replace("    parameters: {lr_width: 24, scale: 2}\n", "");
    project.replace("rays: 60000", "rays: 900000");
    let ([as_given, only_registered], [only_refined, both]) = (
        psnr_given_and_registered(&project, "pose_refinement=false"),
        psnr_given_and_registered(&project, "pose_refinement=true"),
    );
    println!(
        "{as_given:.2} dB as given, {only_registered:.2} registered, {only_refined:.2} refined, \
        {both:.2} both"
    );
    assert!(both > only_registered + 1.0 && both > only_refined + 1.0 && both > as_given + 3.0);
    let settings = ["-i", "dataset=./transforms", "-p", "pose_refinement=true"];
    let training = project.json("train-ss", "training.json", &settings);
    assert_eq!(training["poses"].as_array().unwrap().len(), 17);
    let with_alpha = [
        "run",
        "-i",
        "dataset=./transforms",
        "-p",
        "pose_refinement=true",
        "-p",
        "background=alpha",
    ];
    project.run(&with_alpha).fails(2, &["parameter pose_refinement", "with prep.background alpha"]);
}

fn psnr_with_masks(project: &Project, file: &Path, transforms: &mut Value, has_masks: bool) -> f64 {
    for frame in transforms["frames"].as_array_mut().unwrap().iter_mut().filter(|_| !has_masks) {
        frame.as_object_mut().unwrap().remove("mask_path");
    }
    std::fs::write(file, transforms.to_string()).unwrap();
    project.ok(&["run", "-i", "dataset=./transforms"]);
    lr_psnr(project, "eval", &["-i", "dataset=./transforms"])
}

/// A magenta rectangle covers part of most photographs: its masked pixels must be neither trained
/// on nor scored.
#[test]
fn masked_pixels_are_neither_trained_on_nor_scored() {
    let project = Project::tiny();
    let folder = as_transforms(&project);
    let file = folder.join("transforms.json");
    let mut transforms: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    std::fs::create_dir(folder.join("masks")).unwrap();
    for (i, frame) in transforms["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
        // In held-out photographs, the rectangle covers only a corner.
        let (columns, rows) =
            if i % 8 == 0 { (0..4, 0..4) } else { (8 + i % 5..20 + i % 5, 6..26) };
        let name = Path::new(frame["file_path"].as_str().unwrap())
            .file_name()
            .unwrap()
            .to_str()
            .unwrap()
            .to_owned();
        let mut image = pixels::read_png(&folder.join("images").join(&name)).unwrap();
        let mut mask = pixels::Rgba8::new(32, 32, vec![255; 4 * 32 * 32]);
        for pixel in rows.flat_map(|y| columns.clone().map(move |x| 4 * (32 * y + x))) {
            image.data[pixel..pixel + 3].copy_from_slice(&[255, 0, 200]);
            mask.data[pixel..pixel + 3].fill(0);
        }
        pixels::write_png(&folder.join("images").join(&name), &image).unwrap();
        pixels::write_png(&folder.join("masks").join(&name), &mask).unwrap();
        frame["mask_path"] = json!(format!("masks/{name}"));
    }
    project.replace("    parameters: {lr_width: 24, scale: 2}\n", "");
    project.replace("rays: 60000", "rays: 600000");
    let masked = psnr_with_masks(&project, &file, &mut transforms, true);
    // With HR ground truth, `eval` reports the PSNR of the unmasked pixels.
    let settings = ["-i", "dataset=./transforms", "-p", "lr_width=16", "-p", "train-ss.rays=20000"];
    project.ok(&[&["run", "eval"], &settings[..]].concat());
    let artifact = |stage: &str| project.artifact(stage, &settings);
    let (rendered, truth) = (artifact("render-depth"), artifact("prep").join("truth"));
    let metrics = project.json("eval", "metrics.json", &settings);
    let list: scene::Views =
        serde_json::from_slice(&std::fs::read(truth.join("views.json")).unwrap()).unwrap();
    let grey = list.background.grey_level();
    for (view, scores) in list.views.iter().zip(metrics["views"].as_array().unwrap()) {
        let file = |path: &Option<String>| truth.join(path.as_ref().unwrap());
        let name = &view.camera.name;
        let found = pixels::read_premultiplied(&rendered.join(format!("images/{name}.exr")))
            .unwrap()
            .over(grey);
        let expected = pixels::read_premultiplied(&file(&view.image)).unwrap().over(grey);
        let mask = pixels::Mask::read(&file(&view.mask), (32, 32)).unwrap();
        let pixels =
            found.data.chunks_exact(3).zip(expected.data.chunks_exact(3)).zip(&mask.counts);
        let errors: Vec<f64> = pixels
            .filter(|(_, counts)| **counts)
            .flat_map(|((f, e), _)| {
                f.iter().zip(e).map(|(f, e)| f64::from(f.clamp(0.0, 1.0) - e).powi(2))
            })
            .collect();
        assert!(
            errors.len() < 3 * 32 * 32 && errors.len() > 3 * 16 * 32,
            "{name}: {} samples",
            errors.len()
        );
        let by_hand = pixels::psnr_of(errors.iter().sum::<f64>() / errors.len() as f64);
        let psnr = scores["scores"]["psnr"].as_f64().unwrap();
        assert!((psnr - by_hand).abs() < 1e-3, "{name}: {psnr}, by hand {by_hand}");
    }
    let spoiled = psnr_with_masks(&project, &file, &mut transforms, false);
    println!("{masked:.2} dB with masks, {spoiled:.2} dB without");
    assert!(
        masked > 17.0 && masked > spoiled + 3.0,
        "{masked} dB with masks, {spoiled} dB without"
    );
}

#[track_caller]
fn assert_prep_fails(folder: &Path, out: &Path, params: &str, words: &[&str]) {
    stage("prep", params, &[("dataset", folder)], out, &[]).fails(2, words);
}

#[test]
fn contradictory_parameters_are_refused() {
    let project = Project::tiny();
    let folder = as_transforms(&project);
    let out = project.path("out");
    assert_prep_fails(
        &folder,
        &out,
        r#"{"lr_source": "photographs", "kernel": "average"}"#,
        &["parameter kernel", "choose box"],
    );
}

fn view_names(scene: &Path, subtree: &str) -> Vec<Value> {
    views(&scene.join(subtree)).iter().map(|v| v["camera"]["name"].clone()).collect()
}

/// The paper's split must train on all views and test on all but the references.
#[test]
fn the_papers_split_leaves_references_out() {
    let project = Project::tiny();
    let folder = as_llff(&project);
    let scene = project.path("scene");
    let finished = stage(
        "prep",
        r#"{"split": "paper", "hr_references": 3}"#,
        &[("dataset", &folder)],
        &scene,
        &[],
    );
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    assert_eq!((views(&scene.join("train")).len(), views(&scene.join("truth")).len()), (20, 17));
    let (references, tested) = (view_names(&scene, "references"), view_names(&scene, "truth"));
    // References are the first view and others far from the first, none of which is tested.
    assert_eq!((references.len(), &references[0]), (3, &json!("r_0")));
    assert!(references.iter().all(|name| !tested.contains(name)), "{references:?} of {tested:?}");
    assert_ne!(references[1], json!("r_1"));
}

fn psnr_and_depth_error(project: &Project, settings: [&str; 2]) -> (f64, f64) {
    let settings = settings.into_iter().chain(["backdrop=true", "near=2", "far=80"]);
    let arguments: Vec<&str> = settings.flat_map(|setting| ["-p", setting]).collect();
    project.ok(&[&["run"], &arguments[..]].concat());
    let mean = project.json("eval", "metrics.json", &arguments)["mean"].take();
    (mean["psnr"].as_f64().unwrap(), mean["depth"]["median_absolute"].as_f64().unwrap())
}

/// Unbounded scenes, observed from the front and from all around, are trained in NDC and in a
/// contraction. Depth must be the camera's z in both spaces, and PSNR higher than in a bounded box.
#[test]
fn ndc_and_contraction_suit_unbounded_scenes() {
    let project = Project::tiny();
    project.replace("train: 12", "train: 30");
    project.replace("rays: 60000", "rays: 400000");
    for (layout, space, min_psnr, max_error) in [
        ("layout=forward", "space=ndc", 22.0, 0.7),
        ("layout=around", "space=contraction", 18.0, 0.7),
    ] {
        let (psnr, error) = psnr_and_depth_error(&project, [layout, space]);
        let (box_psnr, _) = psnr_and_depth_error(&project, [layout, "space=box"]);
        println!("{space}: {psnr:.2} dB, depth error {error:.3}; box {box_psnr:.2} dB");
        assert!(psnr > min_psnr && error < max_error, "{space}: {psnr} dB, depth error {error}");
        assert!(psnr > box_psnr, "{space}: {psnr} dB, box {box_psnr}");
    }
}

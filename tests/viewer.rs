//! `nerf-sr run viewer`: in a real browser, the page renders the field like `render-depth`, and its
//! controls work.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::{Path, PathBuf};

use common::browser::run_in_browser;
use common::{Project, data};
use glam::DVec3;
use pixels::Rgba8;
use serde_json::{Value, json};

/// Parameter that renders views in the size of the page.
const SIZE: &str = "render-depth.size=512";

/// Letters as five columns of seven bits; the lowest bit is the top pixel.
const LETTERS: [[u8; 5]; 4] = [
    [0x7f, 0x04, 0x08, 0x10, 0x7f], // N
    [0x7f, 0x49, 0x49, 0x49, 0x41], // E
    [0x7f, 0x09, 0x19, 0x29, 0x46], // R
    [0x7f, 0x09, 0x09, 0x09, 0x01], // F
];

/// Centre of the boards in UTM coordinates (metres), too large for a precise `f32` in the browser.
const SCENE_CENTRE: DVec3 = DVec3::new(500_000.0, 4_649_776.0, 120.0);

/// Returns whether the text "NERF" covers a point of a board; `right` and `down` are 0 to 1.
fn is_ink(right: f64, down: f64) -> bool {
    let (column, row) = ((26.0 * right - 1.5).floor(), (10.0 * down - 1.5).floor());
    if !(0.0..24.0).contains(&column) || !(0.0..7.0).contains(&row) {
        return false;
    }
    let (letter, column) = (column as usize / 6, column as usize % 6);
    column < 5 && LETTERS[letter][column] >> row as u32 & 1 == 1
}

/// Returns a ray's RGBA colour in a scene of a board on a plate. The board's text is readable from
/// the front, the plate's from above.
fn ray_colour(origin: DVec3, direction: DVec3) -> [u8; 4] {
    let boxes = [
        (DVec3::new(-0.9, -0.05, -0.3), DVec3::new(0.9, 0.05, 0.5)),
        (DVec3::new(-1.0, -0.7, -0.4), DVec3::new(1.0, 0.7, -0.3)),
    ];
    let mut nearest: Option<(f64, usize, usize)> = None;
    for (box_index, (low, high)) in boxes.iter().enumerate() {
        let (a, b) = ((low - origin) / direction, (high - origin) / direction);
        let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
        if enter < leave && nearest.is_none_or(|(t, ..)| enter < t) {
            let axis = (0..3).find(|&i| a.min(b)[i] == enter).unwrap();
            nearest = Some((enter, box_index, axis));
        }
    }
    let Some((t, box_index, axis)) = nearest else { return [0; 4] };
    let ((low, high), point) = (boxes[box_index], origin + t * direction);
    let relative = (point - low) / (high - low);
    let ink = match (box_index, axis) {
        (0, 1) => direction.y > 0.0 && is_ink(relative.x, 1.0 - relative.z),
        (1, 2) => direction.z < 0.0 && is_ink(relative.x, 2.0 * (1.0 - relative.y) - 1.0),
        _ => false,
    };
    match (ink, box_index) {
        (true, _) => [20, 20, 120, 255],
        (false, 0) => [235, 200, 90, 255],
        _ => [90, 170 + (10.0 * relative.y) as u8, 120, 255],
    }
}

/// Moves a pose from the origin to the scene's centre.
fn dataset_pose(mut matrix: [[f64; 4]; 4]) -> [[f64; 4]; 4] {
    (0..3).for_each(|i| matrix[i][3] += SCENE_CENTRE[i]);
    matrix
}

/// Returns the camera-to-world matrix of a camera that looks at the origin.
fn pose(centre: DVec3) -> [[f64; 4]; 4] {
    let back = centre.normalize();
    let right = if back.z > 0.999 { DVec3::X } else { DVec3::Z.cross(back).normalize() };
    let up = back.cross(right);
    let row = |i: usize| [right[i], up[i], back[i], centre[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

/// Writes a split of the data set: `transforms_*.json` and images 64 pixels wide.
fn write_split(folder: &Path, split: &str, centres: &[DVec3]) {
    const PIXELS: usize = 64;
    let angle: f64 = 0.75;
    let slope = |i: f64| (2.0 * i / PIXELS as f64 - 1.0) * (0.5 * angle).tan();
    std::fs::create_dir_all(folder.join(split)).unwrap();
    let mut frames = Vec::new();
    for (k, centre) in centres.iter().enumerate() {
        let matrix = pose(*centre);
        let column = |c: usize| DVec3::from([0, 1, 2].map(|i| matrix[i][c]));
        let data = (0..4 * PIXELS * PIXELS)
            .step_by(4)
            .flat_map(|byte| {
                let (x, y) = ((byte / 4 % PIXELS) as f64, (byte / 4 / PIXELS) as f64);
                let direction =
                    |x: f64, y: f64| column(0) * slope(x) - column(1) * slope(y) - column(2);
                // Straight alpha: the mean colour of the opaque rays, the mean alpha of all 16.
                let mut sum = [0.0; 4];
                for sub in 0..16 {
                    let offset = |k: i32| (f64::from(k) + 0.5) / 4.0;
                    let ray = direction(x + offset(sub % 4), y + offset(sub / 4));
                    let colour = ray_colour(*centre, ray.normalize());
                    (0..4).for_each(|c| sum[c] += f64::from(colour[c]));
                }
                let opaque_rays = (sum[3] / 255.0).max(1.0);
                [sum[0] / opaque_rays, sum[1] / opaque_rays, sum[2] / opaque_rays, sum[3] / 16.0]
                    .map(|v| v.round() as u8)
            })
            .collect();
        let file = format!("{split}/r_{k}.png");
        pixels::write_png(&folder.join(&file), &Rgba8::new(PIXELS, PIXELS, data)).unwrap();
        frames.push(json!({
            "file_path": format!("./{split}/r_{k}"),
            "transform_matrix": dataset_pose(matrix),
        }));
    }
    let transforms = json!({"camera_angle_x": angle, "frames": frames});
    std::fs::write(folder.join(format!("transforms_{split}.json")), transforms.to_string())
        .unwrap();
}

fn camera_centre(turn: f64, height: f64) -> DVec3 {
    let radius = (1.0 - height * height).sqrt();
    3.5 * DVec3::new(radius * turn.sin(), -radius * turn.cos(), height)
}

/// Writes a data set of the boards; test views are from the front, from the side and from straight
/// above.
fn write_text_scene(folder: &Path) {
    let train: Vec<DVec3> = (0..40)
        .map(|i| camera_centre(2.4 * f64::from(i), 0.02 + 0.97 * f64::from(i) / 40.0))
        .collect();
    write_split(folder, "train", &train);
    write_split(
        folder,
        "test",
        &[camera_centre(0.1, 0.25), camera_centre(0.9, 0.4), camera_centre(0.0, 1.0)],
    );
}

/// Trains, bakes and renders a field. Returns the page and the folder of rendered views.
fn run_viewer(project: &Project, arguments: &[&str]) -> (PathBuf, PathBuf) {
    project.ok(&[&["run", "viewer"], arguments].concat());
    let rendering = [&["run", "render-depth", "-p", SIZE], arguments].concat();
    project.ok(&rendering);
    let views =
        project.artifact("render-depth", &[&["render-depth", "-p", SIZE], arguments].concat());
    (project.path("out/viewer/index.html"), views)
}

/// Checks each view's PSNR and the mean number of texture reads per pixel. Returns each view's
/// measurements; `None` without a browser.
#[track_caller]
fn check_views(page: &Path, views: &Path, min_psnr: f64, max_reads: f64) -> Option<Vec<Value>> {
    let report = run_in_browser("viewer.mjs", [page, views])?;
    assert_eq!(report["problems"], json!([]));
    let views = report["views"].as_array().unwrap().clone();
    println!("{views:#?}");
    let mut reads = 0.0;
    for view in &views {
        assert!(view["psnr"].as_f64().unwrap() >= min_psnr, "{view}");
        reads += view["reads"].as_f64().unwrap() / views.len() as f64;
    }
    assert!((1.0..=max_reads).contains(&reads), "{reads} reads per pixel");
    Some(views)
}

#[test]
fn the_page_renders_text_like_the_field() {
    let project = Project::shipped(&["viewer"], "  prep:\n    parameters: {lr_width: 32}\n");
    write_text_scene(&project.path("text"));
    let arguments = ["-i", "dataset=./text", "-p", "rays=300000", "-p", "hidden_dim=32"];
    let (page, views) = run_viewer(&project, &arguments);
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(html.len() < 25_000_000 && !html.contains("://"), "{} bytes", html.len());
    let Some(views) = check_views(&page, &views, 27.0, 64.0) else { return };
    assert_eq!(views.len(), 3);
    // A mirrored page would show mirrored text.
    for view in &views {
        let [psnr, mirrored] = ["psnr", "mirrored"].map(|key| view[key].as_f64().unwrap());
        assert!(mirrored < psnr - 4.0, "{view}");
    }
}

/// Settings of a comparison of the page with rendered views.
struct Comparison {
    /// Training parameters of the field.
    field: String,
    /// Number of voxels along the cube's side.
    resolution: u32,
    /// Width of the views, and number of rays along a pixel's side.
    views: (u32, u32),
    /// Maximum number of texture reads per pixel.
    max_reads: f64,
}

/// Returns settings for a grid of the default size: smaller fields and fewer rays give haze.
fn grid() -> Comparison {
    let field = "rays: 300000, n_levels: 8, cells_per_pixel: 2.56, log2_hashmap_size: null, \
        hidden_dim: 64, march_steps: null, max_rays_per_step: 8192, samples_per_step: 24576";
    Comparison { field: field.to_owned(), resolution: 128, views: (256, 2), max_reads: 64.0 }
}

/// Returns settings for a small version of the paper's field, which renders slowly. After few rays
/// the field has haze, whose texture reads differ between processors due to libtorch's rounding.
fn mlp() -> Comparison {
    let field = "field: mlp, rays: 60000, supersample: 1, hidden_dim: 48, layers: 4, \
        coarse_samples: 24, fine_samples: 24, max_rays_per_step: 128, learning_rate: 0.002";
    Comparison { field: field.to_owned(), resolution: 64, views: (128, 1), max_reads: 80.0 }
}

/// Returns the stage blocks of a demo scene and its field.
fn scene_blocks(demo_scene: &str, field: &str) -> String {
    format!(
        "  demo-scene:\n    parameters: {{size: 64, train: 40{demo_scene}}}\n  \
        prep:\n    parameters: {{lr_width: 32}}\n  \
        train-ss:\n    parameters: {{{field}}}\n"
    )
}

/// Trains a field of the demo scene in a space, and compares the page with rendered views. Returns
/// the project.
fn compare_space(demo_scene: &str, space: &str, comparison: &Comparison) -> Project {
    compare_page(&scene_blocks(demo_scene, &comparison.field), &[], space, comparison)
}

/// Trains the field that `blocks` configure, and compares the page with rendered views: three test
/// cameras and three cameras in between. `inputs` are command-line arguments. Returns the project.
fn compare_page(blocks: &str, inputs: &[&str], space: &str, comparison: &Comparison) -> Project {
    let (size, samples) = comparison.views;
    let blocks = format!(
        "{blocks}  camera-path:\n    inputs: {{cameras: prep/cameras}}\n    \
        parameters: {{kind: between, frames: 6, size: {size}}}\n  \
        path-views:\n    parameters: {{samples_per_axis: {samples}}}\n  \
        viewer:\n    parameters: {{resolution: {}}}\n",
        comparison.resolution
    );
    let project = Project::shipped(&["viewer", "video"], &blocks);
    project.ok(&[&["run", "viewer", "path-views"], inputs].concat());
    let field = project.json("train-ss", "field.json", &[&["train-ss"], inputs].concat());
    let found = &field["bounds"]["space"];
    assert!(found == space || found.get(space).is_some(), "{found}");
    let page = project.path("out/viewer/index.html");
    assert!(page.metadata().unwrap().len() < 25_000_000);
    let views = project.artifact("path-views", &[&["path-views"], inputs].concat());
    let Some(views) = check_views(&page, &views, 26.0, comparison.max_reads) else {
        return project;
    };
    assert_eq!(views.len(), 6);
    for view in &views {
        let [psnr, mirrored] = ["psnr", "mirrored"].map(|key| view[key].as_f64().unwrap());
        assert!(mirrored < psnr - 3.0, "{view}");
    }
    project
}

#[test]
fn the_page_renders_a_box_and_its_controls_work() {
    check_controls(&compare_space("", "box", &grid()));
}

#[test]
fn the_page_renders_ndc() {
    compare_space(", layout: forward, backdrop: true", "ndc", &grid());
}

#[test]
fn the_page_renders_a_contraction() {
    compare_space(", backdrop: true", "contraction", &grid());
}

/// Forward-facing photographs are trained in NDC by default.
#[test]
fn the_page_renders_fern() {
    let Some(data) = data() else { return };
    let dataset = format!("dataset={}", data.join("nerf_llff_data/fern").display());
    let comparison = Comparison { resolution: 160, ..grid() };
    let blocks = format!(
        "  prep:\n    parameters: {{lr_width: 126}}\n  train-ss:\n    parameters: {{{}}}\n",
        comparison.field
    );
    compare_page(&blocks, &["-i", &dataset], "ndc", &comparison);
}

#[test]
fn the_page_renders_the_papers_field() {
    compare_space(", backdrop: true", "contraction", &mlp());
}

fn distance_from_origin(state: &Value) -> f64 {
    let centre = state["centre"].as_array().unwrap().iter();
    centre.map(|c| c.as_f64().unwrap().powi(2)).sum::<f64>().sqrt()
}

/// Checks that a recorded path has frames between keyframes, and that `path-views` renders the path
/// like the page.
fn check_recorder(project: &Project, recorded: &Path, two_keyframes: &Value) {
    let path: Value = serde_json::from_slice(&std::fs::read(recorded).unwrap()).unwrap();
    let frames = |path: &Value| path["camera_path"].as_array().unwrap().clone();
    assert_eq!((frames(&path).len(), frames(two_keyframes).len()), (1, 49));
    let pose = |path: &Value| frames(path)[0]["camera_to_world"].as_array().unwrap().clone();
    for (a, b) in pose(&path).iter().zip(&pose(two_keyframes)) {
        assert!((a.as_f64().unwrap() - b.as_f64().unwrap()).abs() < 1e-9, "{a} {b}");
    }
    let (keyframe, last_frame) = (&two_keyframes["keyframes"][1], &frames(two_keyframes)[48]);
    let fields = [("matrix", "camera_to_world"), ("fov", "fov"), ("aspect", "aspect")];
    for (keyframe_field, frame_field) in fields {
        assert_eq!(keyframe[keyframe_field], last_frame[frame_field], "{keyframe_field}");
    }
    let arguments = ["-i", "camera-path.path=recorded", "-p", "camera-path.size=256"];
    project.ok(&[&["run", "path-views"], &arguments[..]].concat());
    let views = project.artifact("path-views", &[&["path-views"], &arguments[..]].concat());
    let page = project.path("out/viewer/index.html");
    assert_eq!(check_views(&page, &views, 22.0, 64.0).unwrap().len(), 1);
}

/// Checks that mouse, keys and touches change the view as expected.
fn check_controls(project: &Project) {
    project.ok(&["run", "viewer", "-p", "viewer.resolution=64", "-p", "photographs=20"]);
    let page = project.path("out/viewer/index.html");
    let recorded = project.path("recorded/camera_path.json");
    let files = [&page, &project.path("shots"), &recorded];
    let Some(report) = run_in_browser("viewer-controls.mjs", files) else { return };
    let state = |device: &str, name: &str| report[device]["states"][name].clone();
    for device in ["desktop", "phone"] {
        assert_eq!(report[device]["problems"], json!([]), "{device}");
    }
    let desktop = |name: &str| state("desktop", name);
    let (first, next) = (desktop("first"), desktop("next"));
    assert_eq!(next["camera"], (first["camera"].as_i64().unwrap() + 1) % 40);
    // Every other camera has its photograph.
    assert_ne!(first["photograph"], next["photograph"]);
    let states = ["first", "next", "arrow", "wheel", "drag", "depth", "opacity"];
    for pair in states.windows(2) {
        assert_ne!(desktop(pair[0])["hash"], desktop(pair[1])["hash"], "{pair:?}");
    }
    assert!(desktop("arrow")["camera"] == -1 && desktop("arrow")["frusta"] == false);
    assert_eq!(desktop("frusta")["frusta"], true);
    assert!(
        distance_from_origin(&desktop("wheel")) > 1.1 * distance_from_origin(&desktop("arrow")),
        "the wheel moves the camera away"
    );
    assert_eq!(first["title"], "demo-scene");
    assert_ne!(desktop("depth")["scale"], "");
    assert_eq!([&desktop("depth")["dialog"], &desktop("keys")["dialog"]], [false, true]);
    for pair in [["keys", "angle"], ["angle", "turntable"]] {
        assert_ne!(desktop(pair[0])["hash"], desktop(pair[1])["hash"], "{pair:?}");
    }
    assert_ne!(desktop("angle")["angle"], desktop("keys")["angle"]);
    let with_photograph = if first["photograph"] == true { &first } else { &next };
    assert_eq!(
        with_photograph["panes"][0], with_photograph["panes"][1],
        "the panes have equal sizes and top edges"
    );
    assert_eq!([&desktop("full")["full"], &desktop("saved")["full"]], ["stage", ""]);
    assert_eq!(desktop("saved")["clicked"], "demo-scene.png");
    // Zooming stops before the surface.
    let nearest = &desktop("inside")["nearest"];
    assert!(nearest.as_f64().is_some_and(|distance| (0.01..0.2).contains(&distance)), "{nearest}");
    assert_eq!(desktop("flown")["camera"], desktop("flown")["clicked"]);
    // The background is the page's colour, also in a dark colour scheme. Haze changes the colour a
    // little.
    let has_background = |state: &Value, expected: f64| {
        let mut levels = state["corner"].as_array().unwrap().iter().map(|c| c.as_f64().unwrap());
        levels.all(|level| (level - expected).abs() < 24.0)
    };
    assert!(
        has_background(&first, 255.0) && has_background(&state("phone", "first"), 28.0),
        "{first}"
    );
    check_recorder(project, &recorded, &desktop("second")["path"]);
    for field in ["hash", "camera", "centre", "frusta"] {
        assert_eq!(desktop("reset")[field], first[field], "{field}");
    }
    let (start, finger, pinch) =
        (state("phone", "first"), state("phone", "finger"), state("phone", "pinch"));
    assert!(
        (distance_from_origin(&finger) - distance_from_origin(&start)).abs()
            < 0.1 * distance_from_origin(&start),
        "one finger orbits"
    );
    assert_ne!(finger["right"], start["right"]);
    assert_eq!(pinch["right"], finger["right"], "two fingers don't turn the view");
    assert!(
        distance_from_origin(&pinch) < 0.8 * distance_from_origin(&finger),
        "spreading two fingers moves the camera closer"
    );
}

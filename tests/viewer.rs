//! `nerf-sr run viewer`: the page shows in a real browser what the field shows, and people can use
//! it.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::{Path, PathBuf};

use common::browser::run_in_browser;
use common::{Project, data};
use glam::DVec3;
use pixels::Rgba8;
use serde_json::{Value, json};

/// Views with the same size as the page's.
const SIZE: &str = "render-depth.size=512";

/// Letters of five columns, seven bits each, the lowest on top.
const LETTERS: [[u8; 5]; 4] = [
    [0x7f, 0x04, 0x08, 0x10, 0x7f], // N
    [0x7f, 0x49, 0x49, 0x49, 0x41], // E
    [0x7f, 0x09, 0x19, 0x29, 0x46], // R
    [0x7f, 0x09, 0x09, 0x09, 0x01], // F
];

/// Middle of the boards: in UTM coordinates, which a browser's floats can't hold.
const MIDDLE: DVec3 = DVec3::new(500_000.0, 4_649_776.0, 120.0);

/// Returns whether a point of a board, 0 to 1 to the right and downwards, is ink: "NERF".
fn is_ink(right: f64, down: f64) -> bool {
    let (column, row) = ((26.0 * right - 1.5).floor(), (10.0 * down - 1.5).floor());
    if !(0.0..24.0).contains(&column) || !(0.0..7.0).contains(&row) {
        return false;
    }
    let (letter, column) = (column as usize / 6, column as usize % 6);
    column < 5 && LETTERS[letter][column] >> row as u32 & 1 == 1
}

/// A board that stands on a plate, both with text that can be read from the front, or from above:
/// red, green, blue and alpha.
fn colour_along(origin: DVec3, direction: DVec3) -> [u8; 4] {
    let blocks = [
        (DVec3::new(-0.9, -0.05, -0.3), DVec3::new(0.9, 0.05, 0.5)),
        (DVec3::new(-1.0, -0.7, -0.4), DVec3::new(1.0, 0.7, -0.3)),
    ];
    let mut nearest: Option<(f64, usize, usize)> = None;
    for (block, (low, high)) in blocks.iter().enumerate() {
        let (a, b) = ((low - origin) / direction, (high - origin) / direction);
        let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
        if enter < leave && nearest.is_none_or(|(t, ..)| enter < t) {
            let axis = (0..3).find(|&i| a.min(b)[i] == enter).unwrap();
            nearest = Some((enter, block, axis));
        }
    }
    let Some((t, block, axis)) = nearest else { return [0; 4] };
    let ((low, high), p) = (blocks[block], origin + t * direction);
    let share = (p - low) / (high - low);
    let ink = match (block, axis) {
        (0, 1) => direction.y > 0.0 && is_ink(share.x, 1.0 - share.z),
        (1, 2) => direction.z < 0.0 && is_ink(share.x, 2.0 * (1.0 - share.y) - 1.0),
        _ => false,
    };
    match (ink, block) {
        (true, _) => [20, 20, 120, 255],
        (false, 0) => [235, 200, 90, 255],
        _ => [90, 170 + (10.0 * share.y) as u8, 120, 255],
    }
}

/// A pose as seen from the middle, in the data set's coordinates.
fn moved_there(mut matrix: [[f64; 4]; 4]) -> [[f64; 4]; 4] {
    (0..3).for_each(|i| matrix[i][3] += MIDDLE[i]);
    matrix
}

/// A camera that looks at the middle.
fn pose(centre: DVec3) -> [[f64; 4]; 4] {
    let back = centre.normalize();
    let right = if back.z > 0.999 { DVec3::X } else { DVec3::Z.cross(back).normalize() };
    let above = back.cross(right);
    let row = |i: usize| [right[i], above[i], back[i], centre[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

/// Writes one of the data set's lists, and its images of 64 pixels.
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
            .flat_map(|at| {
                let (x, y) = ((at / 4 % PIXELS) as f64, (at / 4 / PIXELS) as f64);
                let way = |x: f64, y: f64| column(0) * slope(x) - column(1) * slope(y) - column(2);
                // The mean of 16 rays, premultiplied.
                let mut sum = [0.0; 4];
                for sub in 0..16 {
                    let within = |k: i32| (f64::from(k) + 0.5) / 4.0;
                    let ray = way(x + within(sub % 4), y + within(sub / 4));
                    let seen = colour_along(*centre, ray.normalize());
                    (0..4).for_each(|c| sum[c] += f64::from(seen[c]));
                }
                let opaque = (sum[3] / 255.0).max(1.0);
                [sum[0] / opaque, sum[1] / opaque, sum[2] / opaque, sum[3] / 16.0]
                    .map(|v| v.round() as u8)
            })
            .collect();
        let file = format!("{split}/r_{k}.png");
        pixels::write_png(&folder.join(&file), &Rgba8::new(PIXELS, PIXELS, data)).unwrap();
        frames.push(json!({"file_path": format!("./{split}/r_{k}"), "transform_matrix": moved_there(matrix)}));
    }
    let list = json!({"camera_angle_x": angle, "frames": frames});
    std::fs::write(folder.join(format!("transforms_{split}.json")), list.to_string()).unwrap();
}

fn around(turn: f64, height: f64) -> DVec3 {
    let level = (1.0 - height * height).sqrt();
    3.5 * DVec3::new(level * turn.sin(), -level * turn.cos(), height)
}

/// A data set of the boards; test views are one from the front, one from the side, and one that
/// looks straight down.
fn text_scene(folder: &Path) {
    let train: Vec<DVec3> =
        (0..40).map(|i| around(2.4 * f64::from(i), 0.02 + 0.97 * f64::from(i) / 40.0)).collect();
    write_split(folder, "train", &train);
    write_split(folder, "test", &[around(0.1, 0.25), around(0.9, 0.4), around(0.0, 1.0)]);
}

/// A project whose field was trained, baked and rendered; the page and the rendered views.
fn viewed(project: &Project, arguments: &[&str]) -> (PathBuf, PathBuf) {
    project.ok(&[&["run", "viewer"], arguments].concat());
    let rendering = [&["run", "render-depth", "-p", SIZE], arguments].concat();
    project.ok(&rendering);
    let views =
        project.artifact("render-depth", &[&["render-depth", "-p", SIZE], arguments].concat());
    (project.path("out/viewer/index.html"), views)
}

/// Returns name and figures of each view of the page. Checks the PSNR of each view and the mean
/// number of texture reads per pixel.
#[track_caller]
fn checked(page: &Path, views: &Path, least: f64, most_reads: f64) -> Option<Vec<Value>> {
    let found = run_in_browser("viewer.mjs", [page, views])?;
    assert_eq!(found["problems"], json!([]));
    let views = found["views"].as_array().unwrap().clone();
    println!("{views:#?}");
    let mut reads = 0.0;
    for view in &views {
        assert!(view["psnr"].as_f64().unwrap() >= least, "{view}");
        reads += view["reads"].as_f64().unwrap() / views.len() as f64;
    }
    assert!((1.0..=most_reads).contains(&reads), "{reads} reads per pixel");
    Some(views)
}

#[test]
fn the_page_shows_text_as_the_field_does() {
    let project = Project::shipped(&["viewer"], "  prep:\n    parameters: {lr_width: 32}\n");
    text_scene(&project.path("text"));
    let arguments = ["-i", "dataset=./text", "-p", "rays=300000", "-p", "hidden_dim=32"];
    let (page, views) = viewed(&project, &arguments);
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(html.len() < 25_000_000 && !html.contains("://"), "{} bytes", html.len());
    let Some(views) = checked(&page, &views, 27.0, 64.0) else { return };
    assert_eq!(views.len(), 3);
    // A mirrored page would show mirrored text.
    for view in &views {
        let [psnr, mirrored] = ["psnr", "mirrored"].map(|key| view[key].as_f64().unwrap());
        assert!(mirrored < psnr - 4.0, "{view}");
    }
}

/// Field of a comparison, with sizes that suit it.
struct Compared {
    /// Parameters of the training.
    field: String,
    /// Voxels along the cube's side.
    resolution: u32,
    /// Width of the views, and rays along a pixel's side.
    views: (u32, u32),
    /// Maximum number of texture reads per pixel.
    max_reads: f64,
}

/// A grid of the default size: smaller fields and fewer rays give haze.
fn grid() -> Compared {
    let field = "rays: 300000, n_levels: 8, cells_per_pixel: 2.56, log2_hashmap_size: null, \
        hidden_dim: 64, march_steps: null, max_rays_per_step: 8192, samples_per_step: 24576";
    Compared { field: field.to_owned(), resolution: 128, views: (256, 2), max_reads: 64.0 }
}

/// The paper's field in miniature, which is rendered slowly. After so few rays the field has haze,
/// whose reads differ between processors by libtorch's rounding.
fn mlp() -> Compared {
    let field = "field: mlp, rays: 60000, supersample: 1, hidden_dim: 48, layers: 4, \
        coarse_samples: 24, fine_samples: 24, max_rays_per_step: 128, learning_rate: 0.002";
    Compared { field: field.to_owned(), resolution: 64, views: (128, 1), max_reads: 80.0 }
}

/// Blocks of a demo scene and its field.
fn clear_scene(demo_scene: &str, field: &str) -> String {
    format!(
        "  demo-scene:\n    parameters: {{size: 64, train: 40{demo_scene}}}\n  \
        prep:\n    parameters: {{lr_width: 32}}\n  \
        train-ss:\n    parameters: {{{field}}}\n"
    )
}

/// Trains a field of the demo scene in a space, and compares the page with rendered views. Returns
/// the project.
fn compare_space(demo_scene: &str, space: &str, compared: &Compared) -> Project {
    compare_page(&clear_scene(demo_scene, &compared.field), &[], space, compared)
}

/// Trains the field of the stages in `blocks`, and compares the page with rendered views of three
/// test cameras and of three cameras between them. `inputs` are command-line arguments. Returns the
/// project.
fn compare_page(blocks: &str, inputs: &[&str], space: &str, compared: &Compared) -> Project {
    let (size, samples) = compared.views;
    let blocks = format!(
        "{blocks}  camera-path:\n    inputs: {{cameras: prep/cameras}}\n    \
        parameters: {{kind: between, frames: 6, size: {size}}}\n  \
        path-views:\n    parameters: {{samples_per_axis: {samples}}}\n  \
        viewer:\n    parameters: {{resolution: {}}}\n",
        compared.resolution
    );
    let project = Project::shipped(&["viewer", "video"], &blocks);
    project.ok(&[&["run", "viewer", "path-views"], inputs].concat());
    let field = project.json("train-ss", "field.json", &[&["train-ss"], inputs].concat());
    let found = &field["bounds"]["space"];
    assert!(found == space || found.get(space).is_some(), "{found}");
    let page = project.path("out/viewer/index.html");
    assert!(page.metadata().unwrap().len() < 25_000_000);
    let views = project.artifact("path-views", &[&["path-views"], inputs].concat());
    let Some(views) = checked(&page, &views, 26.0, compared.max_reads) else { return project };
    assert_eq!(views.len(), 6);
    for view in &views {
        let [psnr, mirrored] = ["psnr", "mirrored"].map(|key| view[key].as_f64().unwrap());
        assert!(mirrored < psnr - 3.0, "{view}");
    }
    project
}

#[test]
fn the_page_shows_a_box_and_people_can_look_around() {
    look_around(&compare_space("", "box", &grid()));
}

#[test]
fn the_page_shows_a_frustum() {
    compare_space(", layout: forward, backdrop: true", "ndc", &grid());
}

#[test]
fn the_page_shows_a_contracted_space() {
    compare_space(", backdrop: true", "contraction", &grid());
}

/// Forward-facing photographs.
#[test]
fn the_page_shows_fern() {
    let Some(data) = data() else { return };
    let dataset = format!("dataset={}", data.join("nerf_llff_data/fern").display());
    let compared = Compared { resolution: 160, ..grid() };
    let blocks = format!(
        "  prep:\n    parameters: {{lr_width: 126}}\n  train-ss:\n    parameters: {{{}}}\n",
        compared.field
    );
    compare_page(&blocks, &["-i", &dataset], "ndc", &compared);
}

#[test]
fn the_page_shows_the_papers_field() {
    compare_space(", backdrop: true", "contraction", &mlp());
}

fn distance_from_origin(state: &Value) -> f64 {
    let centre = state["centre"].as_array().unwrap().iter();
    centre.map(|c| c.as_f64().unwrap().powi(2)).sum::<f64>().sqrt()
}

/// A recorded path has frames between its keys, and `camera-path` reads it: the page and
/// `render-depth` show the same.
fn check_recorder(project: &Project, recorded: &Path, second: &Value) {
    let path: Value = serde_json::from_slice(&std::fs::read(recorded).unwrap()).unwrap();
    let frames = |path: &Value| path["camera_path"].as_array().unwrap().clone();
    assert_eq!((frames(&path).len(), frames(second).len()), (1, 49));
    let pose = |path: &Value| frames(path)[0]["camera_to_world"].as_array().unwrap().clone();
    for (a, b) in pose(&path).iter().zip(&pose(second)) {
        assert!((a.as_f64().unwrap() - b.as_f64().unwrap()).abs() < 1e-9, "{a} {b}");
    }
    let (key, last) = (&second["keyframes"][1], &frames(second)[48]);
    let fields = [("matrix", "camera_to_world"), ("fov", "fov"), ("aspect", "aspect")];
    for (field, of_frame) in fields {
        assert_eq!(key[field], last[of_frame], "{field}");
    }
    let arguments = ["-i", "camera-path.path=recorded", "-p", "camera-path.size=256"];
    project.ok(&[&["run", "path-views"], &arguments[..]].concat());
    let views = project.artifact("path-views", &[&["path-views"], &arguments[..]].concat());
    let page = project.path("out/viewer/index.html");
    assert_eq!(checked(&page, &views, 22.0, 64.0).unwrap().len(), 1);
}

/// Mouse, keys and touches change the view as expected.
fn look_around(project: &Project) {
    project.ok(&["run", "viewer", "-p", "viewer.resolution=64", "-p", "photographs=20"]);
    let page = project.path("out/viewer/index.html");
    let recorded = project.path("recorded/camera_path.json");
    let files = [&page, &project.path("shots"), &recorded];
    let Some(found) = run_in_browser("viewer-controls.mjs", files) else { return };
    let at = |device: &str, when: &str| found[device]["states"][when].clone();
    for device in ["desktop", "phone"] {
        assert_eq!(found[device]["problems"], json!([]), "{device}");
    }
    let desktop = |when: &str| at("desktop", when);
    let (first, next) = (desktop("first"), desktop("next"));
    assert_eq!(next["camera"], (first["camera"].as_i64().unwrap() + 1) % 40);
    // Every other camera has its photograph.
    assert_ne!(first["photograph"], next["photograph"]);
    let steps = ["first", "next", "arrow", "wheel", "drag", "depth", "opacity"];
    for pair in steps.windows(2) {
        assert_ne!(desktop(pair[0])["hash"], desktop(pair[1])["hash"], "{pair:?}");
    }
    assert!(desktop("arrow")["camera"] == -1 && desktop("arrow")["frusta"] == false);
    assert_eq!(desktop("frusta")["frusta"], true);
    assert!(
        distance_from_origin(&desktop("wheel")) > 1.1 * distance_from_origin(&desktop("arrow")),
        "the wheel moves away"
    );
    assert_eq!(first["title"], "demo-scene");
    assert_ne!(desktop("depth")["scale"], "");
    assert_eq!([&desktop("depth")["dialog"], &desktop("keys")["dialog"]], [false, true]);
    for pair in [["keys", "angle"], ["angle", "turntable"]] {
        assert_ne!(desktop(pair[0])["hash"], desktop(pair[1])["hash"], "{pair:?}");
    }
    assert_ne!(desktop("angle")["angle"], desktop("keys")["angle"]);
    let compared = if first["photograph"] == true { &first } else { &next };
    assert_eq!(compared["panes"][0], compared["panes"][1], "one size and level");
    assert_eq!([&desktop("full")["full"], &desktop("saved")["full"]], ["stage", ""]);
    assert_eq!(desktop("saved")["clicked"], "demo-scene.png");
    // Zooming stops before the surface.
    let nearest = &desktop("inside")["nearest"];
    assert!(nearest.as_f64().is_some_and(|found| (0.01..0.2).contains(&found)), "{nearest}");
    assert_eq!(desktop("flown")["camera"], desktop("flown")["clicked"]);
    // The page's own colour is behind the scene, in a dark scheme as well.
    // Haze changes it a little.
    let is_about = |state: &Value, expected: f64| {
        let mut levels = state["corner"].as_array().unwrap().iter().map(|c| c.as_f64().unwrap());
        levels.all(|level| (level - expected).abs() < 24.0)
    };
    assert!(is_about(&first, 255.0) && is_about(&at("phone", "first"), 28.0), "{first}");
    check_recorder(project, &recorded, &desktop("second")["path"]);
    for state in ["hash", "camera", "centre", "frusta"] {
        assert_eq!(desktop("reset")[state], first[state], "{state}");
    }
    let (start, finger, pinch) =
        (at("phone", "first"), at("phone", "finger"), at("phone", "pinch"));
    assert!(
        (distance_from_origin(&finger) - distance_from_origin(&start)).abs()
            < 0.1 * distance_from_origin(&start),
        "a finger orbits"
    );
    assert_ne!(finger["right"], start["right"]);
    assert_eq!(pinch["right"], finger["right"], "two fingers don't turn the view");
    assert!(
        distance_from_origin(&pinch) < 0.8 * distance_from_origin(&finger),
        "fingers that part come nearer"
    );
}

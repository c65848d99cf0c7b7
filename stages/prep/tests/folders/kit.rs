//! Folders of tiny photographs, and the expected results of `prep`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use pixels::Rgba8;
use serde_json::{Value, json};

/// Columns and rows of a photograph.
pub(crate) const SIDE: u32 = 16;
/// Focal length in pixels.
pub(crate) const FOCAL: f64 = 20.0;
/// Intrinsics of a camera of the kit: width, height, fx, fy, cx, cy.
pub(crate) const INSIDE: [f64; 6] = [16.0, 16.0, FOCAL, FOCAL, 8.0, 8.0];

/// Folder of photographs, and the expected result of `prep`.
pub(crate) struct Case {
    /// Issue that the case reproduces, or condition that it tests.
    pub(crate) name: &'static str,
    /// Writes the folder.
    pub(crate) make: fn(&Path),
    /// Parameters in addition to those that keep photographs at their size.
    pub(crate) params: Value,
    pub(crate) expected: Expected,
}

/// Result of `prep`.
pub(crate) enum Expected {
    Scene(Scene),
    /// Whole message; `DIR` stands for the folder.
    Refused(&'static str),
}

/// Scene that is expected.
#[derive(Default)]
pub(crate) struct Scene {
    pub(crate) train: Vec<View>,
    pub(crate) test: Vec<View>,
    /// All notes on the data set, in order.
    pub(crate) notes: Vec<&'static str>,
    /// Further notes, such as those on the background, in any order.
    pub(crate) further: Vec<&'static str>,
}

/// View that is expected.
pub(crate) struct View {
    pub(crate) name: String,
    /// Number of the pose.
    pub(crate) pose: usize,
    /// Intrinsics: width, height, fx, fy, cx, cy.
    pub(crate) inside: [f64; 6],
    /// Lens as in `views.json`; null for a pinhole.
    pub(crate) lens: Value,
    /// True for the pixels that the mask keeps; `None` if the view has no mask.
    pub(crate) mask: Option<fn(u32, u32) -> bool>,
}

/// Returns views whose poses have the given numbers. `#` in `names` stands for the number.
pub(crate) fn views(names: &str, numbers: impl IntoIterator<Item = usize>) -> Vec<View> {
    let view = |pose: usize| View {
        name: names.replace('#', &pose.to_string()),
        pose,
        inside: INSIDE,
        lens: Value::Null,
        mask: None,
    };
    numbers.into_iter().map(view).collect()
}

/// Returns a scene in which every eighth view is held out.
pub(crate) fn held_out(names: &str, count: usize, notes: &[&'static str]) -> Scene {
    let is_test = |number: &usize| number.is_multiple_of(8);
    Scene {
        train: views(names, (0..count).filter(|number| !is_test(number))),
        test: views(names, (0..count).filter(is_test)),
        notes: notes.to_vec(),
        further: Vec::new(),
    }
}

/// Returns a case with the default parameters.
pub(crate) fn case(name: &'static str, make: fn(&Path), expected: Expected) -> Case {
    Case { name, make, params: json!({}), expected }
}

impl Case {
    /// Runs `prep`. Describes the result's first difference from the expected one, if any.
    pub(crate) fn failure(&self) -> Option<String> {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("data");
        fs::create_dir(&folder).unwrap();
        (self.make)(&folder);
        let (params, output) = (dir.path().join("params.json"), dir.path().join("scene"));
        let mut values = json!({"lr_source": "photographs", "scale": 1});
        for (key, value) in self.params.as_object().unwrap() {
            values[key] = value.clone();
        }
        fs::write(&params, values.to_string()).unwrap();
        let finished = Command::new(env!("CARGO_BIN_EXE_prep"))
            .arg("--params")
            .arg(&params)
            .arg("--input")
            .arg(format!("dataset={}", folder.display()))
            .arg("--output")
            .arg(&output)
            .args(["--progress", "none", "--threads", "1"])
            .output()
            .unwrap();
        let (code, stderr) = (finished.status.code(), String::from_utf8_lossy(&finished.stderr));
        match &self.expected {
            Expected::Scene(_) if code != Some(0) => Some(format!("exit code {code:?}: {stderr}")),
            Expected::Scene(scene) => scene.failure(&output),
            Expected::Refused(message) => {
                let message = message.replace("DIR", &folder.display().to_string());
                let is_refused = code == Some(3) && stderr.trim_end() == format!("prep: {message}");
                (!is_refused).then(|| {
                    format!("exit code {code:?}:\n  {stderr}  expected:\n  prep: {message}")
                })
            }
        }
    }
}

fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

impl Scene {
    fn failure(&self, output: &Path) -> Option<String> {
        let notes = read_json(&output.join("scene.json"))["notes"].clone();
        let notes: Vec<String> = serde_json::from_value(notes).unwrap();
        let is_choice = |note: &String| note.contains("the photographs are the LR images");
        let split = notes.iter().position(is_choice).unwrap();
        if notes[..split] != self.notes[..] {
            return Some(format!("notes {:#?}, expected {:#?}", &notes[..split], self.notes));
        }
        for expected in &self.further {
            if !notes[split..].iter().any(|note| note == expected) {
                return Some(format!("no note {expected:?} in {:#?}", &notes[split..]));
            }
        }
        let train = failure_of_views(&output.join("train"), &self.train);
        train.or_else(|| failure_of_views(&output.join("truth"), &self.test))
    }
}

fn failure_of_views(subtree: &Path, expected: &[View]) -> Option<String> {
    let list = read_json(&subtree.join("views.json"));
    let views = list["views"].as_array().unwrap();
    let names: Vec<&str> =
        views.iter().map(|view| view["camera"]["name"].as_str().unwrap()).collect();
    let expected_names: Vec<&str> = expected.iter().map(|view| view.name.as_str()).collect();
    if names != expected_names {
        return Some(format!("views {names:?}, expected {expected_names:?}"));
    }
    views.iter().zip(expected).find_map(|(view, expected)| failure_of_view(subtree, view, expected))
}

fn failure_of_view(subtree: &Path, view: &Value, expected: &View) -> Option<String> {
    let camera = &view["camera"];
    let inside = ["width", "height", "fx", "fy", "cx", "cy"]
        .map(|name| camera["intrinsics"][name].as_f64().unwrap());
    let is_near = |a: &f64, b: &f64| (a - b).abs() < 1e-9;
    if !inside.iter().zip(&expected.inside).all(|(a, b)| is_near(a, b)) {
        return Some(format!("{}: {inside:?}, expected {:?}", expected.name, expected.inside));
    }
    let lens = &camera["intrinsics"]["distortion"];
    if *lens != expected.lens {
        return Some(format!("{}: lens {lens}, expected {}", expected.name, expected.lens));
    }
    let pose: Vec<Vec<f64>> = serde_json::from_value(camera["camera_to_world"].clone()).unwrap();
    let expected_pose = pose_of(expected.pose);
    if !pose.iter().flatten().zip(expected_pose.iter().flatten()).all(|(a, b)| is_near(a, b)) {
        return Some(format!("{}: pose {pose:?}, expected {expected_pose:?}", expected.name));
    }
    let mask = view["mask"].as_str();
    let Some(counts) = expected.mask else {
        return mask.map(|mask| format!("{}: unexpected mask {mask}", expected.name));
    };
    let Some(mask) = mask else { return Some(format!("{}: no mask", expected.name)) };
    let mask = pixels::read_png(&subtree.join(mask)).unwrap();
    let wrong = (0..mask.width * mask.height).find(|&i| {
        let is_white = mask.data[4 * i] == 255;
        is_white != counts((i % mask.width) as u32, (i / mask.width) as u32)
    });
    wrong.map(|i| {
        let (x, y) = (i % mask.width, i / mask.width);
        format!("{}: mask differs at ({x}, {y})", expected.name)
    })
}

/// Returns the pose of camera `i` on a ring; the camera faces the origin. 4×4, row by row.
pub(crate) fn pose_of(i: usize) -> [[f64; 4]; 4] {
    let angle = 0.5 * i as f64;
    let (sin, cos) = angle.sin_cos();
    [
        [-sin, 0.0, cos, 4.0 * cos],
        [cos, 0.0, sin, 4.0 * sin],
        [0.0, 1.0, 0.0, 0.1 * i as f64],
        [0.0, 0.0, 0.0, 1.0],
    ]
}

/// Creates an opaque photograph without a flat border, a different one for each seed.
pub(crate) fn photograph(width: u32, height: u32, seed: usize) -> Rgba8 {
    let level = |i: u32, c: u32| {
        let hash = (i + 1).wrapping_mul(2_654_435_761) ^ (c + 7 * seed as u32).wrapping_mul(40_503);
        40 + (hash.wrapping_mul(2_246_822_519) >> 24) as u8 / 2
    };
    let pixel = |i: u32| [level(i, 0), level(i, 1), level(i, 2), 255];
    Rgba8::new(width as usize, height as usize, (0..width * height).flat_map(pixel).collect())
}

fn create_parent(path: &Path) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
}

/// Writes a file and the folders above it.
pub(crate) fn write(path: PathBuf, bytes: impl AsRef<[u8]>) {
    create_parent(&path);
    fs::write(path, bytes).unwrap();
}

/// Writes a photograph of the kit's size as PNG or JPEG, by the name's extension.
pub(crate) fn write_photograph(path: &Path, seed: usize) {
    write_image(path, &photograph(SIDE, SIDE, seed));
}

/// Writes an image as PNG or JPEG, by the name's extension.
pub(crate) fn write_image(path: &Path, image: &Rgba8) {
    let is_jpeg =
        path.extension().is_some_and(|e| e.to_string_lossy().to_lowercase().starts_with('j'));
    let bytes = if is_jpeg { jpeg(image, None) } else { pixels::encode_png(image) };
    write(path.to_path_buf(), bytes);
}

/// Encodes an image as JPEG, with an EXIF orientation if given.
pub(crate) fn jpeg(image: &Rgba8, orientation: Option<u8>) -> Vec<u8> {
    let rgb: Vec<u8> = image.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
    let mut bytes = Vec::new();
    let (width, height) = (image.width as u32, image.height as u32);
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95)
        .encode(&rgb, width, height, image::ExtendedColorType::Rgb8)
        .unwrap();
    if let Some(orientation) = orientation {
        let mut exif =
            b"\xff\xe1\x00\x22Exif\0\0II\x2a\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
        exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0]);
        bytes.splice(2..2, exif);
    }
    bytes
}

/// Writes a mask: white where `counts` is true, black elsewhere.
pub(crate) fn write_mask(path: &Path, size: (u32, u32), counts: fn(u32, u32) -> bool) {
    let pixel = |i: u32| if counts(i % size.0, i / size.0) { [255; 4] } else { [0, 0, 0, 255] };
    let data = (0..size.0 * size.1).flat_map(pixel).collect();
    write_image(path, &Rgba8::new(size.0 as usize, size.1 as usize, data));
}

/// Returns true in the left half of a photograph.
pub(crate) fn left_half(x: u32, _: u32) -> bool {
    x < SIDE / 2
}

/// Writes photographs named by the pattern `names`, in which `#` stands for the number.
pub(crate) fn write_photographs(folder: &Path, names: &str, count: usize) {
    for number in 0..count {
        write_photograph(&folder.join(names.replace('#', &number.to_string())), number);
    }
}

/// Returns `transforms.json` with frames named by a pattern, as JSON to modify.
pub(crate) fn transforms(names: &str, count: usize) -> Value {
    let frames: Vec<Value> = (0..count)
        .map(|number| {
            let name = names.replace('#', &number.to_string());
            json!({"file_path": name, "transform_matrix": pose_of(number)})
        })
        .collect();
    json!({"w": SIDE, "h": SIDE, "fl_x": FOCAL, "fl_y": FOCAL, "cx": 8, "cy": 8, "frames": frames})
}

/// Writes `transforms.json`.
pub(crate) fn write_transforms(folder: &Path, transforms: &Value) {
    write(folder.join("transforms.json"), transforms.to_string());
}

/// Camera of a COLMAP model as text.
pub(crate) const CAMERA: &str = "1 PINHOLE 16 16 20 20 8 8\n";

/// Returns an image's line in COLMAP's text format, without the line of its points.
pub(crate) fn colmap_line(number: usize, name: &str) -> String {
    let pose = pose_of(number);
    let column = |c: usize| glam::DVec3::new(pose[0][c], pose[1][c], pose[2][c]);
    let axes = glam::DMat3::from_cols(column(0), -column(1), -column(2)).transpose();
    let (q, t) = (glam::DQuat::from_mat3(&axes), -(axes * column(3)));
    let id = number + 1;
    format!("{id} {} {} {} {} {} {} {} 1 {name}\n", q.w, q.x, q.y, q.z, t.x, t.y, t.z)
}

/// Writes a COLMAP model as text: a camera, and images named by a pattern.
pub(crate) fn write_colmap(model: &Path, camera: &str, names: &str, count: usize) {
    let mut images = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n".to_owned();
    for number in 0..count {
        images += &colmap_line(number, &names.replace('#', &number.to_string()));
        images += "\n";
    }
    write(model.join("cameras.txt"), camera);
    write(model.join("images.txt"), images);
}

/// Writes `poses_bounds.npy` with the poses of the given numbers.
pub(crate) fn write_llff(folder: &Path, poses: &[usize], bounds: [f64; 2]) {
    let mut numbers: Vec<f64> = Vec::new();
    for &pose in poses {
        let inside = [f64::from(SIDE), f64::from(SIDE), FOCAL];
        for (row, inside) in pose_of(pose).iter().zip(inside) {
            numbers.extend([-row[1], row[0], row[2], row[3], inside]);
        }
        numbers.extend(bounds);
    }
    let header =
        format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({}, 17), }}", poses.len());
    let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    bytes.extend(format!("{header:<117}\n").bytes());
    bytes.extend(numbers.iter().flat_map(|v| v.to_le_bytes()));
    write(folder.join("poses_bounds.npy"), bytes);
}

//! The demo scene's training views as a user's photographs, in each supported data set format.

#![allow(dead_code, reason = "every test file uses a part of it")]
#![allow(unreachable_pub, reason = "shared by several test binaries")]

use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use serde_json::{Value, json};

use super::common::{Project, stage};

/// Width and height of the photographs, in pixels.
pub const WIDTH: u32 = 32;
/// Field of view of the photographs, in radians.
pub const ANGLE: f64 = 0.691_111_2;

/// Data set format.
pub struct Form {
    /// Name of the folder.
    pub name: &'static str,
    /// Writes the folder.
    pub write: fn(&Project) -> PathBuf,
    /// Name of the format in the output of `nerf-sr init`.
    pub found: &'static str,
    /// Value of `lr_source` that `nerf-sr init` chooses.
    pub lr_source: &'static str,
}

/// All formats except the demo scene's own.
pub const FORMS: &[Form] = &[
    Form {
        name: "transforms",
        write: as_transforms,
        found: "transforms.json (instant-ngp, nerfstudio)",
        lr_source: "photographs",
    },
    Form { name: "colmap", write: as_colmap, found: "COLMAP (sparse)", lr_source: "photographs" },
    Form {
        name: "llff",
        write: as_llff,
        found: "LLFF (poses_bounds.npy)",
        lr_source: "downscaled",
    },
];

fn column(frame: &Value, column: usize) -> DVec3 {
    DVec3::from(
        [0, 1, 2].map(|row: usize| frame["transform_matrix"][row][column].as_f64().unwrap()),
    )
}

/// Writes opaque images of a demo scene's training views to `folder/images`; returns each view's
/// name, rotation (right, up, back as columns) and centre.
pub fn photographs(project: &Project, folder: &str) -> Vec<(String, DMat3, DVec3)> {
    let data = project.path("data");
    if !data.exists() {
        let params =
            format!(r#"{{"size": {WIDTH}, "train": 20, "test": 1, "samples_per_axis": 2}}"#);
        assert_eq!(stage("demo-scene", &params, &[], &data, &[]).code, 0);
    }
    let text = std::fs::read_to_string(data.join("transforms_train.json")).unwrap();
    let transforms: Value = serde_json::from_str(&text).unwrap();
    assert!((transforms["camera_angle_x"].as_f64().unwrap() - ANGLE).abs() < 1e-9);
    let images = project.path(folder).join("images");
    std::fs::create_dir_all(&images).unwrap();
    let frames = transforms["frames"].as_array().unwrap().iter();
    let mut views: Vec<_> = frames
        .map(|frame| {
            let name = Path::new(frame["file_path"].as_str().unwrap())
                .file_name()
                .unwrap()
                .to_str()
                .unwrap()
                .to_owned();
            let image = pixels::read_premultiplied(&data.join(format!("train/{name}.png")))
                .unwrap()
                .over(1.0);
            pixels::write_png(&images.join(format!("{name}.png")), &image.to_rgba8()).unwrap();
            (
                name,
                DMat3::from_cols(column(frame, 0), column(frame, 1), column(frame, 2)),
                column(frame, 3),
            )
        })
        .collect();
    // LLFF's poses are in the order of the image names.
    views.sort_by(|a, b| a.0.cmp(&b.0));
    views
}

pub fn focal() -> f64 {
    0.5 * f64::from(WIDTH) / (0.5 * ANGLE).tan()
}

pub fn as_transforms(project: &Project) -> PathBuf {
    let views = photographs(project, "transforms");
    let frames: Vec<Value> = views
        .iter()
        .map(|(name, axes, centre)| {
            let row = |k: usize| [axes.x_axis[k], axes.y_axis[k], axes.z_axis[k], centre[k]];
            let matrix = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
            json!({"file_path": format!("images/{name}.png"), "transform_matrix": matrix})
        })
        .collect();
    let text = json!({"fl_x": focal(), "w": WIDTH, "h": WIDTH, "frames": frames}).to_string();
    let folder = project.path("transforms");
    std::fs::write(folder.join("transforms.json"), text).unwrap();
    folder
}

pub fn as_colmap(project: &Project) -> PathBuf {
    let views = photographs(project, "colmap");
    let sparse = project.path("colmap/sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    let centre = 0.5 * f64::from(WIDTH);
    std::fs::write(
        sparse.join("cameras.txt"),
        format!("1 SIMPLE_PINHOLE {WIDTH} {WIDTH} {} {centre} {centre}\n", focal()),
    )
    .unwrap();
    let mut images = "# as COLMAP registers them: in no order\n".to_owned();
    for (id, (name, axes, centre)) in views.iter().enumerate().rev() {
        // COLMAP's poses are world to camera, with axes right, down, forward.
        let rotation = DMat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis).transpose();
        let (q, t) = (DQuat::from_mat3(&rotation), -(rotation * *centre));
        images += &format!(
            "{} {} {} {} {} {} {} {} 1 {name}.png\n\n",
            id + 1,
            q.w,
            q.x,
            q.y,
            q.z,
            t.x,
            t.y,
            t.z
        );
    }
    std::fs::write(sparse.join("images.txt"), images).unwrap();
    project.path("colmap")
}

pub fn as_llff(project: &Project) -> PathBuf {
    let views = photographs(project, "llff");
    let mut numbers: Vec<f64> = Vec::new();
    for (_, axes, centre) in &views {
        // The fifth column of LLFF's matrices: height, width, focal length.
        let hwf = [f64::from(WIDTH), f64::from(WIDTH), focal()];
        for k in 0..3 {
            numbers.extend([-axes.y_axis[k], axes.x_axis[k], axes.z_axis[k], centre[k], hwf[k]]);
        }
        numbers.extend([2.0, 6.0]);
    }
    let header =
        format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({}, 17), }}", views.len());
    let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    bytes.extend(format!("{header:<117}\n").bytes());
    bytes.extend(numbers.iter().flat_map(|v| v.to_le_bytes()));
    let folder = project.path("llff");
    std::fs::write(folder.join("poses_bounds.npy"), bytes).unwrap();
    folder
}

use std::fmt::Write as _;

use glam::{DMat3, DQuat, DVec3};
use pixels::to_u8;
use scene::{Camera, Distortion, Intrinsics};
use serde_json::{Value, json};

use crate::surfel::Surfel;

/// Maximum number of points of a COLMAP model: about as many as structure from motion finds.
const MAX_POINTS: usize = 100_000;

/// Returns `transforms.json` in the format of instant-ngp and nerfstudio. Images aren't exported;
/// their paths are `images/NAME.png`.
pub(crate) fn transforms_json(cameras: &[Camera], points: Option<&str>) -> Value {
    let shared = shared_intrinsics(cameras);
    let frames: Value =
        cameras.iter().map(|camera| frame_entry(camera, shared.is_some())).collect();
    let mut file = shared.map_or_else(|| json!({}), lens_entries);
    file["frames"] = frames;
    if let Some(points) = points {
        file["ply_file_path"] = json!(points);
    }
    file
}

/// Returns the entry of a camera.
fn frame_entry(camera: &Camera, has_shared_lens: bool) -> Value {
    let mut entry = if has_shared_lens { json!({}) } else { lens_entries(&camera.intrinsics) };
    let mut matrix = camera.camera_to_world.to_vec();
    matrix.push([0.0, 0.0, 0.0, 1.0]);
    entry["file_path"] = json!(format!("images/{}.png", camera.name));
    entry["transform_matrix"] = json!(matrix);
    entry
}

/// Returns the intrinsics of all cameras if they are equal.
fn shared_intrinsics(cameras: &[Camera]) -> Option<&Intrinsics> {
    let first = &cameras.first()?.intrinsics;
    cameras.iter().all(|camera| camera.intrinsics == *first).then_some(first)
}

/// Returns an object with the entries for intrinsics.
fn lens_entries(k: &Intrinsics) -> Value {
    let ([k1, k2, k3, k4], [p1, p2]) = (k.distortion.radial, k.distortion.tangential);
    let mut entries = json!({
        "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width, "h": k.height,
        "k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2,
    });
    if k4 != 0.0 || k.distortion.is_fisheye() {
        entries["k4"] = json!(k4);
    }
    if k.distortion.is_fisheye() {
        entries["camera_model"] = json!("OPENCV_FISHEYE");
        entries["is_fisheye"] = json!(true);
        return entries;
    }
    entries["camera_model"] = json!(if k.distortion.is_none() { "PINHOLE" } else { "OPENCV" });
    // Angles describe a pinhole camera only.
    entries["camera_angle_x"] = json!(2.0 * (0.5 * f64::from(k.width) / k.fx).atan());
    entries["camera_angle_y"] = json!(2.0 * (0.5 * f64::from(k.height) / k.fy).atan());
    entries
}

/// Format of exported cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CameraFormat {
    /// `transforms.json`.
    Transforms,
    /// COLMAP's text files.
    Colmap,
}

impl CameraFormat {
    /// Returns why the format can't describe the cameras' lenses, or `None` if it can.
    pub(crate) fn lens_problem(self, cameras: &[Camera]) -> Option<&'static str> {
        let has_lens =
            |is: fn(&Distortion) -> bool| cameras.iter().any(|c| is(&c.intrinsics.distortion));
        match self {
            Self::Transforms if has_lens(|lens| lens.denominator != [0.0; 3]) => Some(
                "transforms.json is not written: its readers don't support the rational terms of \
                a lens, OpenCV's k4 to k6",
            ),
            Self::Colmap if has_lens(|lens| lens.radial[3] != 0.0 && !lens.is_fisheye()) => Some(
                "colmap/ is not written: COLMAP doesn't support the fourth radial term of a \
                perspective lens",
            ),
            _ => None,
        }
    }
}

/// Returns a COLMAP model as text files: names and contents. Poses are world to camera with axes
/// right, down, forward. Points have no track. Surfels are relative to `offset`, cameras aren't.
pub(crate) fn colmap_files(
    cameras: &[Camera],
    surfels: &[Surfel],
    offset: DVec3,
) -> [(&'static str, String); 3] {
    let mut lenses: Vec<&Intrinsics> = Vec::new();
    let mut images =
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; a line of points\n".to_owned();
    for (i, camera) in cameras.iter().enumerate() {
        let lens = lenses.iter().position(|k| **k == camera.intrinsics).unwrap_or_else(|| {
            lenses.push(&camera.intrinsics);
            lenses.len() - 1
        });
        let (q, t) = world_to_camera(camera);
        let pose = [q.w, q.x, q.y, q.z, t.x, t.y, t.z].map(|v| v.to_string()).join(" ");
        let _ = writeln!(images, "{} {pose} {} {}.png\n", i + 1, lens + 1, camera.name);
    }
    let mut lens_text = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n".to_owned();
    for (i, k) in lenses.iter().enumerate() {
        let (model, parameters) = colmap_model(k);
        let parameters = parameters.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        let _ = writeln!(lens_text, "{} {model} {} {} {parameters}", i + 1, k.width, k.height);
    }
    let mut points = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n".to_owned();
    let step = surfels.len().div_ceil(MAX_POINTS).max(1);
    for (i, surfel) in surfels.iter().step_by(step).enumerate() {
        let [x, y, z] = world_coordinates(surfel.position, offset);
        let [r, g, b] = surfel.colour.map(to_u8);
        let _ = writeln!(points, "{} {x} {y} {z} {r} {g} {b} 0", i + 1);
    }
    [("cameras.txt", lens_text), ("images.txt", images), ("points3D.txt", points)]
}

/// Returns a point's world coordinates as text: in double precision if there is an offset, because
/// single precision is too coarse then.
fn world_coordinates(position: DVec3, offset: DVec3) -> [String; 3] {
    if offset == DVec3::ZERO {
        position.as_vec3().to_array().map(|x| x.to_string())
    } else {
        (offset + position).to_array().map(|x| x.to_string())
    }
}

/// Returns COLMAP's model of a lens, and its parameters.
fn colmap_model(k: &Intrinsics) -> (&'static str, Vec<f64>) {
    let ([k1, k2, k3, k4], [p1, p2]) = (k.distortion.radial, k.distortion.tangential);
    let [d1, d2, d3] = k.distortion.denominator;
    let is_rational = [d1, d2, d3] != [0.0; 3];
    let pinhole = [k.fx, k.fy, k.cx, k.cy];
    if k.distortion.is_none() {
        ("PINHOLE", pinhole.to_vec())
    } else if k.distortion.is_fisheye() && [p1, p2] == [0.0; 2] {
        ("OPENCV_FISHEYE", [&pinhole[..], &[k1, k2, k3, k4]].concat())
    } else if k.distortion.is_fisheye() {
        ("THIN_PRISM_FISHEYE", [&pinhole[..], &[k1, k2, p1, p2, k3, k4, 0.0, 0.0]].concat())
    } else if k3 == 0.0 && !is_rational {
        ("OPENCV", [&pinhole[..], &[k1, k2, p1, p2]].concat())
    } else {
        ("FULL_OPENCV", [&pinhole[..], &[k1, k2, p1, p2, k3, d1, d2, d3]].concat())
    }
}

/// Returns rotation and translation from the world to a camera with axes right, down, forward.
fn world_to_camera(camera: &Camera) -> (DQuat, DVec3) {
    let axes = camera.rotation();
    let matrix = DMat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis).transpose();
    let rotation = DQuat::from_mat3(&matrix).normalize();
    (rotation, -(rotation * camera.centre()))
}

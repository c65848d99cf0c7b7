use anyhow::{anyhow, bail};
use artifact::shortened;
use scene::Distortion;
use serde_json::Value;

use crate::entry::Entry;

/// Names of camera models; case is ignored.
const PERSPECTIVE_MODELS: [&str; 6] =
    ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"];
const RATIONAL_MODEL: &str = "FULL_OPENCV";
const FISHEYE_MODELS: [&str; 5] =
    ["OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"];
/// Names of panoramas in longitude and latitude.
const PANORAMAS: [&str; 2] = ["equirectangular", "latlong"];

/// Keys of a lens whose values are numbers.
const NUMBERS: [&str; 16] = [
    "camera_angle_x",
    "camera_angle_y",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "w",
    "h",
    "k1",
    "k2",
    "k3",
    "k4",
    "k5",
    "k6",
    "p1",
    "p2",
];
/// Other keys of a lens; the last four mark projections of instant-ngp that aren't supported.
const OTHERS: [&str; 6] =
    ["camera_model", "is_fisheye", "equirectangular", "latlong", "orthographic", "ftheta_p0"];

/// Returns the values of a lens in an entry; fails if one has the wrong type.
pub(crate) fn lens_part(entry: &Entry) -> anyhow::Result<Entry> {
    for key in NUMBERS {
        entry.number(key)?;
    }
    entry.text("camera_model")?;
    entry.flag("is_fisheye")?;
    Ok(entry.part(&[&NUMBERS[..], &OTHERS].concat()))
}

/// Returns a frame's lens: its own values, and those of the file's lens for the keys that it lacks.
/// The frame's angle of view, if any, replaces the file's focal length along the same axis.
pub(crate) fn frame_lens(own: &Entry, shared: &Entry) -> Entry {
    let mut lens = shared.clone();
    for (angle, length) in [("camera_angle_x", "fl_x"), ("camera_angle_y", "fl_y")] {
        if own.has(angle) {
            lens.remove(length);
        }
    }
    lens.extend(own.clone());
    lens
}

/// Returns the distortion of a frame's lens, with instant-ngp's and nerfstudio's keys; fails for a
/// model that isn't supported. For a fisheye lens k1 to k4 are OpenCV's. For a perspective lens k4
/// is Brown's fourth radial term, as in nerfstudio, unless the model is OpenCV's rational one, the
/// only one with k5 and k6.
pub(crate) fn distortion(entry: &Entry) -> anyhow::Result<Distortion> {
    if let Some(model) = unsupported_projection(entry) {
        bail!(unsupported_model(model));
    }
    let mut coefficients = [0.0; 8];
    for (i, key) in ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"].into_iter().enumerate() {
        coefficients[i] = entry.number(key)?.unwrap_or(0.0);
    }
    let [k1, k2, k3, k4, k5, k6, p1, p2] = coefficients;
    let tangential = [p1, p2];
    let model = entry.text("camera_model")?.unwrap_or("OPENCV");
    let is_marked = entry.flag("is_fisheye")? == Some(true);
    let is_in = |models: &[&str]| models.iter().any(|name| name.eq_ignore_ascii_case(model));
    let (is_fisheye, is_rational) = if is_in(&PERSPECTIVE_MODELS) {
        (is_marked, k5 != 0.0 || k6 != 0.0)
    } else if is_in(&[RATIONAL_MODEL]) {
        (is_marked, true)
    } else if is_in(&FISHEYE_MODELS) {
        (true, false)
    } else {
        bail!(unsupported_model(model));
    };
    let radial = [k1, k2, k3, k4];
    Ok(if is_fisheye {
        Distortion { tangential, ..Distortion::fisheye(radial) }
    } else if is_rational {
        let numerator = Distortion::brown([k1, k2, k3], tangential);
        Distortion { denominator: [k4, k5, k6], ..numerator }
    } else {
        Distortion { radial, tangential, ..Distortion::default() }
    })
}

/// Returns the name of instant-ngp's projection if it isn't supported.
fn unsupported_projection(entry: &Entry) -> Option<&'static str> {
    ["equirectangular", "latlong", "orthographic"]
        .into_iter()
        .find(|name| entry.value(name) == Some(&Value::Bool(true)))
        .or_else(|| entry.has("ftheta_p0").then_some("ftheta"))
}

/// Returns the error for a camera model that isn't supported.
fn unsupported_model(model: &str) -> anyhow::Error {
    let remedy = if PANORAMAS.iter().any(|name| name.eq_ignore_ascii_case(model)) {
        "cut the panoramas into views and estimate their cameras: ns-process-data images \
        --camera-type equirectangular"
            .to_owned()
    } else {
        let known = [&PERSPECTIVE_MODELS[..], &[RATIONAL_MODEL], &FISHEYE_MODELS].concat();
        let known = known.join(", ");
        format!("undistort the images first (colmap image_undistorter); supported are {known}")
    };
    anyhow!("camera_model {:?} is not supported; {remedy}", shortened(model))
}

//! COLMAP's camera models (its `models.h`).

use anyhow::{bail, ensure};
use scene::{Distortion, Intrinsics, Projection};

/// Camera model of COLMAP.
pub(super) struct CameraModel {
    /// Id in binary files.
    number: u32,
    /// Name in text files.
    name: &'static str,
    /// Names of the parameters: `d1` to `d3` are terms of the denominator.
    pub(super) parameters: &'static [&'static str],
}

/// Known models. COLMAP 4 has more, which are reported as unknown.
const MODELS: [CameraModel; 13] = [
    model(0, "SIMPLE_PINHOLE", &["f", "cx", "cy"]),
    model(1, "PINHOLE", &["fx", "fy", "cx", "cy"]),
    model(2, "SIMPLE_RADIAL", &["f", "cx", "cy", "k1"]),
    model(3, "RADIAL", &["f", "cx", "cy", "k1", "k2"]),
    model(4, "OPENCV", &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"]),
    model(5, "OPENCV_FISHEYE", &["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]),
    model(
        6,
        "FULL_OPENCV",
        &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "d1", "d2", "d3"],
    ),
    model(7, "FOV", &["fx", "fy", "cx", "cy", "omega"]),
    model(8, "SIMPLE_RADIAL_FISHEYE", &["f", "cx", "cy", "k1"]),
    model(9, "RADIAL_FISHEYE", &["f", "cx", "cy", "k1", "k2"]),
    model(
        10,
        "THIN_PRISM_FISHEYE",
        &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"],
    ),
    model(14, "SIMPLE_FISHEYE", &["f", "cx", "cy"]),
    model(15, "FISHEYE", &["fx", "fy", "cx", "cy"]),
];

const fn model(
    number: u32,
    name: &'static str,
    parameters: &'static [&'static str],
) -> CameraModel {
    CameraModel { number, name, parameters }
}

/// Remedy for a camera model that isn't supported.
pub(super) const UNDISTORT: &str = "undistort with colmap image_undistorter";

impl CameraModel {
    /// Finds a model by its number.
    pub(super) fn with_number(number: u32) -> Option<&'static Self> {
        MODELS.iter().find(|model| model.number == number)
    }

    /// Finds a model by its name.
    pub(super) fn with_name(name: &str) -> Option<&'static Self> {
        MODELS.iter().find(|model| model.name == name)
    }

    /// Returns a camera's intrinsics; fails if size or parameters are invalid.
    pub(super) fn intrinsics(
        &self,
        width: u64,
        height: u64,
        parameters: &[f64],
    ) -> anyhow::Result<Intrinsics> {
        let [columns, rows] = [width, height].map(|side| u32::try_from(side).unwrap_or(0));
        ensure!(columns > 0 && rows > 0, "image size {width}×{height} is invalid");
        let Self { name, parameters: names, .. } = self;
        let (expected, found) = (names.len(), parameters.len());
        ensure!(found == expected, "{name} has {expected} parameters, not {found}");
        let mut k = Intrinsics {
            width: columns,
            height: rows,
            fx: 0.0,
            fy: 0.0,
            cx: 0.0,
            cy: 0.0,
            distortion: Distortion::default(),
        };
        if name.contains("FISHEYE") {
            k.distortion.projection = Projection::Fisheye;
        }
        for (i, parameter) in names.iter().enumerate() {
            let Distortion { radial, tangential, denominator, .. } = &mut k.distortion;
            let target = match *parameter {
                "f" => {
                    k.fy = parameters[i];
                    &mut k.fx
                }
                "fx" => &mut k.fx,
                "fy" => &mut k.fy,
                "cx" => &mut k.cx,
                "cy" => &mut k.cy,
                "k1" => &mut radial[0],
                "k2" => &mut radial[1],
                "k3" => &mut radial[2],
                "k4" => &mut radial[3],
                "p1" => &mut tangential[0],
                "p2" => &mut tangential[1],
                "d1" => &mut denominator[0],
                "d2" => &mut denominator[1],
                "d3" => &mut denominator[2],
                "omega" => bail!("camera model {name} is not supported; {UNDISTORT}"),
                "sx1" | "sy1" if parameters[i] == 0.0 => continue,
                _ => bail!("{parameter} of camera model {name} is not supported; {UNDISTORT}"),
            };
            *target = parameters[i];
        }
        Ok(k)
    }
}

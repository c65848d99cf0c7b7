//! COLMAP's camera models (its `models.h`).

use scene::{Distortion, Intrinsics};

use crate::error::Reason;

/// Camera model of COLMAP.
pub(super) struct CameraModel {
    /// Id in binary files.
    number: u32,
    /// Name in text files.
    name: &'static str,
    /// Number of parameters.
    pub(super) parameter_count: usize,
}

/// Known models. COLMAP 4 has more, which are reported as unknown.
const MODELS: [CameraModel; 13] = [
    CameraModel { number: 0, name: "SIMPLE_PINHOLE", parameter_count: 3 },
    CameraModel { number: 1, name: "PINHOLE", parameter_count: 4 },
    CameraModel { number: 2, name: "SIMPLE_RADIAL", parameter_count: 4 },
    CameraModel { number: 3, name: "RADIAL", parameter_count: 5 },
    CameraModel { number: 4, name: "OPENCV", parameter_count: 8 },
    CameraModel { number: 5, name: "OPENCV_FISHEYE", parameter_count: 8 },
    CameraModel { number: 6, name: "FULL_OPENCV", parameter_count: 12 },
    CameraModel { number: 7, name: "FOV", parameter_count: 5 },
    CameraModel { number: 8, name: "SIMPLE_RADIAL_FISHEYE", parameter_count: 4 },
    CameraModel { number: 9, name: "RADIAL_FISHEYE", parameter_count: 5 },
    CameraModel { number: 10, name: "THIN_PRISM_FISHEYE", parameter_count: 12 },
    CameraModel { number: 14, name: "SIMPLE_FISHEYE", parameter_count: 3 },
    CameraModel { number: 15, name: "FISHEYE", parameter_count: 4 },
];

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
    ) -> Result<Intrinsics, Reason> {
        let [columns, rows] =
            [width, height].map(|side| u32::try_from(side).ok().filter(|side| *side > 0));
        let (Some(columns), Some(rows)) = (columns, rows) else {
            return Err(Reason::new(format!("image size {width}×{height} is invalid")));
        };
        let found = parameters.len();
        if found != self.parameter_count {
            let Self { name, parameter_count: expected, .. } = self;
            return Err(Reason::new(format!("{name} has {expected} parameters, not {found}")));
        }
        let ([fx, fy, cx, cy], distortion) = self.lens(parameters)?;
        Ok(Intrinsics { width: columns, height: rows, fx, fy, cx, cy, distortion })
    }

    /// Returns [fx, fy, cx, cy] and the distortion; fails for a model that isn't supported.
    fn lens(&self, parameters: &[f64]) -> Result<([f64; 4], Distortion), Reason> {
        let none = Distortion::default();
        let lens = match (self.name, parameters) {
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f, cx, cy], none),
            ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy, cx, cy], none),
            ("SIMPLE_RADIAL", &[f, cx, cy, k]) => {
                ([f, f, cx, cy], Distortion::brown([k, 0.0, 0.0], [0.0; 2]))
            }
            ("RADIAL", &[f, cx, cy, k1, k2]) => {
                ([f, f, cx, cy], Distortion::brown([k1, k2, 0.0], [0.0; 2]))
            }
            ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
                ([fx, fy, cx, cy], Distortion::brown([k1, k2, 0.0], [p1, p2]))
            }
            ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
                let numerator = Distortion::brown([k1, k2, k3], [p1, p2]);
                ([fx, fy, cx, cy], Distortion { denominator: [k4, k5, k6], ..numerator })
            }
            ("SIMPLE_FISHEYE", &[f, cx, cy]) => ([f, f, cx, cy], Distortion::fisheye([0.0; 4])),
            ("FISHEYE", &[fx, fy, cx, cy]) => ([fx, fy, cx, cy], Distortion::fisheye([0.0; 4])),
            ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k]) => {
                ([f, f, cx, cy], Distortion::fisheye([k, 0.0, 0.0, 0.0]))
            }
            ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => {
                ([f, f, cx, cy], Distortion::fisheye([k1, k2, 0.0, 0.0]))
            }
            ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => {
                ([fx, fy, cx, cy], Distortion::fisheye([k1, k2, k3, k4]))
            }
            ("THIN_PRISM_FISHEYE", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, 0.0, 0.0]) => {
                let radial = Distortion::fisheye([k1, k2, k3, k4]);
                ([fx, fy, cx, cy], Distortion { tangential: [p1, p2], ..radial })
            }
            _ => {
                let part = if self.name == "THIN_PRISM_FISHEYE" { "the prism of " } else { "" };
                let problem = format!("{part}camera model {} is not supported", self.name);
                return Err(Reason::new(format!("{problem}; {UNDISTORT}")));
            }
        };
        Ok(lens)
    }
}

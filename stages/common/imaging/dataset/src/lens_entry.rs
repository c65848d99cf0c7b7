use anyhow::{anyhow, bail};
use artifact::shortened;
use scene::Distortion;
use serde::Deserialize;
use serde_json::Value;

use crate::number::Number;

/// Names of camera models; case is ignored.
const PERSPECTIVE_MODELS: [&str; 6] =
    ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"];
const RATIONAL_MODEL: &str = "FULL_OPENCV";
const FISHEYE_MODELS: [&str; 5] =
    ["OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"];
/// Names of panoramas in longitude and latitude.
const PANORAMAS: [&str; 2] = ["equirectangular", "latlong"];

/// Lens of all frames of a `transforms.json`, or of one, with instant-ngp's and nerfstudio's keys.
#[derive(Deserialize)]
pub(crate) struct LensEntry {
    camera_model: Option<String>,
    pub(crate) camera_angle_x: Option<Number>,
    pub(crate) camera_angle_y: Option<Number>,
    pub(crate) fl_x: Option<Number>,
    pub(crate) fl_y: Option<Number>,
    pub(crate) cx: Option<Number>,
    pub(crate) cy: Option<Number>,
    pub(crate) w: Option<Number>,
    pub(crate) h: Option<Number>,
    k1: Option<Number>,
    k2: Option<Number>,
    k3: Option<Number>,
    k4: Option<Number>,
    k5: Option<Number>,
    k6: Option<Number>,
    p1: Option<Number>,
    p2: Option<Number>,
    is_fisheye: Option<bool>,
    // Other projections of instant-ngp, which are not supported.
    equirectangular: Option<Value>,
    latlong: Option<Value>,
    orthographic: Option<Value>,
    ftheta_p0: Option<Value>,
}

impl LensEntry {
    /// Returns the distortion; fails for a model that isn't supported. For a fisheye lens k1 to k4
    /// are OpenCV's. For a perspective lens k4 is Brown's fourth radial term, as in nerfstudio,
    /// unless the model is OpenCV's rational one, the only one with k5 and k6.
    pub(crate) fn distortion(&self) -> anyhow::Result<Distortion> {
        if let Some(model) = self.unsupported_projection() {
            bail!(unsupported_model(model));
        }
        let [k1, k2, k3, k4, k5, k6, p1, p2] =
            [self.k1, self.k2, self.k3, self.k4, self.k5, self.k6, self.p1, self.p2]
                .map(|coefficient| coefficient.map_or(0.0, |number| number.0));
        let tangential = [p1, p2];
        let model = self.camera_model.as_deref().unwrap_or("OPENCV");
        let is_in = |models: &[&str]| models.iter().any(|name| name.eq_ignore_ascii_case(model));
        let (is_fisheye, is_rational) = if is_in(&PERSPECTIVE_MODELS) {
            (self.is_fisheye == Some(true), k5 != 0.0 || k6 != 0.0)
        } else if is_in(&[RATIONAL_MODEL]) {
            (self.is_fisheye == Some(true), true)
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
    fn unsupported_projection(&self) -> Option<&'static str> {
        for (name, flag) in [
            ("equirectangular", &self.equirectangular),
            ("latlong", &self.latlong),
            ("orthographic", &self.orthographic),
        ] {
            if *flag == Some(Value::Bool(true)) {
                return Some(name);
            }
        }
        self.ftheta_p0.as_ref().map(|_| "ftheta")
    }
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

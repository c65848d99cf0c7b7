use scene::Distortion;
use serde::Deserialize;
use serde_json::Value;

use crate::frame_reason::FrameReason;
use crate::number::Number;

/// Lens of all frames of a `transforms.json`, or of one: instant-ngp's and nerfstudio's words.
#[derive(Clone, Default, Deserialize)]
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
    // instant-ngp's other projections.
    equirectangular: Option<Value>,
    latlong: Option<Value>,
    orthographic: Option<Value>,
    ftheta_p0: Option<Value>,
}

impl LensEntry {
    /// Returns this entry, completed from `other`.
    pub(crate) fn or(&self, other: &Self) -> Self {
        macro_rules! both {
            ($($name:ident),*) => {
                Self { $($name: self.$name.clone().or_else(|| other.$name.clone())),* }
            };
        }
        both!(
            camera_model,
            camera_angle_x,
            camera_angle_y,
            fl_x,
            fl_y,
            cx,
            cy,
            w,
            h,
            k1,
            k2,
            k3,
            k4,
            k5,
            k6,
            p1,
            p2,
            is_fisheye,
            equirectangular,
            latlong,
            orthographic,
            ftheta_p0
        )
    }

    /// Returns the distortion, or an error for a model that isn't read. Of a fisheye lens k1 to k4
    /// are OpenCV's. Of a perspective lens k4 is Brown's fourth radial term, as nerfstudio has it,
    /// unless the model is OpenCV's rational one, which alone has k5 and k6.
    pub(crate) fn distortion(&self) -> Result<Distortion, FrameReason> {
        if let Some(model) = self.other_projection() {
            return Err(FrameReason::Model { model: model.to_owned() });
        }
        let or_zero = |k: Option<Number>| k.map_or(0.0, |k| k.0);
        let [k1, k2, k3, k4] = [self.k1, self.k2, self.k3, self.k4].map(or_zero);
        let [k5, k6] = [self.k5, self.k6].map(or_zero);
        let tangential = [self.p1, self.p2].map(or_zero);
        let model = self.camera_model.as_deref().unwrap_or("OPENCV");
        let (is_fisheye, is_rational) = match model {
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL"
            | "PERSPECTIVE" => (self.is_fisheye == Some(true), k5 != 0.0 || k6 != 0.0),
            "FULL_OPENCV" => (self.is_fisheye == Some(true), true),
            "OPENCV_FISHEYE"
            | "SIMPLE_RADIAL_FISHEYE"
            | "RADIAL_FISHEYE"
            | "SIMPLE_FISHEYE"
            | "FISHEYE" => (true, false),
            _ => return Err(FrameReason::Model { model: model.to_owned() }),
        };
        let radial = [k1, k2, k3, k4];
        Ok(if is_fisheye {
            Distortion { tangential, ..Distortion::fisheye(radial) }
        } else if is_rational {
            let above = Distortion::brown([k1, k2, k3], tangential);
            Distortion { denominator: [k4, k5, k6], ..above }
        } else {
            Distortion { radial, tangential, ..Distortion::default() }
        })
    }

    /// Returns the name of a projection that instant-ngp has and this program hasn't.
    fn other_projection(&self) -> Option<&'static str> {
        let is_true = |value: &Option<Value>| *value == Some(Value::Bool(true));
        let flags = [
            ("equirectangular", is_true(&self.equirectangular)),
            ("latlong", is_true(&self.latlong)),
            ("orthographic", is_true(&self.orthographic)),
            ("ftheta", self.ftheta_p0.is_some()),
        ];
        flags.into_iter().find(|(_, has)| *has).map(|(name, _)| name)
    }
}

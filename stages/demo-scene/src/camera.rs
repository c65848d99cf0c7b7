use glam::DVec3;
use scene::{Distortion, Intrinsics, Projection};
use serde_json::{Value, json};

use crate::params::{CAMERA_ANGLE, Params};

/// OpenCV's fisheye coefficients of the lens, which compress angles towards the border, by 4 % at
/// 89°; chosen by hand.
const FISHEYE_COEFFICIENTS: [f64; 4] = [-0.02, 0.006, -0.003, 0.0005];

/// Camera of a split's views; its principal point is the middle of the image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ViewCamera {
    /// Width and height of the images.
    pub(crate) sides: [u32; 2],
    /// Focal length in pixels.
    focal: f64,
    /// Horizontal angle of view of a pinhole camera in radians.
    angle_x: f64,
    /// Fisheye lens instead of a pinhole.
    fisheye: Option<Intrinsics>,
}

impl ViewCamera {
    /// Creates the camera of test views, which is also the default for training views.
    pub(crate) fn of_test(params: &Params) -> Self {
        Self::pinhole(params.test_image_size(), params.test_angle_x_radians())
    }

    /// Creates the camera of training views, with as many pixels per degree in the middle as in
    /// test views.
    pub(crate) fn of_training(params: &Params) -> Self {
        let test = Self::of_test(params);
        let Some(degrees) = params.training_angle() else { return test };
        let half_angle = 0.5 * degrees.to_radians();
        let distortion = Distortion::fisheye(FISHEYE_COEFFICIENTS);
        let is_fisheye = params.projection == Projection::Fisheye;
        let slope = libm::tan(half_angle);
        let half_shorter_side =
            if is_fisheye { distortion.distort([slope, 0.0])[0] } else { slope };
        let enlargement = half_shorter_side / libm::tan(0.5 * CAMERA_ANGLE);
        let sides = test.sides.map(|side| (f64::from(side) * enlargement).round().max(1.0) as u32);
        let [width, height] = sides;
        let [cx, cy] = sides.map(|side| 0.5 * f64::from(side));
        if !is_fisheye {
            return Self::pinhole(sides, 2.0 * libm::atan(cx / test.focal));
        }
        let (fx, fy) = (test.focal, test.focal);
        let intrinsics = Intrinsics { width, height, fx, fy, cx, cy, distortion };
        Self { sides, fisheye: Some(intrinsics), ..test }
    }

    /// Creates a pinhole camera.
    fn pinhole(sides: [u32; 2], angle_x: f64) -> Self {
        let focal = 0.5 * f64::from(sides[0]) / libm::tan(0.5 * angle_x);
        Self { sides, focal, angle_x, fisheye: None }
    }

    /// Returns the direction of the ray at an image position, for a camera with axes right, up and
    /// back; `None` outside the lens's field of view.
    pub(crate) fn direction(
        &self,
        [x, y]: [f64; 2],
        [right, up, back]: [DVec3; 3],
    ) -> Option<DVec3> {
        let [half_x, half_y] = self.sides.map(|side| 0.5 * f64::from(side));
        let [x, y] = match self.fisheye {
            None => [x, y],
            Some(intrinsics) if intrinsics.is_clamped([x, y]) => return None,
            Some(intrinsics) => intrinsics.undistort([x, y]),
        };
        let across = (x - half_x) / self.focal;
        let down = (y - half_y) / self.focal;
        Some((across * right - down * up - back).normalize())
    }

    /// Returns the camera's entries in Blender's format.
    pub(crate) fn blender_entries(&self) -> Value {
        match self.fisheye {
            None => json!({"camera_angle_x": self.angle_x}),
            Some(_) => self.transforms_entries(),
        }
    }

    /// Returns the camera's entries in `transforms.json`.
    pub(crate) fn transforms_entries(&self) -> Value {
        let [width, height] = self.sides;
        let [cx, cy] = self.sides.map(|side| 0.5 * f64::from(side));
        let focal = self.focal;
        let mut entries =
            json!({"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": cx, "cy": cy});
        if let Some(intrinsics) = self.fisheye {
            entries["camera_model"] = json!("OPENCV_FISHEYE");
            for (i, k) in intrinsics.distortion.radial.into_iter().enumerate() {
                entries[format!("k{}", i + 1)] = json!(k);
            }
        }
        entries
    }
}

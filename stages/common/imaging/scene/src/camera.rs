use std::ops::RangeInclusive;

use artifact::format_number;
use glam::{DMat3, DVec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::intrinsics::Intrinsics;
use crate::lens::Distortion;
use crate::pose::{MAX_ROTATION_ERROR, Pose, column_of, moved, rotation_error, rotation_of};

/// Camera: intrinsics and pose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// Name of the view and its files, unique within a list.
    pub name: String,
    /// Image size, focal lengths, principal point and distortion.
    pub intrinsics: Intrinsics,
    /// `[R | t]`, row by row: camera axes (x right, y up, looking along -z) and centre in world
    /// space.
    pub camera_to_world: Pose,
}

/// Ray from a camera, in scene units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraRay {
    /// Centre of the camera.
    pub origin: DVec3,
    /// Unit direction.
    pub direction: DVec3,
}

impl CameraRay {
    /// Returns the point at distance `t`.
    pub fn at(&self, t: f64) -> DVec3 {
        self.origin + t * self.direction
    }
}

/// Rays of a camera, with precomputed directions.
#[derive(Clone, Copy, Debug)]
pub struct CameraRays {
    intrinsics: Intrinsics,
    origin: DVec3,
    /// Direction through the undistorted image position (0, 0), not of unit length.
    corner: DVec3,
    /// Change of the direction per pixel to the right.
    right: DVec3,
    /// Change of the direction per pixel down.
    down: DVec3,
}

impl CameraRays {
    /// Returns the ray through image position (x, y), in pixels from the top left corner.
    pub fn ray(&self, x: f64, y: f64) -> CameraRay {
        let [u, v] = self.intrinsics.undistort([x, y]);
        let direction = self.corner + u * self.right + v * self.down;
        CameraRay { origin: self.origin, direction: direction / direction.length() }
    }
}

/// Error returned when a camera is invalid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// The image size, focal length, principal point or distortion is invalid.
    #[error("{0}")]
    Intrinsics(String),
    /// The pose is invalid.
    #[error("{0}")]
    Pose(String),
}

impl CameraError {
    /// Returns the error for a distortion that isn't invertible within the image.
    pub fn distortion(distortion: Distortion) -> Self {
        let problem = format!("lens distortion {distortion} is not invertible within the image");
        Self::Intrinsics(format!("{problem}; check its coefficients"))
    }
}

/// Maximum distance of a camera from the origin, in scene units. Depths have single precision, and
/// the product of two depths must be finite.
const MAX_CENTRE_DISTANCE: f64 = 1e18;

/// Minimum cosine of the angle between the direction of a forward-facing camera and the mean
/// direction of all cameras: cos 45° (docs/design/004).
const MIN_COMMON_DIRECTION_COSINE: f64 = 0.707;

/// Returns the mean viewing direction of forward-facing cameras; `None` for other cameras.
pub fn common_direction<'a>(cameras: impl Iterator<Item = &'a Camera> + Clone) -> Option<DVec3> {
    let mean = cameras.clone().map(Camera::forward).sum::<DVec3>().try_normalize()?;
    cameras
        .map(Camera::forward)
        .all(|forward| forward.dot(mean) >= MIN_COMMON_DIRECTION_COSINE)
        .then_some(mean)
}

impl Camera {
    /// Returns the rotation R.
    pub fn rotation(&self) -> DMat3 {
        rotation_of(&self.camera_to_world)
    }

    /// Returns the camera's centre in world space.
    pub fn centre(&self) -> DVec3 {
        column_of(&self.camera_to_world, 3)
    }

    /// Returns the viewing direction: -z of the camera, unit length.
    pub fn forward(&self) -> DVec3 {
        -self.rotation().z_axis.normalize()
    }

    /// Returns the camera's rays, for many image positions.
    pub fn rays(&self) -> CameraRays {
        let k = self.intrinsics;
        let r = self.rotation();
        CameraRays {
            intrinsics: k,
            origin: self.centre(),
            corner: r * DVec3::new(-k.cx / k.fx, k.cy / k.fy, -1.0),
            right: r.x_axis / k.fx,
            down: -r.y_axis / k.fy,
        }
    }

    /// Returns the ray through image position (x, y), in pixels from the top left corner; (i + 0.5,
    /// j + 0.5) is a pixel's centre.
    pub fn ray(&self, x: f64, y: f64) -> CameraRay {
        self.rays().ray(x, y)
    }

    /// Projects a world point to (x, y, depth). `None` on or behind the camera's plane, and where
    /// the lens's distortion isn't invertible.
    pub fn project(&self, point: DVec3) -> Option<(f64, f64, f64)> {
        let k = &self.intrinsics;
        let p = self.rotation().transpose() * (point - self.centre());
        let depth = -p.z;
        if depth <= 0.0 {
            return None;
        }
        let undistorted = [k.cx + k.fx * p.x / depth, k.cy - k.fy * p.y / depth];
        let [x, y] = k.distort(undistorted);
        if !k.distortion.is_none() {
            // A distortion may map points outside its valid range back into the image.
            let [u, v] = k.undistort([x, y]);
            let error = (u - undistorted[0]).hypot(v - undistorted[1]);
            if error.is_nan() || error > 1e-3 {
                return None;
            }
        }
        Some((x, y, depth))
    }

    /// Returns the z-depth per unit of distance along a ray of this camera.
    pub fn depth_per_distance(&self, ray: &CameraRay) -> f64 {
        ray.direction.dot(self.forward())
    }

    /// Returns the camera moved by a vector.
    #[must_use]
    pub fn moved(&self, by: DVec3) -> Self {
        Self { camera_to_world: moved(&self.camera_to_world, by), ..self.clone() }
    }

    /// Returns the camera with another image size.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        Self { intrinsics: self.intrinsics.resized(width, height), ..self.clone() }
    }

    /// Fails for an invalid camera: a number that isn't finite, an empty image, intrinsics out of
    /// range, a distortion that isn't invertible, a pose with scale, shear or reflection, or a
    /// centre beyond [`MAX_CENTRE_DISTANCE`].
    pub fn check(&self) -> Result<(), CameraError> {
        self.check_intrinsics()?;
        let pose = self.camera_to_world.as_flattened();
        if let Some(index) = pose.iter().position(|value| !value.is_finite()) {
            let value = if pose[index].is_nan() { "NaN" } else { "infinite" };
            let problem = format!("camera_to_world[{}][{}] is {value}", index / 4, index % 4);
            return Err(CameraError::Pose(format!("{problem}; poses must be finite")));
        }
        if !self.intrinsics.has_unique_rays() {
            return Err(CameraError::distortion(self.intrinsics.distortion));
        }
        let r = self.rotation();
        let (error, determinant, centre) = (rotation_error(r), r.determinant(), self.centre());
        let problem = if error > MAX_ROTATION_ERROR {
            format!(
                "camera_to_world is not a rigid motion: R·Rᵀ differs from the identity by \
                {error:.3}; remove scale or shear from the pose"
            )
        } else if determinant < 0.0 {
            format!(
                "camera_to_world is a reflection (its determinant is {determinant:.3}): axes must \
                be right-handed; negate one of its columns"
            )
        } else if centre.length() > MAX_CENTRE_DISTANCE {
            format!(
                "the camera's centre ({:e}, {:e}, {:e}) is farther from the origin than \
                {MAX_CENTRE_DISTANCE:e}; check the pose and its unit",
                centre.x, centre.y, centre.z
            )
        } else {
            return Ok(());
        };
        Err(CameraError::Pose(problem))
    }

    /// Checks image size, focal lengths and principal point.
    fn check_intrinsics(&self) -> Result<(), CameraError> {
        let Intrinsics { width, height, fx, fy, cx, cy, .. } = self.intrinsics;
        if width == 0 || height == 0 {
            let problem = format!("image size {width}×{height}; both must be at least 1");
            return Err(CameraError::Intrinsics(problem));
        }
        for (name, value, side, quantity, allowed) in [
            ("fx", fx, width, "focal length", ALLOWED_FOCAL_LENGTHS),
            ("fy", fy, height, "focal length", ALLOWED_FOCAL_LENGTHS),
            ("cx", cx, width, "principal point", ALLOWED_PRINCIPAL_POINTS),
            ("cy", cy, height, "principal point", ALLOWED_PRINCIPAL_POINTS),
        ] {
            // NaN is not allowed.
            if !allowed.contains(&(value / f64::from(side))) {
                let is_focal_length = quantity == "focal length";
                let bound = if is_focal_length && value <= 0.0 {
                    "; focal lengths must be above 0"
                } else {
                    ""
                };
                return Err(CameraError::Intrinsics(format!(
                    "{name} is {} pixels, but the image's side is {side} pixels; check that the \
                    {quantity} is in pixels and belongs to this image{bound}",
                    format_number(value)
                )));
            }
        }
        Ok(())
    }
}

/// Allowed focal lengths, relative to the image's side: angles of view from 0.006° to 179.98°. The
/// longest photographic lenses have angles of about 1°.
const ALLOWED_FOCAL_LENGTHS: RangeInclusive<f64> = 1e-4..=1e4;
/// Allowed coordinates of the principal point, relative to the image's side. A crop of a photograph
/// may be far from the principal point.
const ALLOWED_PRINCIPAL_POINTS: RangeInclusive<f64> = -1e4..=1e4;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn camera(axis: DVec3, angle: f64, centre: DVec3) -> Camera {
        let r = DMat3::from_axis_angle(axis.normalize(), angle);
        Camera {
            name: "c".into(),
            intrinsics: Intrinsics {
                width: 37,
                height: 23,
                fx: 40.0,
                fy: 44.0,
                cx: 18.0,
                cy: 12.5,
                distortion: Distortion::default(),
            },
            camera_to_world: crate::pose::pose_of(r, centre),
        }
    }

    fn coordinate() -> impl Strategy<Value = f64> {
        -1.0..1.0f64
    }

    #[test]
    fn points_that_distortion_folds_into_the_image_are_not_projected() {
        let mut camera = camera(DVec3::Z, 0.0, DVec3::ZERO);
        camera.intrinsics.distortion.radial[0] = -0.4;
        camera.check().unwrap();
        // Image positions move outwards up to a slope of 0.91; a slope of 1.6 would fold back to
        // near the centre.
        let project = |slope: f64| camera.project(DVec3::new(slope, 0.0, -1.0));
        assert!(project(0.4).is_some());
        let folded = camera.intrinsics.distort([18.0 + 40.0 * 1.6, 12.5]);
        assert!((0.0..37.0).contains(&folded[0]), "{folded:?}");
        assert_eq!(project(1.6), None);
    }

    fn mild_distortion() -> impl Strategy<Value = Distortion> {
        let radial = (-0.2..0.2f64, -0.05..0.05f64, -0.02..0.02f64);
        (radial, -0.01..0.01f64, -0.01..0.01f64)
            .prop_map(|((k1, k2, k3), p1, p2)| Distortion::brown([k1, k2, k3], [p1, p2]))
    }

    fn fisheye() -> impl Strategy<Value = Distortion> {
        (-0.04..0.06f64, -0.01..0.01f64)
            .prop_map(|(k1, k2)| Distortion::fisheye([k1, k2, 0.0, 0.0]))
    }

    /// Rays of a fisheye camera are at most 89° from its axis, and points beyond are not projected.
    #[test]
    fn a_fisheye_covers_89_degrees_from_its_axis() {
        let mut camera = camera(DVec3::Y, 0.4, DVec3::ONE);
        camera.intrinsics.distortion = Distortion::fisheye([-0.02, 0.006, -0.003, 0.0005]);
        (camera.intrinsics.fx, camera.intrinsics.fy) = (10.0, 10.0);
        camera.check().unwrap();
        let corner = camera.ray(37.0, 0.0);
        let angle = corner.direction.dot(camera.forward()).acos().to_degrees();
        assert!((angle - 89.0).abs() < 1e-9, "{angle}");
        let r = camera.rotation();
        let project = |degrees: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            camera.project(camera.centre() + r * DVec3::new(sin, 0.0, -cos))
        };
        assert!(project(88.9).is_some());
        assert_eq!([project(89.1), project(90.1), project(180.0)], [None; 3]);
    }

    proptest! {
        #[test]
        fn projecting_a_ray_gives_its_pixel_back(
            a in (coordinate(), coordinate(), 0.1..1.0f64), angle in -3.0..3.0f64,
            c in (coordinate(), coordinate(), coordinate()),
            x in 0.0..37.0f64, y in 0.0..23.0f64, t in 0.1..100.0f64,
            distortion in prop_oneof![Just(Distortion::default()), mild_distortion(), fisheye()],
        ) {
            let mut camera = camera(DVec3::from(a), angle, DVec3::from(c) * 5.0);
            camera.intrinsics.distortion = distortion;
            camera.check().unwrap();
            let ray = camera.ray(x, y);
            prop_assert!((ray.direction.length() - 1.0).abs() < 1e-12);
            let (px, py, depth) = camera.project(ray.at(t)).unwrap();
            prop_assert!((px - x).abs() < 1e-8 && (py - y).abs() < 1e-8);
            prop_assert!((depth - t * camera.depth_per_distance(&ray)).abs() < 1e-9 * t.max(1.0));
            prop_assert!(camera.project(ray.at(-t)).is_none());
        }

        /// Corners of LR pixels keep their rays, and s×s HR pixels have their mean at the LR
        /// pixel's centre: a half-pixel shift would fail.
        #[test]
        fn resizing_keeps_pixel_footprints(i in 0u32..37, j in 0u32..23, s in 1u32..6) {
            let lr = camera(DVec3::Z, 0.3, DVec3::ONE);
            let hr = lr.resized(37 * s, 23 * s);
            for (corner_x, corner_y) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let (x, y) = (f64::from(i + corner_x), f64::from(j + corner_y));
                let difference = lr.ray(x, y).direction - hr.ray(x * f64::from(s),
                    y * f64::from(s)).direction;
                prop_assert!(difference.length() < 1e-12);
            }
            let offsets: f64 = (0..s).map(|a| (f64::from(i * s + a) + 0.5) / f64::from(s)).sum();
            prop_assert!((offsets / f64::from(s) - (f64::from(i) + 0.5)).abs() < 1e-12);
        }
    }

    #[test]
    fn impossible_cameras_are_refused() {
        let good = camera(DVec3::Y, 0.5, DVec3::ZERO);
        let mut bad = good.clone();
        bad.camera_to_world[1][2] = f64::NAN;
        let assert_refused = |camera: &Camera, reason: &str| {
            let message = camera.check().unwrap_err().to_string();
            assert!(message.contains(reason), "{message}");
        };
        assert_refused(&bad, "camera_to_world[1][2] is NaN; poses must be finite");
        let mut bad = good.clone();
        bad.intrinsics.fx = 0.0;
        assert_refused(&bad, "fx is 0 pixels, but the image's side is 37 pixels");
        assert_refused(&bad, "belongs to this image; focal lengths must be above 0");
        for (fx, cy, reason) in [
            (
                1e300,
                12.5,
                "fx is 1e300 pixels, but the image's side is 37 pixels; check that the \
                focal length",
            ),
            (1e-5, 12.5, "fx is 1e-5 pixels"),
            (
                40.0,
                -1e9,
                "cy is -1e9 pixels, but the image's side is 23 pixels; check that the \
                principal point",
            ),
            (40.0, f64::INFINITY, "cy is inf"),
        ] {
            let mut bad = good.clone();
            (bad.intrinsics.fx, bad.intrinsics.cy) = (fx, cy);
            let message = bad.check().unwrap_err().to_string();
            assert!(message.starts_with(reason), "{message}");
        }
        let mut bad = good.clone();
        bad.camera_to_world[0][0] *= 1.1;
        bad.camera_to_world[0][1] += 0.2;
        assert_refused(&bad, "camera_to_world is not a rigid motion");
        let mut bad = good.clone();
        bad.camera_to_world.iter_mut().for_each(|row| row[1] = -row[1]);
        assert_refused(&bad, "camera_to_world is a reflection (its determinant is -1.000)");
        let mut bad = good.clone();
        bad.camera_to_world[0][3] = 1e30;
        assert_refused(&bad, "centre (1e30, 0e0, 0e0) is farther from the origin than 1e18");
        bad.camera_to_world[0][3] = f64::NEG_INFINITY;
        assert_refused(&bad, "camera_to_world[0][3] is infinite; poses must be finite");
        let mut bad = good;
        bad.intrinsics.height = 0;
        assert_refused(&bad, "image size 37×0; both must be at least 1");
    }
}

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::pose::{Pose, column_of, moved, pose_of, rotation_of};

/// Map from the world to a field's unit cube (docs/design/004).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Space {
    /// Box of the bounds, scaled by its longest side: for bounded scenes.
    #[default]
    Box,
    /// Normalised device coordinates of a virtual camera (NDC; NeRF, appendix C): for
    /// forward-facing photographs.
    Ndc(Frustum),
    /// All of space: the ball around the middle of the bounds whose diameter is their longest side,
    /// undistorted, and everything outside contracted to a shell around this ball (mip-NeRF 360,
    /// eq. 10): for unbounded scenes.
    Contraction,
}

/// Frustum of a virtual camera between two planes. A point (X, Y, Z) in camera space, Z the depth,
/// has slopes (X/Z, Y/Z) between `min` and `max` and disparity 1/Z between `1/far` and `1/near`.
/// Straight lines stay straight. Equal steps along a line in the cube are shorter in the world near
/// the camera, where images resolve more.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Frustum {
    /// Pose of the virtual camera.
    pub camera_to_world: Pose,
    /// Minimum slopes, X/Z (x to the right) and Y/Z (y up).
    pub min: [f64; 2],
    /// Maximum slopes.
    pub max: [f64; 2],
    /// Depth of the front plane.
    pub near: f64,
    /// Depth of the back plane.
    pub far: f64,
}

impl Frustum {
    /// Returns whether the frustum isn't empty and all its numbers are finite.
    pub fn is_valid(&self) -> bool {
        let pose = self.camera_to_world.iter().flatten();
        let finite =
            pose.chain(&self.min).chain(&self.max).chain([&self.far]).all(|x| x.is_finite());
        finite
            && (0..2).all(|i| self.min[i] < self.max[i])
            && 0.0 < self.near
            && self.near < self.far
    }

    /// Returns the virtual camera's centre.
    pub fn centre(&self) -> DVec3 {
        column_of(&self.camera_to_world, 3)
    }

    /// Converts a world point to the virtual camera's space: x to the right, y up, and depth.
    pub fn to_camera(&self, point: DVec3) -> DVec3 {
        self.rotate_to_camera(point - self.centre())
    }

    /// Converts a world direction to the virtual camera's space.
    pub fn rotate_to_camera(&self, direction: DVec3) -> DVec3 {
        rotation_of(&self.camera_to_world).transpose() * direction * DVec3::new(1.0, 1.0, -1.0)
    }

    /// Returns the side of the cube in slopes: the width of the wider range.
    pub fn cube_side(&self) -> f64 {
        (self.max[0] - self.min[0]).max(self.max[1] - self.min[1])
    }

    /// Converts a point of the virtual camera's space to the unit cube: slopes divided by the wider
    /// of their ranges, and z from 0 at the near plane to 1 at the far plane.
    pub fn to_cube(&self, p: DVec3) -> DVec3 {
        let side = self.cube_side();
        let z = (1.0 / self.near - 1.0 / p.z) / (1.0 / self.near - 1.0 / self.far);
        DVec3::new((p.x / p.z - self.min[0]) / side, (p.y / p.z - self.min[1]) / side, z)
    }

    /// Converts a position in the unit cube to a world point.
    pub fn to_world(&self, position: DVec3) -> DVec3 {
        let side = self.cube_side();
        let depth = 1.0 / (1.0 / self.near - position.z * (1.0 / self.near - 1.0 / self.far));
        let [x, y] = [0, 1].map(|i| (position[i] * side + self.min[i]) * depth);
        let [right, up, back, centre] = [0, 1, 2, 3].map(|i| column_of(&self.camera_to_world, i));
        centre + x * right + y * up - depth * back
    }

    /// Returns the frustum of the scene moved by a vector.
    pub(crate) fn moved(&self, by: DVec3) -> Self {
        Self { camera_to_world: moved(&self.camera_to_world, by), ..*self }
    }

    /// Rounds slopes, depths, and the centre's offset from `anchor`; see [`Bounds::rounded`].
    ///
    /// [`Bounds::rounded`]: crate::Bounds::rounded
    pub(crate) fn rounded(&self, anchor: DVec3) -> Self {
        let side = self.cube_side();
        let slope_step = rounding_step(side);
        // The frustum is narrowest at its near plane, so the centre matters most there.
        let centre = rounded_offset(self.centre(), anchor, rounding_step(self.near * side));
        Self {
            camera_to_world: pose_of(rotation_of(&self.camera_to_world), centre),
            min: self.min.map(|slope| nearest_multiple(slope, slope_step)),
            max: self.max.map(|slope| nearest_multiple(slope, slope_step)),
            near: rounded(self.near),
            far: rounded(self.far),
        }
    }
}

/// Relative size of a rounding step, 2⁻²⁶ (docs/design/004): a quarter of the f32 spacing just
/// below 1, and far above the rounding errors of f64, even a million scene sizes from the origin.
const STEP: f64 = 1.0 / 67_108_864.0;

/// Returns the largest power of two not above a positive number; 0 for subnormal numbers.
pub fn power_of_two_floor(value: f64) -> f64 {
    const EXPONENT: u64 = 0x7ff0_0000_0000_0000;
    f64::from_bits(value.to_bits() & EXPONENT)
}

/// Returns the step to which lengths of a magnitude are rounded.
pub(crate) fn rounding_step(magnitude: f64) -> f64 {
    STEP * power_of_two_floor(magnitude)
}

/// Returns the nearest multiple of a step; the number itself if the step is 0.
pub(crate) fn nearest_multiple(value: f64, step: f64) -> f64 {
    if step > 0.0 { (value / step).round() * step } else { value }
}

/// Rounds a number to 26 binary digits after the leading one.
pub(crate) fn rounded(value: f64) -> f64 {
    nearest_multiple(value, rounding_step(value))
}

/// Rounds a point's offset from an anchor.
pub(crate) fn rounded_offset(point: DVec3, anchor: DVec3, step: f64) -> DVec3 {
    let offset = (point - anchor).to_array().map(|x| nearest_multiple(x, step));
    anchor + DVec3::from(offset)
}

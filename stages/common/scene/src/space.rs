use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::pose::{Pose, moved, pose_of, rotation_of};
use crate::rounding::{multiple, rounded, rounded_offset, rounding_step};

/// How a field sees the world: what it keeps in its unit cube.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Space {
    /// The box of the bounds, scaled by its longest side: scenes that end.
    #[default]
    Box,
    /// What one camera would see, its far parts small (NDC; NeRF, appendix C): forward-facing
    /// photographs.
    Ndc(Frustum),
    /// Everything: the ball in the bounds' box as it is, and what lies outside in a shell around it
    /// (mip-NeRF 360, eq. 10): cameras among what they see, and a background without end.
    Contraction,
}

/// What a virtual camera sees between two planes. A point (X, Y, Z) of its camera space, Z the
/// depth, has the projective coordinates (X/Z, Y/Z) between `min` and `max` and the disparity 1/Z
/// between `1/far` and `1/near`: straight lines stay straight, and even steps along them are fine
/// where a camera sees finely.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Frustum {
    /// Axes and centre of the virtual camera, as of any camera.
    pub camera_to_world: Pose,
    /// Smallest slopes, X/Z (x to the right) and Y/Z (y up).
    pub min: [f64; 2],
    /// Largest slopes.
    pub max: [f64; 2],
    /// Depth of the front plane.
    pub near: f64,
    /// Depth of the back plane.
    pub far: f64,
}

impl Frustum {
    /// Whether it has an inside, all numbers finite.
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
        self.column(3)
    }

    /// A world point in the virtual camera's space: x to the right, y up, and the depth.
    pub fn to_camera(&self, point: DVec3) -> DVec3 {
        self.turn(point - self.centre())
    }

    /// A world direction in the virtual camera's space.
    pub fn turn(&self, direction: DVec3) -> DVec3 {
        rotation_of(&self.camera_to_world).transpose() * direction * DVec3::new(1.0, 1.0, -1.0)
    }

    fn column(&self, i: usize) -> DVec3 {
        let [x, y, z] = self.camera_to_world;
        DVec3::new(x[i], y[i], z[i])
    }

    /// A point of the virtual camera's space in the unit cube: slopes over the wider of their
    /// ranges, then 0 at the front plane and 1 at the back.
    pub fn to_cube(&self, p: DVec3) -> DVec3 {
        let side = (self.max[0] - self.min[0]).max(self.max[1] - self.min[1]);
        let depth = (1.0 / self.near - 1.0 / p.z) / (1.0 / self.near - 1.0 / self.far);
        DVec3::new((p.x / p.z - self.min[0]) / side, (p.y / p.z - self.min[1]) / side, depth)
    }

    /// The world point at a place in the unit cube.
    pub fn to_world(&self, place: DVec3) -> DVec3 {
        let side = (self.max[0] - self.min[0]).max(self.max[1] - self.min[1]);
        let depth = 1.0 / (1.0 / self.near - place.z * (1.0 / self.near - 1.0 / self.far));
        let [x, y] = [0, 1].map(|i| (place[i] * side + self.min[i]) * depth);
        self.column(3) + x * self.column(0) + y * self.column(1) - depth * self.column(2)
    }

    /// Returns the frustum of the scene moved by a vector.
    pub(crate) fn moved(&self, by: DVec3) -> Self {
        Self { camera_to_world: moved(&self.camera_to_world, by), ..*self }
    }

    /// Rounds slopes, depths, and the centre's offset from `anchor`; see [`Bounds::rounded`].
    ///
    /// [`Bounds::rounded`]: crate::Bounds::rounded
    pub(crate) fn rounded(&self, anchor: DVec3) -> Self {
        let side = (self.max[0] - self.min[0]).max(self.max[1] - self.min[1]);
        let slope = |slope: f64| multiple(slope, rounding_step(side));
        // The frustum is narrowest at its front plane: there the centre matters most.
        let centre = rounded_offset(self.centre(), anchor, rounding_step(self.near * side));
        Self {
            camera_to_world: pose_of(rotation_of(&self.camera_to_world), centre),
            min: self.min.map(slope),
            max: self.max.map(slope),
            near: rounded(self.near),
            far: rounded(self.far),
        }
    }
}

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::space::Space;

/// An axis-aligned box around the scene, the range of distances along rays at which it lies, and
/// how a field sees it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Bounds {
    /// Smallest corner.
    pub min: [f64; 3],
    /// Largest corner.
    pub max: [f64; 3],
    /// Distance before which there is nothing.
    pub near: f64,
    /// Distance behind which there is nothing.
    pub far: f64,
    /// What a field keeps in its unit cube.
    #[serde(default)]
    pub space: Space,
}

impl Bounds {
    /// Whether box, range and space have an inside, all numbers finite.
    pub fn is_valid(&self) -> bool {
        let finite =
            self.min.iter().chain(&self.max).chain([&self.near, &self.far]).all(|x| x.is_finite());
        let inside =
            (0..3).all(|i| self.min[i] < self.max[i]) && 0.0 <= self.near && self.near < self.far;
        let space = if let Space::Ndc(frustum) = &self.space { frustum.is_valid() } else { true };
        finite && inside && space
    }

    /// Length of the longest side.
    pub fn longest_side(&self) -> f64 {
        (0..3).map(|i| self.max[i] - self.min[i]).fold(f64::MIN_POSITIVE, f64::max)
    }

    /// A world point's place in the unit cube that a field keeps.
    pub fn to_cube(&self, point: DVec3) -> DVec3 {
        match &self.space {
            Space::Box => (point - DVec3::from(self.min)) / self.longest_side(),
            Space::Ndc(frustum) => frustum.to_cube(frustum.to_camera(point)),
            Space::Contraction => {
                let centre = 0.5 * (DVec3::from(self.min) + DVec3::from(self.max));
                let u = (point - centre) / (0.5 * self.longest_side());
                let length = u.length();
                let inside = if length > 1.0 { (2.0 - 1.0 / length) / length } else { 1.0 };
                0.25 * inside * u + 0.5
            }
        }
    }
}

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::rounding::{power_of_two_below, rounded, rounded_offset, rounding_step};
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

    /// Returns the middle of the box.
    pub fn middle(&self) -> DVec3 {
        0.5 * (DVec3::from(self.min) + DVec3::from(self.max))
    }

    /// Returns the length that suits the scene as a unit: half of the longest side, rounded down to
    /// a power of two so that it divides without rounding.
    pub fn unit(&self) -> f64 {
        power_of_two_below(0.5 * self.longest_side()).max(f64::MIN_POSITIVE)
    }

    /// Returns the bounds of the scene moved by a vector.
    #[must_use]
    pub fn moved(&self, by: DVec3) -> Self {
        let [min, max] = [self.min, self.max].map(|corner| (DVec3::from(corner) + by).to_array());
        let space = match self.space {
            Space::Ndc(frustum) => Space::Ndc(frustum.moved(by)),
            other => other,
        };
        Self { min, max, space, ..*self }
    }

    /// Returns the bounds with all lengths rounded to 26 binary digits: near, far, and the corners'
    /// offsets from `anchor`, a camera's centre. Bounds that would lose their inside stay unchanged.
    ///
    /// Bounds are computed from all cameras, with rounding errors that depend on where the scene
    /// lies. Rounding removes these errors: rays of a scene that is moved, or scaled by a power of
    /// two, have the same bits in the unit cube as long as the cameras' centres are exact.
    #[must_use]
    pub fn rounded(&self, anchor: DVec3) -> Self {
        let step = rounding_step(self.longest_side());
        let space = match self.space {
            Space::Ndc(frustum) => Space::Ndc(frustum.rounded(anchor)),
            other => other,
        };
        let bounds = Self {
            min: rounded_offset(self.min.into(), anchor, step).to_array(),
            max: rounded_offset(self.max.into(), anchor, step).to_array(),
            near: rounded(self.near),
            far: rounded(self.far),
            space,
        };
        if bounds.is_valid() { bounds } else { *self }
    }

    /// A world point's place in the unit cube that a field keeps.
    pub fn to_cube(&self, point: DVec3) -> DVec3 {
        match &self.space {
            Space::Box => (point - DVec3::from(self.min)) / self.longest_side(),
            Space::Ndc(frustum) => frustum.to_cube(frustum.to_camera(point)),
            Space::Contraction => {
                let u = (point - self.middle()) / (0.5 * self.longest_side());
                let length = u.length();
                let inside = if length > 1.0 { (2.0 - 1.0 / length) / length } else { 1.0 };
                0.25 * inside * u + 0.5
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;
    use proptest::prelude::*;

    use super::*;
    use crate::pose::pose_of;
    use crate::space::Frustum;

    /// Bounds of each space around a point, all lengths times a scale.
    fn spaces(middle: DVec3, scale: f64) -> [Bounds; 3] {
        let turn = DMat3::from_rotation_y(0.3);
        let frustum = Frustum {
            camera_to_world: pose_of(turn, middle),
            min: [-0.71, -0.43],
            max: [0.83, 0.52],
            near: 0.9 * scale,
            far: 77.0 * scale,
        };
        let half = scale * DVec3::new(1.3, 1.1, 0.7);
        [Space::Box, Space::Contraction, Space::Ndc(frustum)].map(|space| Bounds {
            min: (middle - half).to_array(),
            max: (middle + half).to_array(),
            near: 0.3 * scale,
            far: 9.1 * scale,
            space,
        })
    }

    /// A vector with few binary digits.
    fn short(v: DVec3) -> DVec3 {
        (1024.0 * v).round() / 1024.0
    }

    proptest! {
        /// Errors of the last digits, as other positions cause, vanish, and what remains moves and
        /// grows with the scene.
        #[test]
        fn rounding_removes_rounding_errors(
            anchor in prop::array::uniform3(-4.0..4.0f64),
            shift in prop::array::uniform3(-1e5..1e5f64),
            exponent in -40..40i32,
        ) {
            let (anchor, shift) = (short(anchor.into()), short(shift.into()));
            let scale = f64::from(exponent).exp2();
            let middle = DVec3::new(0.1234, -0.377, 0.731);
            for (bounds, scaled) in spaces(middle, 1.0).into_iter().zip(spaces(scale * middle, scale)) {
                let rounded = bounds.rounded(anchor);
                prop_assert!(rounded != bounds && rounded.is_valid());
                prop_assert!((rounded.middle() - middle).length() < 1e-6);
                let off = bounds.moved(DVec3::splat(2e-15)).rounded(anchor);
                prop_assert_eq!(off, rounded);
                let there = bounds.moved(shift).rounded(anchor + shift);
                prop_assert_eq!(there, rounded.moved(shift));
                let scaled = scaled.rounded(scale * anchor);
                prop_assert_eq!(scaled.min, rounded.min.map(|x| scale * x));
                prop_assert_eq!([scaled.near, scaled.far], [rounded.near, rounded.far].map(|x| scale * x));
            }
        }
    }

    #[test]
    fn thin_bounds_stay() {
        let thin = Bounds { near: 1.0, far: 1.0 + 1e-9, ..spaces(DVec3::ZERO, 1.0)[0] };
        assert_eq!(thin.rounded(DVec3::ZERO), thin);
        let tiny = spaces(DVec3::ZERO, 1e-300)[0];
        assert!(tiny.rounded(DVec3::ZERO).is_valid());
    }
}

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::space::{Space, power_of_two_floor, rounded, rounded_offset, rounding_step};

/// Axis-aligned box around the scene, range of its distances along rays, and the field's space.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Bounds {
    /// Corner with the smallest coordinates.
    pub min: [f64; 3],
    /// Corner with the largest coordinates.
    pub max: [f64; 3],
    /// Minimum distance of the scene along rays.
    pub near: f64,
    /// Maximum distance of the scene along rays.
    pub far: f64,
    /// Map from the world to a field's unit cube.
    #[serde(default)]
    pub space: Space,
}

impl Bounds {
    /// Creates bounds whose box reaches from -`half_side` to `half_side` along each axis.
    pub const fn cube(half_side: f64, near: f64, far: f64) -> Self {
        Self { min: [-half_side; 3], max: [half_side; 3], near, far, space: Space::Box }
    }

    /// Returns whether box, range and space aren't empty and all numbers are finite.
    pub fn is_valid(&self) -> bool {
        let mut numbers = self.min.iter().chain(&self.max).chain([&self.near, &self.far]);
        numbers.all(|x| x.is_finite())
            && (0..3).all(|i| self.min[i] < self.max[i])
            && 0.0 <= self.near
            && self.near < self.far
            && !matches!(&self.space, Space::Ndc(frustum) if !frustum.is_valid())
    }

    /// Returns the length of the longest side.
    pub fn longest_side(&self) -> f64 {
        (0..3).map(|i| self.max[i] - self.min[i]).fold(f64::MIN_POSITIVE, f64::max)
    }

    /// Returns the middle of the box.
    pub fn middle(&self) -> DVec3 {
        0.5 * (DVec3::from(self.min) + DVec3::from(self.max))
    }

    /// Returns a unit of length for the scene: half of the longest side, rounded down to a power of
    /// two so that division by the unit is exact.
    pub fn unit(&self) -> f64 {
        power_of_two_floor(0.5 * self.longest_side()).max(f64::MIN_POSITIVE)
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
    /// offsets from `anchor`, a camera's centre. Bounds that would become empty stay unchanged.
    ///
    /// Bounds are computed from all cameras, with rounding errors that depend on the scene's
    /// position. Rounding removes these errors: rays of a scene that is moved, or scaled by a power
    /// of two, have the same bits in the unit cube if the cameras' centres are exact.
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

    /// Converts a world point to the unit cube.
    pub fn to_cube(&self, point: DVec3) -> DVec3 {
        match &self.space {
            Space::Box => (point - DVec3::from(self.min)) / self.longest_side(),
            Space::Ndc(frustum) => frustum.to_cube(frustum.to_camera(point)),
            Space::Contraction => {
                let u = (point - self.middle()) / (0.5 * self.longest_side());
                let length = u.length();
                let shrink = if length > 1.0 { (2.0 - 1.0 / length) / length } else { 1.0 };
                0.25 * shrink * u + 0.5
            }
        }
    }
}

/// Formats a length in scene units with the given number of decimals. A length that would print as
/// zeros, or of a million units or more, has three significant digits instead: `1.23e-5`.
pub fn format_length(value: f64, decimals: u8) -> String {
    let fixed = format!("{value:.*}", usize::from(decimals));
    let shows_digits = fixed.contains(|digit| ('1'..='9').contains(&digit));
    if value == 0.0 || (shows_digits && value.abs() < 1e6) { fixed } else { format!("{value:.2e}") }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;
    use proptest::prelude::*;

    use super::*;
    use crate::pose::pose_of;
    use crate::space::Frustum;

    /// Returns bounds of each space around a point; all lengths are multiplied by `scale`.
    fn spaces(middle: DVec3, scale: f64) -> [Bounds; 3] {
        let rotation = DMat3::from_rotation_y(0.3);
        let frustum = Frustum {
            camera_to_world: pose_of(rotation, middle),
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

    /// Rounds a vector to multiples of 1/1024, whose sums are exact.
    fn round_to_steps(v: DVec3) -> DVec3 {
        (1024.0 * v).round() / 1024.0
    }

    proptest! {
        /// Rounding removes errors in the last digits, which depend on the scene's position. The
        /// rounded bounds move and scale with the scene.
        #[test]
        fn rounding_removes_rounding_errors(
            anchor in prop::array::uniform3(-4.0..4.0f64),
            shift in prop::array::uniform3(-1e5..1e5f64),
            exponent in -40..40i32,
        ) {
            let [anchor, shift] = [anchor, shift].map(|v| round_to_steps(v.into()));
            let scale = f64::from(exponent).exp2();
            let middle = DVec3::new(0.1234, -0.377, 0.731);
            for (bounds, scaled) in spaces(middle, 1.0).into_iter().zip(spaces(scale * middle, scale)) {
                let rounded = bounds.rounded(anchor);
                prop_assert!(rounded != bounds && rounded.is_valid());
                prop_assert!((rounded.middle() - middle).length() < 1e-6);
                let perturbed = bounds.moved(DVec3::splat(2e-15)).rounded(anchor);
                prop_assert_eq!(perturbed, rounded);
                let moved = bounds.moved(shift).rounded(anchor + shift);
                prop_assert_eq!(moved, rounded.moved(shift));
                let scaled = scaled.rounded(scale * anchor);
                prop_assert_eq!(scaled.min, rounded.min.map(|x| scale * x));
                prop_assert_eq!([scaled.near, scaled.far], [rounded.near, rounded.far].map(|x| scale * x));
            }
        }
    }

    #[test]
    fn bounds_too_thin_for_rounding_stay_unchanged() {
        let thin = Bounds { near: 1.0, far: 1.0 + 1e-9, ..spaces(DVec3::ZERO, 1.0)[0] };
        assert_eq!(thin.rounded(DVec3::ZERO), thin);
        let tiny = spaces(DVec3::ZERO, 1e-300)[0];
        assert!(tiny.rounded(DVec3::ZERO).is_valid());
    }

    #[test]
    fn lengths_have_significant_digits() {
        for (value, decimals, expected) in [
            (0.0, 3, "0.000"),
            (3.0483, 3, "3.048"),
            (0.052, 3, "0.052"),
            (0.075_6, 2, "0.08"),
            (0.004_125_9, 2, "4.13e-3"),
            (3.024e-5, 3, "3.02e-5"),
            (418.3594, 3, "418.359"),
            (999_000.0, 0, "999000"),
            (4_649_776.0, 3, "4.65e6"),
            (151.2, 0, "151"),
            (0.2, 0, "2.00e-1"),
            (-1.23e-7, 4, "-1.23e-7"),
            (1e300, 2, "1.00e300"),
            (f64::INFINITY, 2, "inf"),
            (f64::NAN, 2, "NaN"),
        ] {
            assert_eq!(format_length(value, decimals), expected);
        }
    }
}

use std::fmt;

use artifact::number;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Radial and tangential distortion (Brown 1966), as OpenCV and COLMAP have it: a ray that a
/// pinhole sees at (x, y), in units of the focal length, is seen at (x·r + 2·p1·x·y + p2·(ρ + 2x²),
/// y·r + p1·(ρ + 2y²) + 2·p2·x·y) with ρ = x² + y² and r = 1 + k1·ρ + k2·ρ² + k3·ρ³. y points down.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Distortion {
    /// k1, k2, k3.
    pub radial: [f64; 3],
    /// p1, p2.
    pub tangential: [f64; 2],
}

/// A distortion is undone to within so much of the focal length: a hundred-thousandth of a pixel at
/// 10,000 pixels.
const UNDO_TOLERANCE: f64 = 1e-9;

impl fmt::Display for Distortion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([k1, k2, k3], [p1, p2]) = (self.radial.map(number), self.tangential.map(number));
        write!(f, "(k1 {k1}, k2 {k2}, k3 {k3}, p1 {p1}, p2 {p2})")
    }
}

impl Distortion {
    /// Whether it is a pinhole after all.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Whether all coefficients are numbers.
    pub fn is_finite(&self) -> bool {
        self.radial.iter().chain(&self.tangential).all(|k| k.is_finite())
    }

    /// Where a pinhole's (x, y) is seen.
    pub fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [p1, p2] = self.tangential;
        let square = x * x + y * y;
        let (radial, _) = self.radial_at(square);
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// How what is seen moves with a pinhole's (x, y): its x by x, its x by y, which is its y by x,
    /// and its y by y.
    pub fn slope(&self, [x, y]: [f64; 2]) -> [f64; 3] {
        let [p1, p2] = self.tangential;
        let (radial, growth) = self.radial_at(x * x + y * y);
        [
            radial + 2.0 * x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x,
            2.0 * x * y * growth + 2.0 * p1 * x + 2.0 * p2 * y,
            radial + 2.0 * y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x,
        ]
    }

    /// Where a pinhole sees what is seen at a place, by Newton's method. Nothing of use beyond
    /// where the distortion folds back.
    pub fn undistort(&self, seen: [f64; 2]) -> [f64; 2] {
        const STEPS: usize = 20;
        let mut at = seen;
        for _ in 0..STEPS {
            let [u, v] = self.distort(at);
            let (du, dv) = (seen[0] - u, seen[1] - v);
            let [a, b, c] = self.slope(at);
            let determinant = a * c - b * b;
            at = [at[0] + (c * du - b * dv) / determinant, at[1] + (a * dv - b * du) / determinant];
            if du.abs().max(dv.abs()) < 1e-2 * UNDO_TOLERANCE {
                break;
            }
        }
        at
    }

    /// r and its derivative by ρ.
    fn radial_at(&self, square: f64) -> (f64, f64) {
        let [k1, k2, k3] = self.radial;
        (
            1.0 + square * (k1 + square * (k2 + square * k3)),
            k1 + square * (2.0 * k2 + square * 3.0 * k3),
        )
    }

    /// Whether a place is found back, and the way there from the centre is in order: beyond a
    /// radius a distortion may fold back.
    pub(crate) fn can_undo(&self, seen: [f64; 2]) -> bool {
        let at = self.undistort(seen);
        let [u, v] = self.distort(at);
        let is_found = (u - seen[0]).abs().max((v - seen[1]).abs()) < UNDO_TOLERANCE;
        is_found
            && (0..=16u32).all(|i| {
                let share = f64::from(i) / 16.0;
                let [a, b, c] = self.slope([share * at[0], share * at[1]]);
                a > 0.0 && a * c > b * b
            })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Lenses that bend, but fold no corner of a common image.
    pub(crate) fn mild() -> impl Strategy<Value = Distortion> {
        let (tangential, k3) = (-0.01..0.01f64, -0.02..0.02f64);
        (-0.15..0.3f64, -0.05..0.05f64, k3, tangential.clone(), tangential).prop_map(
            |(k1, k2, k3, p1, p2)| Distortion { radial: [k1, k2, k3], tangential: [p1, p2] },
        )
    }

    fn slope_between(d: &Distortion, a: [f64; 2], b: [f64; 2], step: f64) -> [f64; 2] {
        let (a, b) = (d.distort(a), d.distort(b));
        [0, 1].map(|i| (a[i] - b[i]) / (2.0 * step))
    }

    proptest! {
        #[test]
        fn slopes_are_differences(d in mild(), x in -0.6..0.6f64, y in -0.5..0.5f64) {
            let step = 1e-6;
            let [xx, yx] = slope_between(&d, [x + step, y], [x - step, y], step);
            let [xy, yy] = slope_between(&d, [x, y + step], [x, y - step], step);
            let [a, b, c] = d.slope([x, y]);
            for (slope, difference) in [(a, xx), (b, yx), (b, xy), (c, yy)] {
                prop_assert!((slope - difference).abs() < 1e-8, "{slope} {difference}");
            }
        }
    }
}

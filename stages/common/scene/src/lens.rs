use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::Intrinsics;

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

/// How far, in units of the image, undoing a distortion may cut its border off at most.
const MOST_ZOOM: f64 = 4.0;

/// Places along each side of an image at which a distortion is looked at.
const BORDER: u32 = 64;

/// A distortion is undone to within so much of the focal length: a hundred-thousandth of a pixel at
/// 10,000 pixels.
const EXACT: f64 = 1e-9;

impl fmt::Display for Distortion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([k1, k2, k3], [p1, p2]) = (self.radial, self.tangential);
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
            if du.abs().max(dv.abs()) < 1e-2 * EXACT {
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
    fn can_undo(&self, seen: [f64; 2]) -> bool {
        let at = self.undistort(seen);
        let [u, v] = self.distort(at);
        let is_found = (u - seen[0]).abs().max((v - seen[1]).abs()) < EXACT;
        is_found
            && (0..=16u32).all(|i| {
                let share = f64::from(i) / 16.0;
                let [a, b, c] = self.slope([share * at[0], share * at[1]]);
                a > 0.0 && a * c > b * b
            })
    }
}

impl Intrinsics {
    /// Where in its image a camera without the distortion sees what this one sees at a position, in
    /// pixels.
    pub fn undistort(&self, at: [f64; 2]) -> [f64; 2] {
        if self.distortion.is_none() {
            return at;
        }
        let [x, y] =
            self.distortion.undistort([(at[0] - self.cx) / self.fx, (at[1] - self.cy) / self.fy]);
        [self.fx.mul_add(x, self.cx), self.fy.mul_add(y, self.cy)]
    }

    /// Where in its image this camera sees what one without the distortion sees at a position, in
    /// pixels.
    pub fn distort(&self, at: [f64; 2]) -> [f64; 2] {
        if self.distortion.is_none() {
            return at;
        }
        let [u, v] =
            self.distortion.distort([(at[0] - self.cx) / self.fx, (at[1] - self.cy) / self.fy]);
        [self.fx.mul_add(u, self.cx), self.fy.mul_add(v, self.cy)]
    }

    /// The pinhole camera of the same size that sees as much as it can and nothing that this one
    /// doesn't. `None` where the distortion is beyond sense: its image would have to be cut to a
    /// quarter and less.
    pub fn pinhole(&self) -> Option<Self> {
        let pinhole = Self { distortion: Distortion::default(), ..*self };
        if self.distortion.is_none() {
            return Some(pinhole);
        }
        let zoomed = |zoom: f64| Self { fx: self.fx * zoom, fy: self.fy * zoom, ..pinhole };
        let fits = |zoom: f64| self.sees_all_of(&zoomed(zoom));
        let (mut low, mut high) = (1.0 / MOST_ZOOM, MOST_ZOOM);
        if !fits(high) {
            return None;
        }
        if fits(low) {
            return Some(zoomed(low));
        }
        // Bisection of the zoom, until it moves no corner by a hundredth of a pixel.
        while (high - low) * f64::from(self.width.max(self.height)) > 0.01 {
            let middle = 0.5 * (low + high);
            if fits(middle) { high = middle } else { low = middle }
        }
        Some(zoomed(high))
    }

    /// Where in this camera's image what another, at the same place, sees at a position.
    pub fn source(&self, other: &Self, at: [f64; 2]) -> [f64; 2] {
        let [x, y] = other.undistort(at);
        self.distort([
            self.fx.mul_add((x - other.cx) / other.fx, self.cx),
            self.fy.mul_add((y - other.cy) / other.fy, self.cy),
        ])
    }

    /// Positions along the image's border: its corners, and what lies between them where lines may
    /// be bent.
    pub fn border(&self) -> impl Iterator<Item = [f64; 2]> {
        let steps = if self.distortion.is_none() { 1 } else { BORDER };
        let (width, height) = (f64::from(self.width), f64::from(self.height));
        (0..steps).flat_map(move |i| {
            let share = f64::from(i) / f64::from(steps);
            [
                [share * width, 0.0],
                [width, share * height],
                [(1.0 - share) * width, height],
                [0.0, (1.0 - share) * height],
            ]
        })
    }

    /// Whether each place in the image belongs to one ray.
    pub(crate) fn has_rays(&self) -> bool {
        let place = |[x, y]: [f64; 2]| [(x - self.cx) / self.fx, (y - self.cy) / self.fy];
        self.distortion.is_none() || self.border().all(|at| self.distortion.can_undo(place(at)))
    }

    /// Whether the whole border of a pinhole image lies inside this camera's, and in order.
    fn sees_all_of(&self, pinhole: &Self) -> bool {
        // Of a bent image's border, as many places as of its own.
        Self { distortion: self.distortion, ..*pinhole }
            .border()
            .all(|at| self.holds(self.source(pinhole, at)) && self.keeps_order(pinhole, at))
    }

    /// Whether a position lies in the image, or beside it by no more than a rounding error.
    fn holds(&self, [x, y]: [f64; 2]) -> bool {
        let (width, height) = (f64::from(self.width), f64::from(self.height));
        let slack = 1e-6;
        (-slack..=width + slack).contains(&x) && (-slack..=height + slack).contains(&y)
    }

    /// Whether on the way from a pinhole's principal point out to a position, what is seen moves
    /// outwards, too.
    fn keeps_order(&self, pinhole: &Self, [x, y]: [f64; 2]) -> bool {
        let mut last = -1.0;
        (0..=16).all(|i| {
            let share = f64::from(i) / 16.0;
            let at = |from: f64, to: f64| share.mul_add(to - from, from);
            let [u, v] = self.source(pinhole, [at(pinhole.cx, x), at(pinhole.cy, y)]);
            let radius = (u - self.cx).hypot(v - self.cy);
            let grows = radius > last;
            last = radius;
            grows
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn camera(radial: [f64; 3], tangential: [f64; 2]) -> Intrinsics {
        let distortion = Distortion { radial, tangential };
        Intrinsics {
            width: 400,
            height: 300,
            fx: 350.0,
            fy: 355.0,
            cx: 203.0,
            cy: 148.0,
            distortion,
        }
    }

    #[test]
    fn a_pinhole_stays_as_it_is() {
        let pinhole = camera([0.0; 3], [0.0; 2]);
        assert_eq!(pinhole.pinhole(), Some(pinhole));
        let [x, y] = pinhole.source(&pinhole, [17.5, 3.25]);
        assert!((x - 17.5).abs() < 1e-12 && (y - 3.25).abs() < 1e-12);
        assert_eq!(pinhole.border().count(), 4);
    }

    #[test]
    fn nonsense_is_no_lens() {
        let folded = camera([-40.0, 0.0, 0.0], [0.0; 2]);
        assert_eq!(folded.pinhole(), None);
        assert!(!folded.has_rays());
        assert!(!camera([f64::NAN, 0.0, 0.0], [0.0; 2]).has_rays());
        // Bent a little further than any mild lens below, the image folds in one corner alone.
        assert!(!camera([-0.193, -0.047, -0.0156], [-0.0056, 0.0078]).has_rays());
    }

    /// Lenses that bend, but fold no corner of the image.
    fn mild() -> impl Strategy<Value = Intrinsics> {
        let (tangential, k3) = (-0.01..0.01f64, -0.02..0.02f64);
        (-0.15..0.3f64, -0.05..0.05f64, k3, tangential.clone(), tangential)
            .prop_map(|(k1, k2, k3, p1, p2)| camera([k1, k2, k3], [p1, p2]))
    }

    proptest! {
        /// What the pinhole camera sees lies inside the image, and a slightly wider one would see
        /// past it.
        #[test]
        fn a_pinhole_sees_as_much_as_there_is(camera in mild()) {
            let pinhole = camera.pinhole().expect("a mild distortion");
            prop_assert!(camera.sees_all_of(&pinhole));
            let wider = Intrinsics { fx: pinhole.fx * 0.99, fy: pinhole.fy * 0.99, ..pinhole };
            prop_assert!(!camera.sees_all_of(&wider));
        }

        #[test]
        fn undistorting_undoes_distorting(camera in mild(), x in 0.0..400.0f64,
            y in 0.0..300.0f64) {
            prop_assert!(camera.has_rays());
            let [u, v] = camera.distort(camera.undistort([x, y]));
            prop_assert!((u - x).hypot(v - y) < 1e-9, "{u} {v}");
        }

        #[test]
        fn slopes_are_differences(camera in mild(), x in -0.6..0.6f64, y in -0.5..0.5f64) {
            let step = 1e-6;
            let d = camera.distortion;
            let by = |a: [f64; 2], b: [f64; 2]| {
                let (a, b) = (d.distort(a), d.distort(b));
                [0, 1].map(|i| (a[i] - b[i]) / (2.0 * step))
            };
            let [xx, yx] = by([x + step, y], [x - step, y]);
            let [xy, yy] = by([x, y + step], [x, y - step]);
            let [a, b, c] = d.slope([x, y]);
            for (slope, difference) in [(a, xx), (b, yx), (b, xy), (c, yy)] {
                prop_assert!((slope - difference).abs() < 1e-8, "{slope} {difference}");
            }
        }
    }
}

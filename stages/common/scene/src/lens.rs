use std::fmt;

use artifact::number;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::projection::{MAX_FISHEYE_ANGLE, Projection, ratio, scaled};

/// Radial and tangential distortion (Brown 1966), as OpenCV and COLMAP define it: a ray whose
/// undistorted plane position is (x, y) is seen at (x·r + 2·p1·x·y + p2·(ρ + 2x²), y·r + p1·(ρ +
/// 2y²) + 2·p2·x·y) with ρ = x² + y² and r = a / d, where a = 1 + k1·ρ + k2·ρ² + k3·ρ³ + k4·ρ⁴ and
/// d = 1 + d1·ρ + d2·ρ² + d3·ρ³. Positions are in units of the focal length; y points down. The
/// undistorted position follows from the ray by the [`Projection`]: with a fisheye lens ρ is the
/// square of its angle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Distortion {
    /// Mapping of rays to the image plane before distortion.
    #[serde(default, skip_serializing_if = "Projection::is_perspective")]
    pub projection: Projection,
    /// k1, k2, k3 and, unless 0, k4.
    #[serde(with = "radial")]
    #[schemars(with = "Vec<f64>", length(min = 3, max = 4))]
    pub radial: [f64; 4],
    /// p1, p2.
    pub tangential: [f64; 2],
    /// d1, d2, d3: k4, k5, k6 of OpenCV's rational model.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub denominator: [f64; 3],
}

/// Maximum error of undoing a distortion, in focal lengths: a hundred-thousandth of a pixel at
/// 10,000 pixels.
const UNDO_TOLERANCE: f64 = 1e-9;

/// Parts of [`MAX_FISHEYE_ANGLE`] among which an angle is bracketed: a lens that folds back within
/// one part is refused where the fold lies in the image.
const ANGLE_PARTS: u32 = 16;

fn is_zero(terms: &[f64; 3]) -> bool {
    *terms == [0.0; 3]
}

/// Writes three radial terms unless there is a fourth: lists of views keep their bytes.
mod radial {
    use serde::{Deserialize as _, Deserializer, Serialize as _, Serializer, de::Error as _};

    pub(super) fn serialize<S: Serializer>(terms: &[f64; 4], to: S) -> Result<S::Ok, S::Error> {
        if terms[3] == 0.0 { terms[..3].serialize(to) } else { terms.serialize(to) }
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<[f64; 4], D::Error> {
        match Vec::deserialize(from)?[..] {
            [k1, k2, k3] => Ok([k1, k2, k3, 0.0]),
            [k1, k2, k3, k4] => Ok([k1, k2, k3, k4]),
            ref others => Err(D::Error::invalid_length(others.len(), &"3 or 4 radial terms")),
        }
    }
}

impl fmt::Display for Distortion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([k1, k2, k3, k4], [p1, p2]) = (self.radial.map(number), self.tangential.map(number));
        let lens = if self.is_fisheye() { "fisheye, " } else { "" };
        write!(f, "({lens}k1 {k1}, k2 {k2}, k3 {k3}, ")?;
        if self.radial[3] != 0.0 {
            write!(f, "k4 {k4}, ")?;
        }
        write!(f, "p1 {p1}, p2 {p2}")?;
        if !is_zero(&self.denominator) {
            let [d1, d2, d3] = self.denominator.map(number);
            write!(f, ", denominator {d1}, {d2}, {d3}")?;
        }
        f.write_str(")")
    }
}

impl Distortion {
    /// Creates the distortion of a perspective lens with three radial terms.
    pub fn brown([k1, k2, k3]: [f64; 3], tangential: [f64; 2]) -> Self {
        Self { radial: [k1, k2, k3, 0.0], tangential, ..Self::default() }
    }

    /// Creates the distortion of a fisheye lens, with OpenCV's k1 to k4.
    pub fn fisheye(radial: [f64; 4]) -> Self {
        Self { projection: Projection::Fisheye, radial, ..Self::default() }
    }

    /// True for a pinhole.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// True for a fisheye lens, with or without distortion.
    pub fn is_fisheye(&self) -> bool {
        self.projection == Projection::Fisheye
    }

    /// True if all coefficients are numbers.
    pub fn is_finite(&self) -> bool {
        let radial = self.radial.iter().chain(&self.denominator);
        radial.chain(&self.tangential).all(|k| k.is_finite())
    }

    /// Returns the position at which a pinhole's (x, y) is seen.
    pub fn distort(&self, slopes: [f64; 2]) -> [f64; 2] {
        self.displaced(self.projection.plane_position(slopes))
    }

    /// Returns the derivative of [`Distortion::distort`]: of x by x and y, then of y by x and y.
    pub fn derivative(&self, slopes: [f64; 2]) -> [[f64; 2]; 2] {
        let [a, b, c] = self.displacement_slope(self.projection.plane_position(slopes));
        if self.projection.is_perspective() {
            return [[a, b], [b, c]];
        }
        let [d, e, f] = self.projection.derivative(slopes);
        [[a * d + b * e, a * e + b * f], [b * d + c * e, b * e + c * f]]
    }

    /// Returns the position at which a pinhole sees what is seen at a position. Beyond the radius
    /// at which a perspective lens folds back, the result is of no use. A fisheye ray is cut to
    /// 89° from the axis.
    pub fn undistort(&self, seen: [f64; 2]) -> [f64; 2] {
        self.projection.slopes(self.undone(seen))
    }

    /// True if a fisheye ray is cut to 89° from the axis at a position.
    pub(crate) fn is_cut(&self, seen: [f64; 2]) -> bool {
        self.is_fisheye() && is_at_limit(self.undone(seen))
    }

    /// Returns the seen position of an undistorted one, both in the image plane.
    fn displaced(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [p1, p2] = self.tangential;
        let square = x * x + y * y;
        let (radial, _) = self.radial_at(square);
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// Returns the derivative of [`Distortion::displaced`], a symmetric matrix: of x by x, of x by
    /// y and of y by y.
    fn displacement_slope(&self, [x, y]: [f64; 2]) -> [f64; 3] {
        let [p1, p2] = self.tangential;
        let (radial, growth) = self.radial_at(x * x + y * y);
        [
            radial + 2.0 * x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x,
            2.0 * x * y * growth + 2.0 * p1 * x + 2.0 * p2 * y,
            radial + 2.0 * y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x,
        ]
    }

    /// Returns the undistorted plane position of a seen one.
    fn undone(&self, seen: [f64; 2]) -> [f64; 2] {
        if self.projection.is_perspective() {
            return self.solved(seen, seen);
        }
        let radius = libm::hypot(seen[0], seen[1]);
        let angle = self.undone_angle(radius);
        let radial = scaled(seen, if radius > 0.0 { angle / radius } else { 1.0 });
        if self.tangential == [0.0; 2] {
            radial
        } else {
            limited(self.solved(seen, radial), radial)
        }
    }

    /// Solves for the undistorted position by Newton's method.
    fn solved(&self, seen: [f64; 2], start: [f64; 2]) -> [f64; 2] {
        const STEPS: usize = 20;
        let mut at = start;
        for _ in 0..STEPS {
            let [u, v] = self.displaced(at);
            let (du, dv) = (seen[0] - u, seen[1] - v);
            let [a, b, c] = self.displacement_slope(at);
            let determinant = a * c - b * b;
            at = [at[0] + (c * du - b * dv) / determinant, at[1] + (a * dv - b * du) / determinant];
            if du.abs().max(dv.abs()) < 1e-2 * UNDO_TOLERANCE {
                break;
            }
        }
        at
    }

    /// Returns the smallest angle whose distorted radius, without tangential terms, is `seen`, or
    /// [`MAX_FISHEYE_ANGLE`] if there is none below. Newton's method within a bracket: a step that
    /// leaves the bracket or is longer than half the last one halves the bracket instead, so the
    /// loop ends.
    fn undone_angle(&self, seen: f64) -> f64 {
        let part = |i: u32| MAX_FISHEYE_ANGLE * f64::from(i) / f64::from(ANGLE_PARTS);
        let Some(above) = (1..=ANGLE_PARTS).find(|&i| self.distorted_angle(part(i)).0 >= seen)
        else {
            return MAX_FISHEYE_ANGLE;
        };
        let (mut low, mut high) = (part(above - 1), part(above));
        let (mut angle, mut last) = (0.5 * (low + high), high - low);
        while last > f64::EPSILON * high {
            let (value, growth) = self.distorted_angle(angle);
            if value < seen {
                low = angle;
            } else {
                high = angle;
            }
            let newton = angle - (value - seen) / growth;
            let is_good = low <= newton && newton <= high && (newton - angle).abs() <= 0.5 * last;
            let next = if is_good { newton } else { 0.5 * (low + high) };
            (angle, last) = (next, (next - angle).abs());
        }
        angle
    }

    /// Returns the distorted radius of an angle, without tangential terms, and its derivative.
    fn distorted_angle(&self, angle: f64) -> (f64, f64) {
        let square = angle * angle;
        let (radial, growth) = self.radial_at(square);
        (angle * radial, radial + 2.0 * square * growth)
    }

    /// Returns r and its derivative by ρ.
    fn radial_at(&self, square: f64) -> (f64, f64) {
        let [k1, k2, k3, k4] = self.radial;
        let above = 1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4)));
        let above_growth =
            k1 + square * (2.0 * k2 + square * 3.0 * k3 + square * square * 4.0 * k4);
        if is_zero(&self.denominator) {
            return (above, above_growth);
        }
        let [d1, d2, d3] = self.denominator;
        let below = 1.0 + square * (d1 + square * (d2 + square * d3));
        let below_growth = d1 + square * (2.0 * d2 + square * (3.0 * d3));
        let radial = above / below;
        (radial, (above_growth - radial * below_growth) / below)
    }

    /// True if a position has one ray: undoing its distortion succeeds, or a fisheye ray is cut,
    /// and positions keep their order along the way there from the centre. Beyond a radius a
    /// distortion may fold back.
    pub(crate) fn can_undo(&self, seen: [f64; 2]) -> bool {
        let at = self.undone(seen);
        let [u, v] = self.displaced(at);
        let is_found = (u - seen[0]).abs().max((v - seen[1]).abs()) < UNDO_TOLERANCE;
        // All positions at which rays are cut share one way, so more of it is sampled.
        let samples = if self.is_fisheye() { 64u32 } else { 16 };
        (is_found || self.is_fisheye() && is_at_limit(at))
            && (0..=samples).all(|i| {
                let share = f64::from(i) / f64::from(samples);
                let [a, b, c] = self.displacement_slope([share * at[0], share * at[1]]);
                a > 0.0 && a * c > b * b
            })
    }
}

/// Cuts a fisheye plane position to [`MAX_FISHEYE_ANGLE`]; returns `otherwise` for one that isn't
/// finite.
fn limited(at: [f64; 2], otherwise: [f64; 2]) -> [f64; 2] {
    let angle = libm::hypot(at[0], at[1]);
    if !angle.is_finite() {
        return otherwise;
    }
    scaled(at, ratio(angle.min(MAX_FISHEYE_ANGLE), angle))
}

/// True if a fisheye plane position is at [`MAX_FISHEYE_ANGLE`], to rounding errors.
fn is_at_limit(at: [f64; 2]) -> bool {
    libm::hypot(at[0], at[1]) >= MAX_FISHEYE_ANGLE - UNDO_TOLERANCE
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Lenses that bend, but fold no corner of a common image.
    pub(crate) fn mild() -> impl Strategy<Value = Distortion> {
        let (tangential, k3) = (-0.01..0.01f64, -0.02..0.02f64);
        (-0.15..0.3f64, -0.05..0.05f64, k3, tangential.clone(), tangential)
            .prop_map(|(k1, k2, k3, p1, p2)| Distortion::brown([k1, k2, k3], [p1, p2]))
    }

    /// Perspective lenses with a fourth radial term, and with a denominator.
    pub(crate) fn higher() -> impl Strategy<Value = Distortion> {
        (mild(), -0.01..0.01f64, -0.05..0.1f64, -0.02..0.02f64, -0.01..0.01f64).prop_map(
            |(brown, k4, d1, d2, d3)| {
                let [k1, k2, k3, _] = brown.radial;
                Distortion { radial: [k1, k2, k3, k4], denominator: [d1, d2, d3], ..brown }
            },
        )
    }

    /// Fisheye lenses that fold nowhere before 89°.
    pub(crate) fn fisheye() -> impl Strategy<Value = Distortion> {
        let tangential = -0.001..0.001f64;
        let tangential = prop_oneof![
            Just([0.0; 2]),
            (tangential.clone(), tangential).prop_map(<[f64; 2]>::from)
        ];
        (-0.04..0.06f64, -0.01..0.01f64, -0.001..0.001f64, -0.0002..0.0002f64, tangential).prop_map(
            |(k1, k2, k3, k4, tangential)| Distortion {
                tangential,
                ..Distortion::fisheye([k1, k2, k3, k4])
            },
        )
    }

    fn slope_between(d: &Distortion, a: [f64; 2], b: [f64; 2], step: f64) -> [f64; 2] {
        let (a, b) = (d.distort(a), d.distort(b));
        [0, 1].map(|i| (a[i] - b[i]) / (2.0 * step))
    }

    /// A ray at an angle from the axis, by its slopes.
    fn at_angle(degrees: f64, azimuth: f64) -> [f64; 2] {
        scaled([azimuth.cos(), azimuth.sin()], degrees.to_radians().tan())
    }

    /// The formula of Brown's fourth term and of OpenCV's rational model, term by term.
    #[test]
    fn higher_terms_are_those_of_the_formula() {
        let lens = Distortion {
            radial: [0.11, -0.07, 0.02, 0.013],
            tangential: [0.003, -0.002],
            ..Distortion::default()
        };
        let rational = Distortion { denominator: [0.2, -0.05, 0.01], ..lens };
        for [x, y] in [[0.9, 0.7], [-0.9, 0.7], [0.9, -0.7], [-0.9, -0.7], [0.1, 0.4], [0.0, 0.0]] {
            let square: f64 = x * x + y * y;
            let radial = 1.0 + 0.11 * square - 0.07 * square.powi(2)
                + 0.02 * square.powi(3)
                + 0.013 * square.powi(4);
            let below = 1.0 + 0.2 * square - 0.05 * square.powi(2) + 0.01 * square.powi(3);
            let tangential = [
                2.0 * 0.003 * x * y - 0.002 * (square + 2.0 * x * x),
                0.003 * (square + 2.0 * y * y) - 2.0 * 0.002 * x * y,
            ];
            for (lens, r) in [(lens, radial), (rational, radial / below)] {
                let seen = lens.distort([x, y]);
                assert!((seen[0] - (x * r + tangential[0])).abs() < 1e-14);
                assert!((seen[1] - (y * r + tangential[1])).abs() < 1e-14);
                let back = lens.undistort(seen);
                assert!((back[0] - x).abs().max((back[1] - y).abs()) < 1e-12, "{back:?}");
            }
        }
    }

    /// OpenCV's fisheye formula, term by term, out to the limit; beyond it rays are cut.
    #[test]
    fn a_fisheye_ray_is_seen_at_the_polynomial_of_its_angle() {
        let lens = Distortion::fisheye([-0.02, 0.006, -0.003, 0.0005]);
        for degrees in [0.0, 1e-7, 3.0, 45.0, 60.0, 80.0, 88.9] {
            let angle = f64::to_radians(degrees);
            let seen = lens.distort(at_angle(degrees, 0.7));
            let expected = angle
                * (1.0 - 0.02 * angle.powi(2) + 0.006 * angle.powi(4) - 0.003 * angle.powi(6)
                    + 0.0005 * angle.powi(8));
            assert!((seen[0].hypot(seen[1]) - expected).abs() < 1e-13, "{degrees}");
            let [x, y] = lens.undistort(seen);
            assert!((x.hypot(y).atan() - angle).abs() < 1e-13 && !lens.is_cut(seen), "{degrees}");
        }
        for radius in [1.6, 2.0, 10.0, 1e9] {
            let seen = scaled([0.6, -0.8], radius);
            let [x, y] = lens.undistort(seen);
            assert!((x.hypot(y).atan().to_degrees() - 89.0).abs() < 1e-9 && lens.is_cut(seen));
            assert!(x > 0.0 && y < 0.0);
        }
    }

    /// A lens whose polynomial falls before 89° has no ray for what lies beyond.
    #[test]
    fn folds_are_found() {
        let folded = Distortion::fisheye([-0.2, 0.0, 0.0, 0.0]);
        // The angle's polynomial rises up to 1.29, where it is 0.86.
        assert!(folded.can_undo([0.8, 0.0]) && !folded.can_undo([0.9, 0.0]));
        let [x, _] = folded.undistort([0.8, 0.0]);
        assert!((x.atan() * (1.0 - 0.2 * x.atan().powi(2)) - 0.8).abs() < 1e-12);
        assert!(!Distortion::fisheye([f64::NAN, 0.0, 0.0, 0.0]).can_undo([0.5, 0.0]));
        let [x, y] = Distortion::fisheye([1e300, -1e300, 0.0, 0.0]).undistort([0.5, 0.1]);
        assert!(x.is_finite() && y.is_finite());
        let pole = Distortion { denominator: [-4.0, 0.0, 0.0], ..Distortion::default() };
        assert!(pole.can_undo([0.2, 0.0]) && !pole.can_undo([-0.9, 0.6]));
    }

    #[test]
    fn three_radial_terms_keep_their_bytes() {
        let brown = Distortion::brown([0.1, 0.0, -0.5], [0.0, 0.25]);
        let text = r#"{"radial":[0.1,0.0,-0.5],"tangential":[0.0,0.25]}"#;
        assert_eq!(serde_json::to_string(&brown).unwrap(), text);
        let all = Distortion {
            radial: [0.1, 0.2, 0.3, 0.4],
            denominator: [0.5, 0.0, 0.0],
            ..Distortion { projection: Projection::Fisheye, ..brown }
        };
        for lens in [brown, all, Distortion::fisheye([0.0; 4])] {
            let text = serde_json::to_string(&lens).unwrap();
            assert_eq!(serde_json::from_str::<Distortion>(&text).unwrap(), lens);
        }
        let short = serde_json::from_str::<Distortion>(r#"{"radial":[0.1],"tangential":[0,0]}"#);
        assert!(short.unwrap_err().to_string().contains("3 or 4 radial terms"));
    }

    proptest! {
        #[test]
        fn slopes_are_differences(
            d in prop_oneof![mild(), higher(), fisheye()],
            x in -0.6..0.6f64, y in -0.5..0.5f64
        ) {
            let step = 1e-6;
            let [xx, yx] = slope_between(&d, [x + step, y], [x - step, y], step);
            let [xy, yy] = slope_between(&d, [x, y + step], [x, y - step], step);
            let [by_x, by_y] = d.derivative([x, y]);
            for (slope, difference) in [(by_x[0], xx), (by_x[1], xy), (by_y[0], yx), (by_y[1], yy)] {
                prop_assert!((slope - difference).abs() < 1e-8, "{slope} {difference}");
            }
        }

        /// Up to the limit a fisheye ray comes back from where it is seen.
        #[test]
        fn fisheye_rays_come_back(d in fisheye(), degrees in 0.0..88.9f64, azimuth in 0.0..6.3f64) {
            let ray = at_angle(degrees, azimuth);
            let seen = d.distort(ray);
            prop_assert!(d.can_undo(seen) && !d.is_cut(seen));
            let [x, y] = d.undistort(seen);
            let off = (x - ray[0]).hypot(y - ray[1]) * degrees.to_radians().cos().powi(2);
            prop_assert!(off < 1e-10, "off by {off} radians");
        }
    }
}

use std::fmt;

use artifact::format_number;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::projection::{MAX_FISHEYE_ANGLE, Projection, fisheye_jacobian, ratio, scaled};

/// Radial and tangential distortion (Brown 1966), as defined by OpenCV and COLMAP. The undistorted
/// plane position (x, y) is imaged at (x·r + 2·p1·x·y + p2·(ρ + 2x²), y·r + p1·(ρ + 2y²) +
/// 2·p2·x·y) with ρ = x² + y² and r = a / d, where a = 1 + k1·ρ + k2·ρ² + k3·ρ³ + k4·ρ⁴ and d = 1 +
/// d1·ρ + d2·ρ² + d3·ρ³. Positions are in units of the focal length; y points down. The
/// [`Projection`] maps the ray to the undistorted position: with a fisheye lens ρ is the square of
/// the ray's angle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Distortion {
    /// Mapping of rays to the image plane before distortion.
    #[serde(default, skip_serializing_if = "Projection::is_perspective")]
    pub projection: Projection,
    /// Radial coefficients k1, k2, k3 and, unless 0, k4.
    #[serde(with = "radial")]
    #[schemars(with = "Vec<f64>", length(min = 3, max = 4))]
    pub radial: [f64; 4],
    /// Tangential coefficients p1, p2.
    pub tangential: [f64; 2],
    /// Denominator coefficients d1, d2, d3: k4, k5, k6 of OpenCV's rational model.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub denominator: [f64; 3],
}

/// Maximum error of undistortion, in focal lengths: 10⁻⁵ pixels at a focal length of 10,000 pixels.
const UNDISTORT_TOLERANCE: f64 = 1e-9;

/// Number of intervals from 0 to [`MAX_FISHEYE_ANGLE`], one of which brackets an angle; chosen by
/// hand. A lens that folds back within one interval is rejected if the fold is in the image.
const ANGLE_INTERVALS: u32 = 16;

fn is_zero(terms: &[f64; 3]) -> bool {
    *terms == [0.0; 3]
}

/// Serialisation of radial terms: three, or four if k4 isn't 0.
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

/// Lists the coefficients that aren't 0.
impl fmt::Display for Distortion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The denominator has the names of OpenCV's rational model, which has no radial k4.
        let names = ["k1", "k2", "k3", "k4", "p1", "p2", "k4", "k5", "k6"];
        let values = self.radial.iter().chain(&self.tangential).chain(&self.denominator);
        let terms = names.iter().zip(values).filter(|(_, value)| **value != 0.0);
        let terms = terms.map(|(name, value)| format!("{name} {}", format_number(*value)));
        let lens = self.is_fisheye().then(|| "fisheye".to_owned());
        write!(f, "({})", lens.into_iter().chain(terms).collect::<Vec<_>>().join(", "))
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

    /// True if all coefficients are finite.
    pub fn is_finite(&self) -> bool {
        let radial = self.radial.iter().chain(&self.denominator);
        radial.chain(&self.tangential).all(|k| k.is_finite())
    }

    /// Returns the distorted plane position of a ray with given slopes.
    pub fn distort(&self, slopes: [f64; 2]) -> [f64; 2] {
        self.distorted_position(self.projection.plane_position(slopes))
    }

    /// Returns the Jacobian of [`Distortion::distort`], [[∂u/∂x, ∂u/∂y], [∂v/∂x, ∂v/∂y]], of the
    /// distorted position (u, v) by the slopes (x, y).
    pub fn jacobian(&self, slopes: [f64; 2]) -> [[f64; 2]; 2] {
        let [a, b, c] = self.position_jacobian(self.projection.plane_position(slopes));
        if self.projection.is_perspective() {
            return [[a, b], [b, c]];
        }
        let [d, e, f] = fisheye_jacobian(slopes);
        [[a * d + b * e, a * e + b * f], [b * d + c * e, b * e + c * f]]
    }

    /// Returns the slopes of the ray at a distorted plane position. Beyond the radius at which a
    /// perspective lens folds back, the result is meaningless. A fisheye ray's angle from the axis
    /// is clamped to 89°.
    pub fn undistort(&self, distorted: [f64; 2]) -> [f64; 2] {
        self.projection.slopes(self.undistorted_position(distorted))
    }

    /// True if the fisheye ray at a position is clamped to 89° from the axis.
    pub(crate) fn is_clamped(&self, distorted: [f64; 2]) -> bool {
        self.is_fisheye() && is_at_limit(self.undistorted_position(distorted))
    }

    /// Returns the distorted plane position of an undistorted one.
    fn distorted_position(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [p1, p2] = self.tangential;
        let square = x * x + y * y;
        let (radial, _) = self.radial_factor(square);
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// Returns the Jacobian of [`Distortion::distorted_position`], a symmetric matrix: ∂u/∂x,
    /// ∂u/∂y and ∂v/∂y.
    fn position_jacobian(&self, [x, y]: [f64; 2]) -> [f64; 3] {
        let [p1, p2] = self.tangential;
        let (radial, derivative) = self.radial_factor(x * x + y * y);
        [
            radial + 2.0 * x * x * derivative + 2.0 * p1 * y + 6.0 * p2 * x,
            2.0 * x * y * derivative + 2.0 * p1 * x + 2.0 * p2 * y,
            radial + 2.0 * y * y * derivative + 6.0 * p1 * y + 2.0 * p2 * x,
        ]
    }

    /// Returns the undistorted plane position of a distorted one.
    fn undistorted_position(&self, distorted: [f64; 2]) -> [f64; 2] {
        if self.projection.is_perspective() {
            return self.solve_position(distorted, distorted);
        }
        let radius = libm::hypot(distorted[0], distorted[1]);
        let angle = self.undistorted_angle(radius);
        let radial = scaled(distorted, ratio(angle, radius));
        if self.tangential == [0.0; 2] {
            radial
        } else {
            clamped_angle(self.solve_position(distorted, radial), radial)
        }
    }

    /// Solves for the undistorted position by Newton's method. The maximum number of steps and the
    /// factor of the tolerance are chosen by hand.
    fn solve_position(&self, distorted: [f64; 2], start: [f64; 2]) -> [f64; 2] {
        const MAX_STEPS: usize = 20;
        let [mut x, mut y] = start;
        for _ in 0..MAX_STEPS {
            let [u, v] = self.distorted_position([x, y]);
            let [du, dv] = [distorted[0] - u, distorted[1] - v];
            let [a, b, c] = self.position_jacobian([x, y]);
            let determinant = a * c - b * b;
            x += (c * du - b * dv) / determinant;
            y += (a * dv - b * du) / determinant;
            if du.abs().max(dv.abs()) < 1e-2 * UNDISTORT_TOLERANCE {
                break;
            }
        }
        [x, y]
    }

    /// Returns the smallest angle whose distorted radius, without tangential terms, is `radius`, or
    /// [`MAX_FISHEYE_ANGLE`] if no smaller angle has this radius. Newton's method within a bracket:
    /// a step that leaves the bracket or is longer than half the previous step is replaced by
    /// bisection, so the loop ends.
    fn undistorted_angle(&self, radius: f64) -> f64 {
        let mut low = 0.0;
        let mut high = 0.0;
        for i in 1..=ANGLE_INTERVALS {
            low = high;
            high = MAX_FISHEYE_ANGLE * f64::from(i) / f64::from(ANGLE_INTERVALS);
            if self.distorted_radius(high).0 >= radius {
                break;
            }
            if i == ANGLE_INTERVALS {
                return MAX_FISHEYE_ANGLE;
            }
        }
        let mut angle = 0.5 * (low + high);
        let mut previous_step = high - low;
        while previous_step > f64::EPSILON * high {
            let (value, derivative) = self.distorted_radius(angle);
            if value < radius {
                low = angle;
            } else {
                high = angle;
            }
            let newton = angle - (value - radius) / derivative;
            let is_newton_safe =
                (low..=high).contains(&newton) && (newton - angle).abs() <= 0.5 * previous_step;
            let next = if is_newton_safe { newton } else { 0.5 * (low + high) };
            (angle, previous_step) = (next, (next - angle).abs());
        }
        angle
    }

    /// Returns the distorted radius of an angle, without tangential terms, and the derivative.
    fn distorted_radius(&self, angle: f64) -> (f64, f64) {
        let square = angle * angle;
        let (radial, derivative) = self.radial_factor(square);
        (angle * radial, radial + 2.0 * square * derivative)
    }

    /// Returns r and its derivative with respect to ρ.
    fn radial_factor(&self, square: f64) -> (f64, f64) {
        let [k1, k2, k3, k4] = self.radial;
        let numerator = 1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4)));
        let numerator_derivative =
            k1 + square * (2.0 * k2 + square * 3.0 * k3 + square * square * 4.0 * k4);
        if is_zero(&self.denominator) {
            return (numerator, numerator_derivative);
        }
        let [d1, d2, d3] = self.denominator;
        let denominator = 1.0 + square * (d1 + square * (d2 + square * d3));
        let denominator_derivative = d1 + square * (2.0 * d2 + square * (3.0 * d3));
        let radial = numerator / denominator;
        (radial, (numerator_derivative - radial * denominator_derivative) / denominator)
    }

    /// True if a position has exactly one ray: undoing the distortion succeeds, or a fisheye ray is
    /// clamped, and the distortion doesn't fold back between the centre and the position.
    pub(crate) fn is_invertible_at(&self, distorted: [f64; 2]) -> bool {
        let position = self.undistorted_position(distorted);
        let [u, v] = self.distorted_position(position);
        let is_found = (u - distorted[0]).abs().max((v - distorted[1]).abs()) < UNDISTORT_TOLERANCE;
        // Paths to different border positions usually end at different radii, so that their samples
        // fill each other's gaps. Clamped rays all end at 89°, so fisheye paths have more samples.
        // Both numbers are chosen by hand.
        let samples = if self.is_fisheye() { 64u32 } else { 16 };
        (is_found || self.is_fisheye() && is_at_limit(position))
            && (0..=samples).all(|i| {
                let fraction = f64::from(i) / f64::from(samples);
                let [a, b, c] =
                    self.position_jacobian([fraction * position[0], fraction * position[1]]);
                a > 0.0 && a * c > b * b
            })
    }
}

/// Clamps a fisheye plane position to [`MAX_FISHEYE_ANGLE`]; returns `otherwise` for one that isn't
/// finite.
fn clamped_angle(position: [f64; 2], otherwise: [f64; 2]) -> [f64; 2] {
    let angle = libm::hypot(position[0], position[1]);
    if !angle.is_finite() {
        return otherwise;
    }
    scaled(position, ratio(angle.min(MAX_FISHEYE_ANGLE), angle))
}

/// True if a fisheye plane position is at [`MAX_FISHEYE_ANGLE`], to rounding errors.
fn is_at_limit(at: [f64; 2]) -> bool {
    libm::hypot(at[0], at[1]) >= MAX_FISHEYE_ANGLE - UNDISTORT_TOLERANCE
}

#[cfg(test)]
pub(crate) mod tests;

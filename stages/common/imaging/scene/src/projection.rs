use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Mapping of a ray to the image plane before distortion. The plane's unit is the focal length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Projection {
    /// Distance from the principal point is the tangent of the ray's angle from the optical axis.
    #[default]
    Perspective,
    /// Equidistant: distance from the principal point is the angle itself, in radians.
    Fisheye,
}

/// Maximum angle between a fisheye lens's ray and the optical axis, in radians: 89°. Beyond 90° a
/// point has no positive depth; just below 90° slopes have no useful precision.
pub(crate) const MAX_FISHEYE_ANGLE: f64 = 89.0 / 180.0 * std::f64::consts::PI;

impl Projection {
    /// True for the perspective projection.
    pub fn is_perspective(&self) -> bool {
        *self == Self::Perspective
    }

    /// Returns the plane position of the ray with slopes (x, y) relative to the optical axis.
    pub(crate) fn plane_position(self, [x, y]: [f64; 2]) -> [f64; 2] {
        match self {
            Self::Perspective => [x, y],
            Self::Fisheye => {
                let slope = libm::hypot(x, y);
                scaled([x, y], ratio(libm::atan(slope), slope))
            }
        }
    }

    /// Returns the slopes of the ray at a plane position, whose fisheye angle is below 90°.
    pub(crate) fn slopes(self, [u, v]: [f64; 2]) -> [f64; 2] {
        match self {
            Self::Perspective => [u, v],
            Self::Fisheye => {
                let angle = libm::hypot(u, v);
                scaled([u, v], ratio(libm::tan(angle), angle))
            }
        }
    }
}

/// Returns the Jacobian of a fisheye lens's [`Projection::plane_position`] (u, v) at slopes (x, y),
/// a symmetric matrix: ∂u/∂x, ∂u/∂y and ∂v/∂y.
pub(crate) fn fisheye_jacobian([x, y]: [f64; 2]) -> [f64; 3] {
    let slope = libm::hypot(x, y);
    let across = ratio(libm::atan(slope), slope);
    let excess = 1.0 / (1.0 + slope * slope) - across;
    let [nx, ny] = [ratio(x, slope), ratio(y, slope)];
    [across + excess * nx * nx, excess * nx * ny, across + excess * ny * ny]
}

/// Multiplies both coordinates.
pub(crate) fn scaled([x, y]: [f64; 2], factor: f64) -> [f64; 2] {
    [factor * x, factor * y]
}

/// Divides; 0 / 0 is 1, the limit of tan(a) / a.
pub(crate) fn ratio(value: f64, by: f64) -> f64 {
    if by == 0.0 { 1.0 } else { value / by }
}

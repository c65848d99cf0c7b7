//! Maps between the world and a field's unit cube, and steps of rays through the cube.

use glam::DVec3;
use radiance::{MAX_SPEED, NormalizedRay, RayMap};
use scene::{Bounds, Space};

/// Minimum speed that [`step_along`] assumes for a contracted ray; chosen by hand. Only rays near
/// the border are slower.
const MIN_SPEED: f32 = 1.0 / 64.0;
/// Maximum distance from the middle of a contracted space in ball radii, 2 at infinity; chosen by
/// hand.
const MAX_CONTRACTED_RADIUS: f64 = 2.0 - 1e-6;

/// Converts a position in the unit cube to a world point. Positions beyond the border of a
/// contracted space become very distant points.
pub(crate) fn to_world(bounds: &Bounds, position: DVec3) -> DVec3 {
    match &bounds.space {
        Space::Box => DVec3::from(bounds.min) + bounds.longest_side() * position,
        Space::Ndc(frustum) => frustum.to_world(position),
        Space::Contraction => {
            let contracted = 4.0 * (position - 0.5);
            let radius = contracted.length();
            let factor = match radius > 1.0 {
                true => 1.0 / ((2.0 - radius.min(MAX_CONTRACTED_RADIUS)) * radius),
                false => 1.0,
            };
            bounds.middle() + 0.5 * bounds.longest_side() * factor * contracted
        }
    }
}

/// Returns whether rays can reach any part of the box from `low` to `high` in the unit cube.
pub(crate) fn is_reachable(bounds: &Bounds, low: [f32; 3], high: [f32; 3]) -> bool {
    match &bounds.space {
        Space::Box => {
            let extent = bounds.to_cube(DVec3::from(bounds.max));
            (0..3).all(|i| f64::from(low[i]) <= extent[i])
        }
        Space::Ndc(frustum) => {
            let extent = |i: usize| (frustum.max[i] - frustum.min[i]) / frustum.cube_side();
            (0..2).all(|i| f64::from(low[i]) <= extent(i))
        }
        Space::Contraction => {
            let nearest: [f32; 3] = std::array::from_fn(|i| 0.5f32.max(low[i]).min(high[i]) - 0.5);
            nearest.iter().map(|c| c * c).sum::<f32>() <= 0.25
        }
    }
}

/// Returns the increase of t with which a ray at t moves by about a distance in the unit cube. Rays
/// near the border of a contracted space move less.
pub(crate) fn step_along(ray: &NormalizedRay, t: f32, distance: f32) -> f32 {
    match ray.map {
        RayMap::Straight { .. } => distance,
        RayMap::Contracted { .. } => {
            let (from, to) = (ray.position(t), ray.position(t + distance));
            let moved = (0..3).map(|i| (to[i] - from[i]).powi(2)).sum::<f32>().sqrt();
            distance / (moved / distance).max(MIN_SPEED)
        }
    }
}

/// Returns an increase of t with which a ray surely moves by at most a distance in the unit cube.
pub(crate) fn leap_along(ray: &NormalizedRay, distance: f32) -> f32 {
    match ray.map {
        RayMap::Straight { .. } => distance,
        RayMap::Contracted { .. } => distance / MAX_SPEED,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::Frustum;

    /// Returns bounds of each space.
    fn spaces() -> [Bounds; 3] {
        let frustum = Frustum {
            camera_to_world: [[1., 0., 0., 3.], [0., 1., 0., -1.], [0., 0., 1., 9.]],
            min: [-0.7, -0.4],
            max: [0.8, 0.5],
            near: 0.9,
            far: 77.0,
        };
        [Space::Box, Space::Ndc(frustum), Space::Contraction].map(|space| Bounds {
            min: [2.0, -2.0, 7.0],
            max: [4.0, 0.5, 9.0],
            near: 0.5,
            far: 90.0,
            space,
        })
    }

    #[test]
    fn cube_positions_convert_to_world_points_and_back() {
        for bounds in spaces() {
            for k in 0..64 {
                let grid_point =
                    DVec3::new(f64::from(k % 4), f64::from(k / 4 % 4), f64::from(k / 16));
                let position = 0.5 + 0.3 * (grid_point / 3.0 - 0.5);
                let found = bounds.to_cube(to_world(&bounds, position));
                assert!((found - position).length() < 1e-9, "{bounds:?} {position} {found}");
            }
            assert!(to_world(&bounds, DVec3::splat(0.999)).is_finite());
        }
    }

    /// A position that a ray can have is reachable; the cube's corners are not.
    #[test]
    fn only_unreachable_positions_are_left_out() {
        for bounds in spaces() {
            let point = to_world(&bounds, DVec3::new(0.4, 0.3, 0.6));
            let position = bounds.to_cube(point).as_vec3().to_array();
            assert!(is_reachable(&bounds, position, position));
            assert!(is_reachable(&bounds, [0.0; 3], [1.0; 3]));
            assert!(!is_reachable(&bounds, [0.95; 3], [1.0; 3]), "{bounds:?}");
        }
    }

    /// A step moves a contracted ray by about the distance, and a leap by at most the distance.
    #[test]
    fn steps_and_leaps_have_their_length() {
        let [.., bounds] = spaces();
        let distance = 1.0 / 64.0;
        for k in 0..200 {
            let angle = 0.1 * f64::from(k);
            let direction = [angle.cos(), 0.8 * angle.sin(), 0.6 * angle.sin()];
            let origin = [3.0 + 3.0 * angle.sin(), 0.1 * angle, 8.0];
            let ray = radiance::Ray { origin, direction, background: [0.0; 3] };
            let ray = radiance::clip(&bounds, &ray);
            let mut t = ray.enter;
            while t < ray.leave {
                let length = |step: f32| {
                    let (a, b) = (ray.position(t), ray.position(t + step));
                    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f32>().sqrt()
                };
                let step = step_along(&ray, t, distance);
                assert!(length(step) < 1.4 * distance, "{} at {t} of {ray:?}", length(step));
                assert!(length(leap_along(&ray, distance)) <= distance * 1.0001);
                t += step;
            }
        }
    }
}

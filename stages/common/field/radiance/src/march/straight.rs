//! Straight rays: through a box, or through a frustum in normalised device coordinates.

use super::lanes::{LanePositions, LaneRays, RayKind};
use crate::occupancy::Occupancy;
use crate::ray::NormalizedRay;
use crate::spec::OCCUPANCY_CELLS as GRID;
use numerics::simd::LANES;

/// Rays through a box or a frustum.
pub(super) struct Straight;

impl RayKind for Straight {
    #[inline(always)]
    fn crossing(
        occupancy: &Occupancy,
        ray: &NormalizedRay,
        inverse: &[f32; 3],
    ) -> Option<[f32; 2]> {
        occupancy.crossing(ray, inverse)
    }

    /// Returns the position at t. [`NormalizedRay::position`] has a branch with an exponential,
    /// which the compiler would evaluate for straight rays, too.
    #[inline(always)]
    fn position(ray: &NormalizedRay, t: f32) -> [f32; 3] {
        std::array::from_fn(|axis| ray.direction[axis].mul_add(t, ray.origin[axis]))
    }

    #[inline(always)]
    fn positions(rays: &LaneRays, t: &[f32; LANES]) -> [[f32; LANES]; 3] {
        let LaneRays { origin: [x, y, z], direction: [dx, dy, dz], .. } = rays;
        [along(x, dx, t), along(y, dy, t), along(z, dz, t)]
    }

    #[inline(always)]
    fn exits(
        rays: &LaneRays,
        lane_positions: &LanePositions,
        log2_sides: &[u32; LANES],
    ) -> [f32; LANES] {
        let mut exits = [f32::INFINITY; LANES];
        leave_along(0, rays, lane_positions, log2_sides, &mut exits);
        leave_along(1, rays, lane_positions, log2_sides, &mut exits);
        leave_along(2, rays, lane_positions, log2_sides, &mut exits);
        exits
    }
}

/// Returns the positions' coordinates along one axis.
#[inline(always)]
fn along(origin: &[f32; LANES], direction: &[f32; LANES], t: &[f32; LANES]) -> [f32; LANES] {
    let mut positions = [0.0; LANES];
    for i in 0..LANES {
        positions[i] = direction[i].mul_add(t[i], origin[i]);
    }
    positions
}

/// Shortens `exits` to the t at which rays leave their cubes along one axis.
#[inline(always)]
fn leave_along(
    axis: usize,
    rays: &LaneRays,
    lane_positions: &LanePositions,
    log2_sides: &[u32; LANES],
    exits: &mut [f32; LANES],
) {
    let (origin, direction) = (&rays.origin[axis], &rays.direction[axis]);
    let (inverse, cells) = (&rays.inverse[axis], &lane_positions.cells[axis]);
    for i in 0..LANES {
        let side = if direction[i] > 0.0 { 1 << log2_sides[i] } else { 0 };
        let face =
            ((cells[i] >> log2_sides[i] << log2_sides[i]) + side) as i32 as f32 / GRID as f32;
        let until = (face - origin[i]) * inverse[i];
        exits[i] = if direction[i] != 0.0 && until < exits[i] { until } else { exits[i] };
    }
}

//! Straight rays: through a box, and through a frustum's normalised device coordinates.

use super::side_by_side::{LaneRays, Places, RayKind};
use crate::occupancy::Occupancy;
use crate::ray::NormalizedRay;
use crate::simd::LANES;
use crate::spec::OCCUPANCY_CELLS as GRID;

/// The kind of straight rays.
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

    /// As [`NormalizedRay::position`], whose other branch takes an exponential: the compiler would
    /// compute it here, too.
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
    fn exits(rays: &LaneRays, places: &Places, sizes: &[u32; LANES]) -> [f32; LANES] {
        let mut exits = [f32::INFINITY; LANES];
        leave_along(0, rays, places, sizes, &mut exits);
        leave_along(1, rays, places, sizes, &mut exits);
        leave_along(2, rays, places, sizes, &mut exits);
        exits
    }
}

/// Coordinates along an axis.
#[inline(always)]
fn along(origin: &[f32; LANES], direction: &[f32; LANES], t: &[f32; LANES]) -> [f32; LANES] {
    let mut positions = [0.0; LANES];
    for i in 0..LANES {
        positions[i] = direction[i].mul_add(t[i], origin[i]);
    }
    positions
}

/// Shortens `exits` to where rays leave along an axis.
#[inline(always)]
fn leave_along(
    axis: usize,
    rays: &LaneRays,
    places: &Places,
    sizes: &[u32; LANES],
    exits: &mut [f32; LANES],
) {
    let (origin, direction) = (&rays.origin[axis], &rays.direction[axis]);
    let (inverse, cells) = (&rays.inverse[axis], &places.cells[axis]);
    for i in 0..LANES {
        let side = if direction[i] > 0.0 { 1 << sizes[i] } else { 0 };
        let face = ((cells[i] >> sizes[i] << sizes[i]) + side) as i32 as f32 / GRID as f32;
        let until = (face - origin[i]) * inverse[i];
        exits[i] = if direction[i] != 0.0 && until < exits[i] { until } else { exits[i] };
    }
}

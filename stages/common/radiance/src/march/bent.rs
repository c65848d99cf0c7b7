//! Bent rays: through the contraction a ray is a curve.

use super::side_by_side::{LaneRays, Places, RayKind};
use crate::occupancy::Occupancy;
use crate::ray::{
    FASTEST, MOST_BENT, NormalizedRay, RayMap, contracted_place, contracted_velocity,
};
use crate::simd::LANES;
use crate::spec::OCCUPANCY_CELLS as GRID;

/// The kind of bent rays.
pub(super) struct Bent;

impl RayKind for Bent {
    #[inline(always)]
    fn crossing(_: &Occupancy, ray: &NormalizedRay, _: &[f32; 3]) -> Option<[f32; 2]> {
        match ray.map {
            RayMap::Contracted { .. } => Some([ray.enter, ray.leave]),
            // A ray that meets nothing has a straight one's map.
            RayMap::Straight { .. } => {
                debug_assert!(ray.enter >= ray.leave);
                None
            }
        }
    }

    #[inline(always)]
    fn position(ray: &NormalizedRay, t: f32) -> [f32; 3] {
        ray.position(t)
    }

    #[inline(always)]
    fn positions(rays: &LaneRays, t: &[f32; LANES]) -> [[f32; LANES]; 3] {
        let (mut xs, mut ys, mut zs) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            let (origin, direction) = (of_lane(&rays.origin, i), of_lane(&rays.direction, i));
            [xs[i], ys[i], zs[i]] = contracted_place(origin, direction, rays.radii[i], t[i]);
        }
        [xs, ys, zs]
    }

    #[inline(always)]
    fn exits(rays: &LaneRays, places: &Places, sizes: &[u32; LANES]) -> [f32; LANES] {
        let (mut xs, mut ys, mut zs) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            let (origin, direction) = (of_lane(&rays.origin, i), of_lane(&rays.direction, i));
            [xs[i], ys[i], zs[i]] =
                contracted_velocity(origin, direction, rays.radii[i], places.t[i]);
        }
        let velocities = [xs, ys, zs];
        let mut exits = [0.0; LANES];
        for i in 0..LANES {
            let cube = EmptyCube::around(of_lane(&places.cells, i), sizes[i]);
            let inside = cube.time_inside(&of_lane(&places.positions, i), &of_lane(&velocities, i));
            // A ray takes about a step through half a cell, and goes on by a step anyway.
            exits[i] = if sizes[i] == 0 { places.t[i] } else { inside + places.t[i] };
        }
        exits
    }
}

/// A lane's part of three rows.
#[inline(always)]
fn of_lane<T: Copy>(rows: &[[T; LANES]; 3], lane: usize) -> [T; 3] {
    [rows[0][lane], rows[1][lane], rows[2][lane]]
}

/// A cube of empty cells.
pub(super) struct EmptyCube {
    /// Its first cell along each axis.
    low: [u32; 3],
    /// Cells along each axis.
    side: u32,
}

impl EmptyCube {
    /// The cube of 2^`size` cells a side that a cell lies in.
    #[inline(always)]
    pub(super) fn around(cell: [u32; 3], size: u32) -> Self {
        Self { low: cell.map(|c| c >> size << size), side: 1 << size }
    }

    /// How far in t a ray goes and is still inside, from a position with a velocity: bounded by its
    /// greatest speed, and by its velocity with the most that this changes.
    #[inline(always)]
    pub(super) fn time_inside(&self, position: &[f32; 3], velocity: &[f32; 3]) -> f32 {
        let (mut nearest, mut stay) = (f32::INFINITY, f32::INFINITY);
        for i in 0..3 {
            let low = self.low[i] as i32 as f32 / GRID as f32;
            let high = (self.low[i] + self.side) as i32 as f32 / GRID as f32;
            // Rounding may put a place outside of the unit cube.
            let (below, above) = ((position[i] - low).max(0.0), (high - position[i]).max(0.0));
            nearest = nearest.min(below.min(above));
            let (ahead, behind) = if velocity[i] > 0.0 { (above, below) } else { (below, above) };
            let speed = velocity[i].abs();
            // Roots of v·Δ + a·Δ²/2 = ahead and v·Δ - a·Δ²/2 = -behind.
            let to_ahead =
                2.0 * ahead / (speed + (2.0 * MOST_BENT).mul_add(ahead, speed * speed).sqrt());
            let to_behind = (speed + (2.0 * MOST_BENT).mul_add(behind, speed * speed).sqrt())
                * (1.0 / MOST_BENT);
            // NaN at a face that the ray moves along: there it stays no longer.
            stay = stay.min(to_ahead.max(0.0)).min(to_behind);
        }
        // Rounding of the velocity is less than a thousandth.
        (nearest * (1.0 / FASTEST)).max(stay * 0.999)
    }
}

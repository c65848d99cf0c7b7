//! Curved rays: the contraction maps a straight ray to a curve.

use super::lanes::{LanePositions, LaneRays, RayKind};
use crate::occupancy::Occupancy;
use crate::ray::{
    MAX_ACCELERATION, MAX_SPEED, NormalizedRay, RayMap, contracted_position, contracted_velocity,
};
use crate::spec::OCCUPANCY_CELLS as GRID;
use numerics::simd::LANES;

/// Rays through the contraction.
pub(super) struct Curved;

impl RayKind for Curved {
    #[inline(always)]
    fn crossing(_: &Occupancy, ray: &NormalizedRay, _: &[f32; 3]) -> Option<[f32; 2]> {
        match ray.map {
            RayMap::Contracted { .. } => Some([ray.enter, ray.leave]),
            // Among curved rays, only those that miss the cube have this map.
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
            let (origin, direction) = (lane_of(&rays.origin, i), lane_of(&rays.direction, i));
            [xs[i], ys[i], zs[i]] = contracted_position(origin, direction, rays.radii[i], t[i]);
        }
        [xs, ys, zs]
    }

    #[inline(always)]
    fn exits(
        rays: &LaneRays,
        lane_positions: &LanePositions,
        log2_sides: &[u32; LANES],
    ) -> [f32; LANES] {
        let (mut xs, mut ys, mut zs) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            let (origin, direction) = (lane_of(&rays.origin, i), lane_of(&rays.direction, i));
            [xs[i], ys[i], zs[i]] =
                contracted_velocity(origin, direction, rays.radii[i], lane_positions.t[i]);
        }
        let velocities = [xs, ys, zs];
        let mut exits = [0.0; LANES];
        for i in 0..LANES {
            let cube = EmptyCube::around(lane_of(&lane_positions.cells, i), log2_sides[i]);
            let inside =
                cube.time_inside(&lane_of(&lane_positions.positions, i), &lane_of(&velocities, i));
            // For a cube of one cell, t itself is the bound. A closer bound would gain little: the
            // ray advances by a step anyway, and the mean distance to the exit, half a cell, is
            // about one step (at 512 `march_steps`).
            exits[i] =
                if log2_sides[i] == 0 { lane_positions.t[i] } else { inside + lane_positions.t[i] };
        }
        exits
    }
}

/// Returns one lane of three rows.
#[inline(always)]
fn lane_of<T: Copy>(rows: &[[T; LANES]; 3], lane: usize) -> [T; 3] {
    [rows[0][lane], rows[1][lane], rows[2][lane]]
}

/// Cube of empty cells.
pub(super) struct EmptyCube {
    /// First cell along each axis.
    low: [u32; 3],
    /// Cells along each axis.
    side: u32,
}

impl EmptyCube {
    /// Returns the cube of 2^`log2_side` cells per side that contains a cell.
    #[inline(always)]
    pub(super) fn around(cell: [u32; 3], log2_side: u32) -> Self {
        Self { low: cell.map(|c| c >> log2_side << log2_side), side: 1 << log2_side }
    }

    /// Returns a lower bound, in units of t, of the time until a ray leaves the cube. The bound
    /// follows from the ray's position and velocity, [`MAX_SPEED`] and [`MAX_ACCELERATION`].
    #[inline(always)]
    pub(super) fn time_inside(&self, position: &[f32; 3], velocity: &[f32; 3]) -> f32 {
        let (mut nearest_face, mut min_time) = (f32::INFINITY, f32::INFINITY);
        for i in 0..3 {
            let low = self.low[i] as i32 as f32 / GRID as f32;
            let high = (self.low[i] + self.side) as i32 as f32 / GRID as f32;
            // Rounding may move a position outside the unit cube.
            let (below, above) = ((position[i] - low).max(0.0), (high - position[i]).max(0.0));
            nearest_face = nearest_face.min(below.min(above));
            let (ahead, behind) = if velocity[i] > 0.0 { (above, below) } else { (below, above) };
            let speed = velocity[i].abs();
            // Times Δ with v·Δ + a·Δ²/2 = ahead and v·Δ - a·Δ²/2 = -behind, for the speed v and the
            // maximum acceleration a.
            let to_ahead = 2.0 * ahead
                / (speed + (2.0 * MAX_ACCELERATION).mul_add(ahead, speed * speed).sqrt());
            let to_behind = (speed
                + (2.0 * MAX_ACCELERATION).mul_add(behind, speed * speed).sqrt())
                * (1.0 / MAX_ACCELERATION);
            // NaN where the ray moves along a face; `max` turns it into 0.
            min_time = min_time.min(to_ahead.max(0.0)).min(to_behind);
        }
        // The velocity's relative rounding error is below 0.001.
        (nearest_face * (1.0 / MAX_SPEED)).max(min_time * 0.999)
    }
}

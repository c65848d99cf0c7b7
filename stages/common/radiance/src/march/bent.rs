//! A bent ray's march: through the contraction a ray is a curve.

use super::marched::{DONE, March, Marched};
use super::steps::first_step;
use crate::occupancy::{OCCUPIED, cell_of};
use crate::ray::{FASTEST, MOST_BENT, NormalizedRay, RayMap};
use crate::spec::OCCUPANCY_CELLS as GRID;

/// A cube of empty cells.
pub(super) struct EmptyCube {
    /// Its first cell along each axis.
    pub(super) low: [usize; 3],
    /// Cells along each axis.
    pub(super) side: usize,
}

impl EmptyCube {
    /// The cube of 2^`size` cells a side that a cell lies in.
    #[inline(always)]
    fn around(cell: [usize; 3], size: u32) -> Self {
        Self { low: cell.map(|c| c >> size << size), side: 1 << size }
    }

    /// A t at which a ray is still inside: bounded by its greatest speed, and by its velocity at
    /// `at` with the most that this changes. At t = `at` the ray is at `position`.
    #[inline(always)]
    pub(super) fn exit(
        &self,
        ray: &NormalizedRay,
        radii: f32,
        at: f32,
        position: &[f32; 3],
    ) -> f32 {
        // A ray takes about a step through half a cell, and goes on by a step anyway.
        if self.side == 1 {
            return at;
        }
        let velocity = ray.contracted_velocity(radii, at);
        let (mut nearest, mut stay) = (f32::INFINITY, f32::INFINITY);
        for i in 0..3 {
            let low = self.low[i] as f32 / GRID as f32;
            let high = (self.low[i] + self.side) as f32 / GRID as f32;
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
        (nearest * (1.0 / FASTEST)).max(stay * 0.999) + at
    }
}

/// Steps whose places are found together, in one vector: their exponentials cost more than all
/// else.
const STEPS_AHEAD: usize = 8;

/// Marches bent rays on, see [`super::march`].
#[inline(always)]
pub(super) fn march(
    march: &March<'_>,
    most: usize,
    active: &[u32],
    next: &mut [u32],
    samples: &mut Marched,
) {
    for &r in active {
        samples.starts.push(samples.t.len());
        let (ray, offset) = (&march.rays[r as usize], march.offsets[r as usize]);
        let next = &mut next[r as usize];
        *next = match ray.map {
            RayMap::Contracted { radii, .. } => {
                BentRay { march, ray, offset, radii }.run(most, *next, samples)
            }
            // A ray that meets nothing has a straight one's map.
            RayMap::Straight { .. } => {
                debug_assert!(ray.enter >= ray.leave);
                DONE
            }
        };
    }
}

/// One ray's march.
struct BentRay<'a> {
    march: &'a March<'a>,
    ray: &'a NormalizedRay,
    offset: f32,
    /// Ball radii of the ray's map.
    radii: f32,
}

impl BentRay<'_> {
    /// The first step at t or behind it.
    #[inline(always)]
    fn step_at(&self, t: f32) -> u32 {
        let steps = (t - self.ray.enter).mul_add(1.0 / self.march.step, -self.offset);
        first_step(steps)
    }

    /// Marches on from step `k`; gives the next step.
    #[inline(always)]
    fn run(&self, most: usize, mut k: u32, samples: &mut Marched) -> u32 {
        let March { occupancy, step, strides, .. } = *self.march;
        let (ray, offset) = (self.ray, self.offset);
        let mut left = most;
        while left > 0 {
            let first = k;
            let ahead: [f32; STEPS_AHEAD] = std::array::from_fn(|i| {
                (first as f32 + i as f32 + offset).mul_add(step, ray.enter)
            });
            let places = ray.positions(&ahead);
            while left > 0 && ((k - first) as usize) < STEPS_AHEAD {
                let at = ahead[(k - first) as usize];
                if at >= ray.leave {
                    return DONE;
                }
                let p = places.map(|axis| axis[(k - first) as usize]);
                let cell = cell_of(p);
                let [size] = occupancy.empty_around(&cell.map(|c| [c as u32]));
                if size != OCCUPIED {
                    // Where the ray leaves what is empty; at least one step on.
                    let exit = EmptyCube::around(cell, size).exit(ray, self.radii, at, &p);
                    k = (k + 1).max(self.step_at(exit));
                    continue;
                }
                if !strides.are_double_in(occupancy.is_thin(cell)) {
                    samples.push(at, 1.0, p);
                    left -= 1;
                } else {
                    let middle = (k as f32 + offset + 0.5).mul_add(step, ray.enter);
                    if k & 1 == 0 && middle < ray.leave {
                        samples.push(middle, 2.0, ray.position(middle));
                        left -= 1;
                    }
                }
                k += 1;
            }
        }
        k
    }
}

//! Marches as many rays at a time as there are lanes. A leap of a ray depends on the ray's previous
//! leap, so the processor would idle with one ray.

use super::marched::{DONE, March, MarchedSamples};
use crate::math::floor;
use crate::occupancy::{OCCUPIED, Occupancy, cell_along};
use crate::ray::NormalizedRay;
use numerics::simd::LANES;

/// Paths of straight or curved rays through the unit cube, for all lanes at once.
pub(super) trait RayKind {
    /// Returns the range of t in which a ray may cross occupied cells; `None` if there is none.
    /// `inverse` is 1 over the ray's direction.
    fn crossing(occupancy: &Occupancy, ray: &NormalizedRay, inverse: &[f32; 3])
    -> Option<[f32; 2]>;

    /// Returns the position of one ray at t.
    fn position(ray: &NormalizedRay, t: f32) -> [f32; 3];

    /// Returns the rays' positions at t, one array per axis.
    fn positions(rays: &LaneRays, t: &[f32; LANES]) -> [[f32; LANES]; 3];

    /// Returns for each ray a t that is not beyond the ray's exit from the empty cube around the
    /// ray's position. The cube has 2^`log2_sides` cells per side.
    fn exits(
        rays: &LaneRays,
        lane_positions: &LanePositions,
        log2_sides: &[u32; LANES],
    ) -> [f32; LANES];
}

/// Mask of the logarithm of an empty cube's side, at most 7: shifts known to be below 32 vectorise
/// without a check.
const LOG2_SIDE_MASK: u32 = 0b111;

/// The rays of all lanes.
#[derive(Default)]
pub(super) struct LaneRays {
    /// Origins, one array per axis.
    pub(super) origin: [[f32; LANES]; 3],
    pub(super) direction: [[f32; LANES]; 3],
    /// 1 over the direction.
    pub(super) inverse: [[f32; LANES]; 3],
    /// Ball radii per sinh(4t) of curved rays; 0 for straight ones.
    pub(super) radii: [f32; LANES],
    /// Offset of the first step, in steps.
    offset: [f32; LANES],
    /// Range of t in the unit cube.
    enter: [f32; LANES],
    leave: [f32; LANES],
}

/// Positions of the rays of all lanes.
pub(super) struct LanePositions {
    pub(super) t: [f32; LANES],
    /// Positions in the unit cube, one array per axis.
    pub(super) positions: [[f32; LANES]; 3],
    pub(super) cells: [[u32; LANES]; 3],
}

/// State of the rays that march in lanes.
struct Marching<'a> {
    march: &'a March<'a>,
    /// Maximum number of samples per ray in this round.
    max_samples: usize,
    /// Rays to march.
    active: &'a [u32],
    /// Index in `active` of the next ray without a lane.
    next_active: usize,
    /// Bits of the lanes that have a ray.
    busy_lanes: u32,
    /// Index in `active` of each lane's ray.
    active_index: [usize; LANES],
    rays: LaneRays,
    /// End of the range of t in which each lane's ray may cross occupied cells.
    occupied_until: [f32; LANES],
    /// Number of each lane's next step.
    k: [u32; LANES],
}

/// Marches rays of one kind, see [`super::march`].
#[inline(always)]
pub(super) fn march<K: RayKind>(
    march: &March<'_>,
    max_samples: usize,
    active: &[u32],
    next: &mut [u32],
    samples: &mut MarchedSamples,
) {
    samples.slots.begin(active.len(), max_samples);
    let mut lanes = Marching::new(march, max_samples, active);
    for lane in 0..LANES {
        lanes.assign_ray::<K>(lane, next);
    }
    while lanes.busy_lanes != 0 {
        let (lane_positions, mut stops) = lanes.advance::<K>();
        while stops != 0 {
            let lane = stops.trailing_zeros() as usize;
            stops &= stops - 1;
            let r = active[lanes.active_index[lane]] as usize;
            if lane_positions.t[lane] >= lanes.occupied_until[lane] {
                next[r] = DONE;
            } else if lanes.take_sample(lane, &lane_positions, samples) {
                continue;
            } else {
                next[r] = lanes.k[lane];
            }
            lanes.assign_ray::<K>(lane, next);
        }
    }
    append_slots::<K>(march.rays, active, samples);
}

/// Appends the samples in the slots, by ray.
#[inline(always)]
fn append_slots<K: RayKind>(rays: &[NormalizedRay], active: &[u32], samples: &mut MarchedSamples) {
    for (active_index, &r) in active.iter().enumerate() {
        samples.starts.push(samples.t.len());
        for slot in 0..samples.slots.counts[active_index] {
            let [t, length] = samples.slots.sample(active_index, slot);
            samples.push(t, length, K::position(&rays[r as usize], t));
        }
    }
}

impl LaneRays {
    #[inline(always)]
    fn set(&mut self, lane: usize, ray: &NormalizedRay, inverse: [f32; 3], offset: f32) {
        for axis in 0..3 {
            self.origin[axis][lane] = ray.origin[axis];
            self.direction[axis][lane] = ray.direction[axis];
            self.inverse[axis][lane] = inverse[axis];
        }
        self.radii[lane] = ray.radii();
        (self.offset[lane], self.enter[lane], self.leave[lane]) = (offset, ray.enter, ray.leave);
    }
}

impl<'a> Marching<'a> {
    #[inline(always)]
    fn new(march: &'a March<'a>, max_samples: usize, active: &'a [u32]) -> Self {
        Self {
            march,
            max_samples,
            active,
            next_active: 0,
            busy_lanes: 0,
            active_index: [0; LANES],
            rays: LaneRays::default(),
            occupied_until: [0.0; LANES],
            k: [0; LANES],
        }
    }

    /// Assigns to a lane the next active ray that crosses occupied cells.
    #[inline(always)]
    fn assign_ray<K: RayKind>(&mut self, lane: usize, next: &mut [u32]) {
        self.busy_lanes &= !(1 << lane);
        while let Some(&r) = self.active.get(self.next_active) {
            let (ray, offset) = (&self.march.rays[r as usize], self.march.offsets[r as usize]);
            let inverse = ray.direction.map(|d| 1.0 / d);
            self.next_active += 1;
            let Some([from, until]) = K::crossing(self.march.occupancy, ray, &inverse) else {
                next[r as usize] = DONE;
                continue;
            };
            self.rays.set(lane, ray, inverse, offset);
            self.occupied_until[lane] = until;
            let first = ceil_steps((from - ray.enter).mul_add(1.0 / self.march.step, -offset));
            self.k[lane] = first.max(next[r as usize]);
            self.active_index[lane] = self.next_active - 1;
            self.busy_lanes |= 1 << lane;
            return;
        }
    }

    /// Advances every ray in an empty cube to the cube's exit. Returns the rays' old positions, and
    /// the bits of lanes whose rays are at their end or in an occupied cell.
    #[inline(always)]
    fn advance<K: RayKind>(&mut self) -> (LanePositions, u32) {
        let March { occupancy, step, .. } = *self.march;
        let LaneRays { offset, enter, .. } = &self.rays;
        let mut t = [0.0; LANES];
        for i in 0..LANES {
            // Through i32, since AVX2 cannot convert u32.
            t[i] = (self.k[i] as i32 as f32 + offset[i]).mul_add(step, enter[i]);
        }
        let positions = K::positions(&self.rays, &t);
        let [x, y, z] = &positions;
        let cells = [cells_along(x), cells_along(y), cells_along(z)];
        let lane_positions = LanePositions { t, positions, cells };
        let log2_sides = occupancy.empty_cube_log2_sides(&lane_positions.cells);
        // Exits of occupied cells aren't used.
        let masked = log2_sides.map(|log2_side| log2_side & LOG2_SIDE_MASK);
        let exits = K::exits(&self.rays, &lane_positions, &masked);
        let mut stops = 0;
        for i in 0..LANES {
            let exit_step = ceil_steps((exits[i] - enter[i]).mul_add(1.0 / step, -offset[i]));
            let stop =
                (lane_positions.t[i] >= self.occupied_until[i]) | (log2_sides[i] == OCCUPIED);
            self.k[i] = if stop { self.k[i] } else { exit_step.max(self.k[i] + 1) };
            stops |= u32::from(stop) << i;
        }
        (lane_positions, stops & self.busy_lanes)
    }

    /// Stores the sample of a lane's current step and advances the ray by a step. With double
    /// strides, only even-numbered steps have a sample. Returns whether the ray may have more
    /// samples in this round.
    #[inline(always)]
    fn take_sample(
        &mut self,
        lane: usize,
        lane_positions: &LanePositions,
        samples: &mut MarchedSamples,
    ) -> bool {
        let March { occupancy, step, strides, .. } = *self.march;
        let (k, active_index) = (self.k[lane], self.active_index[lane]);
        self.k[lane] += 1;
        let cell = [0, 1, 2].map(|axis| lane_positions.cells[axis][lane] as usize);
        if strides.are_double_in(occupancy.is_thin(cell)) {
            let LaneRays { offset, enter, leave, .. } = &self.rays;
            let middle = (k as f32 + offset[lane] + 0.5).mul_add(step, enter[lane]);
            if k & 1 == 0 && middle < leave[lane] {
                samples.slots.put(active_index, middle, 2.0);
            }
        } else {
            samples.slots.put(active_index, lane_positions.t[lane], 1.0);
        }
        samples.slots.counts[active_index] < self.max_samples
    }
}

/// Returns the cells along one axis. Called once per axis: in a loop over the axes, the compiler
/// would vectorise across axes instead of lanes.
#[inline(always)]
fn cells_along(positions: &[f32; LANES]) -> [u32; LANES] {
    let mut cells = [0; LANES];
    for i in 0..LANES {
        cells[i] = cell_along(positions[i]);
    }
    cells
}

/// Maximum step number: the largest number that [`floor`] takes.
const MAX_STEPS: f32 = 4_194_304.0;

/// Rounds a number of steps up; 0 for NaN.
#[inline(always)]
pub(super) fn ceil_steps(steps: f32) -> u32 {
    let steps = steps.max(0.0).min(MAX_STEPS);
    let (below, step) = floor(steps);
    step + u32::from(steps > below)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_rounded_up_exactly() {
        for (steps, expected) in [
            (f32::NAN, 0),
            (f32::NEG_INFINITY, 0),
            (-0.5, 0),
            (0.0, 0),
            (1e-9, 1),
            (6.5, 7),
            (7.0, 7),
            (4_194_303.5, 4_194_304),
            (1e9, 4_194_304),
            (f32::INFINITY, 4_194_304),
        ] {
            assert_eq!(ceil_steps(steps), expected, "{steps}");
        }
    }
}

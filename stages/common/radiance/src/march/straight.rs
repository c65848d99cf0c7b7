//! Straight rays march side by side, a lane each. A leap needs the result of the leap before: a ray
//! alone would wait at each.

use super::marched::{DONE, March, Marched};
use super::steps::{first_step, whole};
use crate::occupancy::OCCUPIED;
use crate::simd::LANES;
use crate::spec::OCCUPANCY_CELLS as GRID;

/// The bits of an empty cube's size: shifts below 32 vectorise without a check. The exit of an
/// occupied cell isn't used.
const SIZE_BITS: u32 = 7;

/// Rays in lanes, and where their marches stand.
struct SideBySide<'a> {
    march: &'a March<'a>,
    /// Most samples of a ray.
    most: usize,
    /// Rays to march, and how many of them had their turn to get a lane.
    active: &'a [u32],
    begun: usize,
    /// Lanes that have a ray: a bit each.
    taken: u32,
    /// Place of each lane's ray among the active ones.
    place: [usize; LANES],
    /// An array an axis.
    origin: [[f32; LANES]; 3],
    direction: [[f32; LANES]; 3],
    /// 1 over the direction.
    inverse: [[f32; LANES]; 3],
    offset: [f32; LANES],
    enter: [f32; LANES],
    leave: [f32; LANES],
    /// Behind this t there is nothing.
    until: [f32; LANES],
    /// The next step.
    k: [u32; LANES],
}

/// Where the rays of all lanes are.
struct Places {
    t: [f32; LANES],
    /// An array an axis.
    cells: [[u32; LANES]; 3],
}

impl Places {
    #[inline(always)]
    fn cell(&self, lane: usize) -> [usize; 3] {
        [0, 1, 2].map(|axis| self.cells[axis][lane] as usize)
    }
}

/// The cells along an axis where rays are at t.
#[inline(always)]
fn cells_along(
    origin: &[f32; LANES],
    direction: &[f32; LANES],
    t: &[f32; LANES],
    cells: &mut [u32; LANES],
) {
    for i in 0..LANES {
        let p = direction[i].mul_add(t[i], origin[i]);
        cells[i] = whole(p * GRID as f32, GRID as f32 - 1.0);
    }
}

/// Marches straight rays on, see [`super::march`].
#[inline(always)]
pub(super) fn march(
    march: &March<'_>,
    most: usize,
    active: &[u32],
    next: &mut [u32],
    samples: &mut Marched,
) {
    samples.slots.begin(active.len(), most);
    let mut rays = SideBySide::new(march, most, active);
    (0..LANES).for_each(|lane| rays.seat(lane, next));
    while rays.taken != 0 {
        let (places, mut stops) = rays.advance();
        while stops != 0 {
            let lane = stops.trailing_zeros() as usize;
            stops &= stops - 1;
            let r = active[rays.place[lane]] as usize;
            if places.t[lane] >= rays.until[lane] {
                next[r] = DONE;
            } else if rays.sample(lane, &places, samples) {
                continue;
            } else {
                next[r] = rays.k[lane];
            }
            rays.seat(lane, next);
        }
    }
    samples.take_slots(march.rays, active);
}

impl<'a> SideBySide<'a> {
    #[inline(always)]
    fn new(march: &'a March<'a>, most: usize, active: &'a [u32]) -> Self {
        let (row, rows) = ([0.0; LANES], [[0.0; LANES]; 3]);
        Self {
            march,
            most,
            active,
            begun: 0,
            taken: 0,
            place: [0; LANES],
            origin: rows,
            direction: rows,
            inverse: rows,
            offset: row,
            enter: row,
            leave: row,
            until: row,
            k: [0; LANES],
        }
    }

    /// Gives a lane the next of the active rays that has anything before it.
    #[inline(always)]
    fn seat(&mut self, lane: usize, next: &mut [u32]) {
        self.taken &= !(1 << lane);
        while let Some(&r) = self.active.get(self.begun) {
            let (ray, offset) = (&self.march.rays[r as usize], self.march.offsets[r as usize]);
            let inverse = ray.direction.map(|d| 1.0 / d);
            self.begun += 1;
            let Some([from, until]) = self.march.occupancy.crossing(ray, &inverse) else {
                next[r as usize] = DONE;
                continue;
            };
            for axis in 0..3 {
                self.origin[axis][lane] = ray.origin[axis];
                self.direction[axis][lane] = ray.direction[axis];
                self.inverse[axis][lane] = inverse[axis];
            }
            self.offset[lane] = offset;
            (self.enter[lane], self.leave[lane], self.until[lane]) = (ray.enter, ray.leave, until);
            let first = first_step((from - ray.enter).mul_add(1.0 / self.march.step, -offset));
            self.k[lane] = first.max(next[r as usize]);
            self.place[lane] = self.begun - 1;
            self.taken |= 1 << lane;
            return;
        }
    }

    /// Takes every ray that is in an empty cube out of it; gives where rays were, and the lanes
    /// whose rays have come to their end or to an occupied cell: a bit each.
    #[inline(always)]
    fn advance(&mut self) -> (Places, u32) {
        let March { occupancy, step, .. } = *self.march;
        let mut places = Places { t: [0.0; LANES], cells: [[0; LANES]; 3] };
        for i in 0..LANES {
            // By way of i32, since AVX2 converts no u32.
            places.t[i] = (self.k[i] as i32 as f32 + self.offset[i]).mul_add(step, self.enter[i]);
        }
        // A call an axis: of a loop over axes the compiler makes vectors of axes.
        let [x, y, z] = &mut places.cells;
        cells_along(&self.origin[0], &self.direction[0], &places.t, x);
        cells_along(&self.origin[1], &self.direction[1], &places.t, y);
        cells_along(&self.origin[2], &self.direction[2], &places.t, z);
        let sizes = occupancy.empty_around(&places.cells);
        let mut exit = [f32::INFINITY; LANES];
        self.leave_along(0, &places, &sizes, &mut exit);
        self.leave_along(1, &places, &sizes, &mut exit);
        self.leave_along(2, &places, &sizes, &mut exit);
        let mut stops = 0;
        for i in 0..LANES {
            let leap = first_step((exit[i] - self.enter[i]).mul_add(1.0 / step, -self.offset[i]));
            let stop = (places.t[i] >= self.until[i]) | (sizes[i] == OCCUPIED);
            self.k[i] = if stop { self.k[i] } else { leap.max(self.k[i] + 1) };
            stops |= u32::from(stop) << i;
        }
        (places, stops & self.taken)
    }

    /// Shortens `exit`, the t at which rays leave their empty cubes, to where they leave along an
    /// axis.
    #[inline(always)]
    fn leave_along(
        &self,
        axis: usize,
        places: &Places,
        sizes: &[u32; LANES],
        exit: &mut [f32; LANES],
    ) {
        let (origin, direction) = (&self.origin[axis], &self.direction[axis]);
        let (inverse, cells) = (&self.inverse[axis], &places.cells[axis]);
        for i in 0..LANES {
            let size = sizes[i] & SIZE_BITS;
            let side = if direction[i] > 0.0 { 1 << size } else { 0 };
            let face = ((cells[i] >> size << size) + side) as i32 as f32 / GRID as f32;
            let until = (face - origin[i]) * inverse[i];
            exit[i] = if direction[i] != 0.0 && until < exit[i] { until } else { exit[i] };
        }
    }

    /// Takes a lane's ray a step on, and the sample that its strides have there; whether it may
    /// take more.
    #[inline(always)]
    fn sample(&mut self, lane: usize, places: &Places, samples: &mut Marched) -> bool {
        let March { occupancy, step, strides, .. } = *self.march;
        let (k, place) = (self.k[lane], self.place[lane]);
        self.k[lane] += 1;
        if strides.are_double_in(occupancy.is_thin(places.cell(lane))) {
            let middle = (k as f32 + self.offset[lane] + 0.5).mul_add(step, self.enter[lane]);
            if k & 1 == 0 && middle < self.leave[lane] {
                samples.slots.put(place, middle, 2.0);
            }
        } else {
            samples.slots.put(place, places.t[lane], 1.0);
        }
        samples.slots.counts[place] < self.most
    }
}

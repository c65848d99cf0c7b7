//! Rays march side by side, a lane each. A leap needs the result of the leap before: a ray alone
//! would wait at each.

use super::marched::{DONE, March, Marched};
use super::steps::first_step;
use crate::occupancy::{OCCUPIED, Occupancy, cell_along};
use crate::ray::NormalizedRay;
use crate::simd::LANES;

/// How rays of a kind move through the unit cube, for all lanes at once.
pub(super) trait RayKind {
    /// From which t to which a ray may meet something; `None` where it meets nothing. `inverse` is
    /// 1 over its direction.
    fn crossing(occupancy: &Occupancy, ray: &NormalizedRay, inverse: &[f32; 3])
    -> Option<[f32; 2]>;

    /// The place of one ray at t.
    fn position(ray: &NormalizedRay, t: f32) -> [f32; 3];

    /// Coordinates of the places at t: an array an axis.
    fn positions(rays: &LaneRays, t: &[f32; LANES]) -> [[f32; LANES]; 3];

    /// A t at which each ray leaves the empty cube of 2^size cells a side around its place, or at
    /// which it is still inside.
    fn exits(rays: &LaneRays, places: &Places, sizes: &[u32; LANES]) -> [f32; LANES];
}

/// The bits of an empty cube's size: shifts below 32 vectorise without a check.
const SIZE_BITS: u32 = 7;

/// The rays of all lanes.
pub(super) struct LaneRays {
    /// An array an axis.
    pub(super) origin: [[f32; LANES]; 3],
    pub(super) direction: [[f32; LANES]; 3],
    /// 1 over the direction.
    pub(super) inverse: [[f32; LANES]; 3],
    /// Ball radii of a bent ray's map.
    pub(super) radii: [f32; LANES],
    offset: [f32; LANES],
    enter: [f32; LANES],
    leave: [f32; LANES],
}

/// Where the rays of all lanes are.
pub(super) struct Places {
    pub(super) t: [f32; LANES],
    /// An array an axis.
    pub(super) positions: [[f32; LANES]; 3],
    pub(super) cells: [[u32; LANES]; 3],
}

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
    rays: LaneRays,
    /// Behind this t there is nothing.
    until: [f32; LANES],
    /// The next step.
    k: [u32; LANES],
}

/// Marches rays on, see [`super::march`].
#[inline(always)]
pub(super) fn march<K: RayKind>(
    march: &March<'_>,
    most: usize,
    active: &[u32],
    next: &mut [u32],
    samples: &mut Marched,
) {
    samples.slots.begin(active.len(), most);
    let mut lanes = SideBySide::new(march, most, active);
    (0..LANES).for_each(|lane| lanes.seat::<K>(lane, next));
    while lanes.taken != 0 {
        let (places, mut stops) = lanes.advance::<K>();
        while stops != 0 {
            let lane = stops.trailing_zeros() as usize;
            stops &= stops - 1;
            let r = active[lanes.place[lane]] as usize;
            if places.t[lane] >= lanes.until[lane] {
                next[r] = DONE;
            } else if lanes.sample(lane, &places, samples) {
                continue;
            } else {
                next[r] = lanes.k[lane];
            }
            lanes.seat::<K>(lane, next);
        }
    }
    take_slots::<K>(march.rays, active, samples);
}

/// Appends what the slots hold, ray by ray.
#[inline(always)]
fn take_slots<K: RayKind>(rays: &[NormalizedRay], active: &[u32], samples: &mut Marched) {
    for (place, &r) in active.iter().enumerate() {
        samples.starts.push(samples.t.len());
        for slot in 0..samples.slots.counts[place] {
            let [t, length] = samples.slots.sample(place, slot);
            samples.push(t, length, K::position(&rays[r as usize], t));
        }
    }
}

impl LaneRays {
    #[inline(always)]
    fn new() -> Self {
        let (row, rows) = ([0.0; LANES], [[0.0; LANES]; 3]);
        Self {
            origin: rows,
            direction: rows,
            inverse: rows,
            radii: row,
            offset: row,
            enter: row,
            leave: row,
        }
    }

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

impl<'a> SideBySide<'a> {
    #[inline(always)]
    fn new(march: &'a March<'a>, most: usize, active: &'a [u32]) -> Self {
        Self {
            march,
            most,
            active,
            begun: 0,
            taken: 0,
            place: [0; LANES],
            rays: LaneRays::new(),
            until: [0.0; LANES],
            k: [0; LANES],
        }
    }

    /// Gives a lane the next of the active rays that has anything before it.
    #[inline(always)]
    fn seat<K: RayKind>(&mut self, lane: usize, next: &mut [u32]) {
        self.taken &= !(1 << lane);
        while let Some(&r) = self.active.get(self.begun) {
            let (ray, offset) = (&self.march.rays[r as usize], self.march.offsets[r as usize]);
            let inverse = ray.direction.map(|d| 1.0 / d);
            self.begun += 1;
            let Some([from, until]) = K::crossing(self.march.occupancy, ray, &inverse) else {
                next[r as usize] = DONE;
                continue;
            };
            self.rays.set(lane, ray, inverse, offset);
            self.until[lane] = until;
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
    fn advance<K: RayKind>(&mut self) -> (Places, u32) {
        let March { occupancy, step, .. } = *self.march;
        let LaneRays { offset, enter, .. } = &self.rays;
        let mut t = [0.0; LANES];
        for i in 0..LANES {
            // By way of i32, since AVX2 converts no u32.
            t[i] = (self.k[i] as i32 as f32 + offset[i]).mul_add(step, enter[i]);
        }
        let positions = K::positions(&self.rays, &t);
        let [x, y, z] = &positions;
        let cells = [cells_along(x), cells_along(y), cells_along(z)];
        let places = Places { t, positions, cells };
        let sizes = occupancy.empty_around(&places.cells);
        // Exits of occupied cells aren't used.
        let exits = K::exits(&self.rays, &places, &sizes.map(|size| size & SIZE_BITS));
        let mut stops = 0;
        for i in 0..LANES {
            let leap = first_step((exits[i] - enter[i]).mul_add(1.0 / step, -offset[i]));
            let stop = (places.t[i] >= self.until[i]) | (sizes[i] == OCCUPIED);
            self.k[i] = if stop { self.k[i] } else { leap.max(self.k[i] + 1) };
            stops |= u32::from(stop) << i;
        }
        (places, stops & self.taken)
    }

    /// Takes a lane's ray a step on, and the sample that its strides have there; whether it may
    /// take more.
    #[inline(always)]
    fn sample(&mut self, lane: usize, places: &Places, samples: &mut Marched) -> bool {
        let March { occupancy, step, strides, .. } = *self.march;
        let (k, place) = (self.k[lane], self.place[lane]);
        self.k[lane] += 1;
        let cell = [0, 1, 2].map(|axis| places.cells[axis][lane] as usize);
        if strides.are_double_in(occupancy.is_thin(cell)) {
            let LaneRays { offset, enter, leave, .. } = &self.rays;
            let middle = (k as f32 + offset[lane] + 0.5).mul_add(step, enter[lane]);
            if k & 1 == 0 && middle < leave[lane] {
                samples.slots.put(place, middle, 2.0);
            }
        } else {
            samples.slots.put(place, places.t[lane], 1.0);
        }
        samples.slots.counts[place] < self.most
    }
}

/// The cells along an axis. A call an axis: of a loop over axes the compiler makes vectors of axes.
#[inline(always)]
fn cells_along(positions: &[f32; LANES]) -> [u32; LANES] {
    let mut cells = [0; LANES];
    for i in 0..LANES {
        cells[i] = cell_along(positions[i]);
    }
    cells
}

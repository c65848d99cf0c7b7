//! Which cells of the unit cube may hold something: what rays skip by.

use counter_rng::CounterRng;
use rayon::prelude::*;
use scene::Bounds;

use crate::ray::{FASTEST, NormalizedRay, RayMap};
use crate::simd::kernel;

/// Cells along each axis.
pub(crate) const GRID: usize = 128;
/// Cells in all.
pub(crate) const CELLS: usize = GRID * GRID * GRID;
/// A word holds 4³ of what is below it: cells in a brick, bricks in a block.
const SIDE: usize = 4;
/// Bricks and blocks along each axis.
const BRICKS: usize = GRID / SIDE;
const BLOCKS: usize = BRICKS / SIDE;

/// Which word of a level and which bit in it belong to a place.
#[inline(always)]
fn place([x, y, z]: [usize; 3], words: usize) -> (usize, usize) {
    let word = x / SIDE + words * (y / SIDE + words * (z / SIDE));
    (word, x % SIDE + SIDE * (y % SIDE + SIDE * (z % SIDE)))
}

/// Steps of a training between looks at the occupancy.
const EVERY: u64 = 16;
/// Until this step every cell is looked at; later those that are occupied, and of the others one in so many.
const WARM_UP: u64 = 256;
const TURNS: usize = 16;
/// Share of a density that is left at the next look.
const DECAY: f32 = 0.95;

/// Which cell along each axis a number means.
fn corner(cell: usize) -> [usize; 3] {
    [cell % GRID, cell / GRID % GRID, cell / (GRID * GRID)]
}

/// A slowly decaying maximum of the density seen in each cell, and the cells where it counts: 128³ over the unit cube, x fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct Occupancy {
    density: Vec<f32>,
    /// Cells that may be occupied at all.
    hull: Option<Vec<bool>>,
    /// A bit a cell, and a bit a brick that isn't empty.
    bricks: Vec<u64>,
    blocks: Vec<u64>,
}

impl Occupancy {
    /// Everything may be occupied.
    pub fn full() -> Self {
        let mut full = Self { density: vec![0.0; CELLS], hull: None, bricks: Vec::new(), blocks: Vec::new() };
        full.set(|_| true);
        full
    }

    /// Limits it to a visual hull: 128³ cells over the field's box, x fastest, 0 where nothing can be.
    pub fn limit_to_hull(&mut self, bounds: &Bounds, hull: &[u8]) {
        let side = bounds.longest_side();
        // The occupancy covers the cube of the longest side, the hull the box.
        let covered = |axis: usize, cell: usize| {
            let scale = side / (bounds.max[axis] - bounds.min[axis]);
            let low = (cell as f64 * scale) as usize;
            let high = ((cell + 1) as f64 * scale).ceil() as usize;
            low.min(GRID)..high.min(GRID)
        };
        let kept = |cell: usize| {
            let [x, y, z] = corner(cell);
            covered(2, z).any(|k| covered(1, y).any(|j| covered(0, x).any(|i| hull[i + GRID * (j + GRID * k)] != 0)))
        };
        let mask = (0..CELLS).into_par_iter().map(kept).collect();
        self.limit_to(mask);
    }

    /// Limits it to the cells that are occupied and those around them: for a training that goes on where the rest is known to be empty.
    pub(crate) fn limit_to_occupied(&mut self) {
        let around = |c: usize| c.saturating_sub(1)..=(c + 1).min(GRID - 1);
        let kept = |cell: usize| {
            let [x, y, z] = corner(cell);
            around(z).any(|k| around(y).any(|j| around(x).any(|i| self.is_occupied(i + GRID * (j + GRID * k)))))
        };
        let mask = (0..CELLS).into_par_iter().map(kept).collect();
        self.limit_to(mask);
    }

    /// Limits it to cells, besides what limits it already; all that is left may be occupied.
    fn limit_to(&mut self, mut mask: Vec<bool>) {
        if let Some(hull) = &self.hull {
            mask.iter_mut().zip(hull).for_each(|(kept, hull)| *kept &= hull);
        }
        self.set(|cell| mask[cell]);
        self.hull = Some(mask);
    }

    /// Cells to look at, at a step of a training: none at most of them.
    pub fn cells_to_update(&self, step: u64) -> Vec<u32> {
        if step == 0 || !step.is_multiple_of(EVERY) {
            return Vec::new();
        }
        let turn = (step / EVERY) as usize % TURNS;
        let is_looked_at = |&cell: &u32| {
            let cell = cell as usize;
            let allowed = self.hull.as_ref().is_none_or(|h| h[cell]);
            let [.., z] = corner(cell);
            let wanted = step <= WARM_UP || self.is_occupied(cell) || (cell % (GRID * GRID) + z) % TURNS == turn;
            allowed && wanted
        };
        (0..CELLS as u32).into_par_iter().filter(is_looked_at).collect()
    }

    /// Where in a cell to look at that step, in the unit cube.
    pub fn place_in(cell: u32, seed: u64, step: u64) -> [f32; 3] {
        let mut rng = CounterRng::new(seed, 3, step * CELLS as u64 + u64::from(cell));
        corner(cell as usize).map(|c| (c as f32 + rng.uniform()) / GRID as f32)
    }

    /// Takes the densities that were found in cells, and decides anew which cells may hold something, for rays with samples so far apart in
    /// the cube.
    pub fn update(&mut self, cells: &[u32], densities: &[f32], step: f32) {
        if cells.is_empty() {
            return;
        }
        for (&cell, &found) in cells.iter().zip(densities) {
            let density = &mut self.density[cell as usize];
            *density = (*density * DECAY).max(found);
        }
        let possible = self.hull.as_ref().map_or(CELLS, |h| h.iter().filter(|k| **k).count()).max(1);
        let mean = (self.density.iter().map(|&d| f64::from(d)).sum::<f64>() / possible as f64) as f32;
        // A hundredth of a step's light is worth a sample; while all is semi-transparent, only what is denser than the mean.
        let threshold = mean.min(0.01 / step);
        let allowed = |cell: usize| self.hull.as_ref().is_none_or(|h| h[cell]);
        let occupied: Vec<bool> = self.density.iter().enumerate().map(|(i, &d)| d >= threshold && allowed(i)).collect();
        self.set(|cell| occupied[cell]);
    }

    /// Whether a cell may hold something.
    pub(crate) fn is_occupied(&self, cell: usize) -> bool {
        let (word, bit) = place(corner(cell), BRICKS);
        self.bricks[word] >> bit & 1 == 1
    }

    /// Sets every cell anew.
    pub(crate) fn set(&mut self, occupied: impl Fn(usize) -> bool) {
        self.bricks = vec![0; BRICKS * BRICKS * BRICKS];
        self.blocks = vec![0; BLOCKS * BLOCKS * BLOCKS];
        for cell in 0..CELLS {
            if occupied(cell) {
                let at = corner(cell);
                let (word, bit) = place(at, BRICKS);
                self.bricks[word] |= 1 << bit;
                let (word, bit) = place(at.map(|c| c / SIDE), BLOCKS);
                self.blocks[word] |= 1 << bit;
            }
        }
    }

    /// Cells that are occupied, in order.
    pub(crate) fn cells(&self) -> impl Iterator<Item = usize> + '_ {
        (0..CELLS).filter(|&cell| self.is_occupied(cell))
    }

    /// The density of each cell.
    pub fn density(&self) -> &[f32] {
        &self.density
    }

    /// Goes on with the densities and the cells of a checkpoint.
    pub fn restore(&mut self, density: Vec<f32>, occupied: &[u8]) {
        self.density = density;
        self.set(|cell| occupied[cell] != 0);
    }

    /// Cells as bytes, 1 where occupied, for a file.
    pub fn to_bytes(&self) -> Vec<u8> {
        (0..CELLS).map(|cell| u8::from(self.is_occupied(cell))).collect()
    }
}

/// Where a ray's march stands: the number of its next step; [`DONE`] once it has left the box.
pub(crate) const DONE: u32 = u32::MAX;

kernel! {
    /// Marches on: at most `most` more samples of each of the `active` rays, wherever a cell is occupied, at t =
    /// enter + (k + offset)·step. `next` is each ray's k, from 0 to [`DONE`]. Appends t and positions; `starts` gets
    /// the first sample of each active ray, and the end.
    pub(crate) fn march<L>(
        occupancy: &Occupancy, rays: &[NormalizedRay], offsets: &[f32], step: f32, most: usize, active: &[u32], next: &mut [u32],
        t: &mut Vec<f32>, positions: &mut Vec<[f32; 3]>, starts: &mut Vec<usize>,
    ) {
        let last = GRID as f32 - 1.0;
        let per_step = 1.0 / step;
        for &r in active {
            starts.push(t.len());
            let (ray, offset) = (&rays[r as usize], offsets[r as usize]);
            let inverse = ray.direction.map(|d| 1.0 / d);
            let mut k = next[r as usize];
            let mut left = most;
            while left > 0 {
                let at = (k as f32 + offset).mul_add(step, ray.enter);
                if at >= ray.leave {
                    k = DONE;
                    break;
                }
                let p = ray.position(at);
                let cell = p.map(|x| (x * GRID as f32).max(0.0).min(last) as i32 as usize);
                let brick = cell.map(|c| c / SIDE);
                let (block_word, brick_bit) = place(brick, BLOCKS);
                let (brick_word, cell_bit) = place(cell, BRICKS);
                let bricks = occupancy.blocks[block_word];
                let (low, size) = if bricks == 0 {
                    (brick.map(|b| b / SIDE * (SIDE * SIDE)), SIDE * SIDE)
                } else if bricks >> brick_bit & 1 == 0 {
                    (brick.map(|b| b * SIDE), SIDE)
                } else if occupancy.bricks[brick_word] >> cell_bit & 1 == 0 {
                    (cell, 1)
                } else {
                    t.push(at);
                    positions.push(p);
                    k += 1;
                    left -= 1;
                    continue;
                };
                // Where the ray leaves this empty cell or block; at least one step on.
                let mut exit = f32::INFINITY;
                if let RayMap::Straight { .. } = ray.map {
                    for i in 0..3 {
                        let face = if ray.direction[i] > 0.0 { low[i] + size } else { low[i] } as f32 / GRID as f32;
                        let until = (face - ray.origin[i]) * inverse[i];
                        if ray.direction[i] != 0.0 && until < exit {
                            exit = until;
                        }
                    }
                } else {
                    // No sooner than the nearest face can be reached.
                    for i in 0..3 {
                        let (below, above) = (low[i] as f32 / GRID as f32, (low[i] + size) as f32 / GRID as f32);
                        exit = exit.min((p[i] - below).min(above - p[i]));
                    }
                    exit = (1.0 / FASTEST).mul_add(exit, at);
                }
                let onwards = (exit - ray.enter).mul_add(per_step, -offset).ceil();
                // `as` saturates: an exit that is NaN or infinite moves on by one step.
                k = (k + 1).max(if onwards.is_finite() { onwards as u32 } else { 0 });
            }
            next[r as usize] = k;
        }
        starts.push(t.len());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use counter_rng::CounterRng;

    #[test]
    fn skipping_loses_no_sample() {
        let mut occupancy = Occupancy::full();
        occupancy.set(|cell| (cell / 7) % 11 == 0 && cell % GRID > 40);
        let step = 3.0f32.sqrt() / 512.0;
        for seed in 0..200 {
            let mut rng = CounterRng::new(1, 2, seed);
            let mut unit = || rng.uniform();
            let origin = [unit(), unit(), unit()];
            let d = [unit() - 0.5, unit() - 0.5, if seed % 5 == 0 { 0.0 } else { unit() - 0.5 }];
            let length = d.iter().map(|x| x * x).sum::<f32>().sqrt();
            let direction = d.map(|x| x / length);
            let leave = (0..3)
                .filter(|&i| direction[i] != 0.0)
                .map(|i| (if direction[i] > 0.0 { 1.0 - origin[i] } else { -origin[i] }) / direction[i])
                .fold(f32::INFINITY, f32::min);
            let ray = NormalizedRay { origin, direction, leave, ..NormalizedRay::default() };
            let mut found = Vec::new();
            // In parts, as the renderer does.
            let (mut next, mut positions) = ([0], Vec::new());
            while next[0] != DONE {
                march(&occupancy, &[ray], &[0.3], step, 5, &[0], &mut next, &mut found, &mut positions, &mut Vec::new());
            }
            let all = (0..2000).map(|k| (k as f32 + 0.3).mul_add(step, 0.0)).take_while(|t| *t < leave);
            let expected: Vec<f32> = all
                .filter(|&t| {
                    let c: Vec<usize> =
                        (0..3).map(|i| (direction[i].mul_add(t, origin[i]) * 128.0).max(0.0).min(127.0) as usize).collect();
                    occupancy.is_occupied(c[0] + GRID * (c[1] + GRID * c[2]))
                })
                .collect();
            // Rounding at a face may move one sample in a thousand across it.
            let missing = expected.iter().filter(|t| !found.contains(t)).count();
            assert!(missing * 100 <= expected.len(), "{missing} of {} lost", expected.len());
            assert!(found.iter().all(|t| expected.contains(t)));
        }
    }

    /// What goes on stays in the cells that were occupied and their neighbours, whatever density is found elsewhere, and within a visual hull.
    #[test]
    fn going_on_stays_where_something_was() {
        let mut occupancy = Occupancy::full();
        let cell = |x: usize, y: usize, z: usize| x + GRID * (y + GRID * z);
        let (inside, corner) = (cell(5, 60, 70), cell(0, GRID - 1, 0));
        occupancy.set(|c| c == inside || c == corner);
        occupancy.limit_to_occupied();
        assert_eq!(occupancy.cells().count(), 27 + 8);
        let mut hull = vec![1; CELLS];
        hull[cell(6, 61, 71)] = 0;
        occupancy.limit_to_hull(&Bounds { max: [1.0; 3], ..Bounds::default() }, &hull);
        assert_eq!(occupancy.cells().count(), 26 + 8);
        let all: Vec<u32> = (0..CELLS as u32).collect();
        assert_eq!(occupancy.cells_to_update(EVERY).len(), 26 + 8);
        occupancy.update(&all, &vec![1e3; CELLS], 0.003);
        assert_eq!(occupancy.cells().count(), 26 + 8);
    }

    #[test]
    fn cells_are_those_set() {
        let mut occupancy = Occupancy::full();
        assert_eq!(occupancy.cells().count(), GRID * GRID * GRID);
        occupancy.set(|cell| cell % 1000 == 3);
        assert!(occupancy.cells().eq((0..GRID * GRID * GRID).filter(|c| c % 1000 == 3)));
    }
}

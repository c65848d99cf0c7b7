//! Which cells of the unit cube may hold something: what rays skip by, and where they take fewer
//! samples.

use counter_rng::CounterRng;
use rayon::prelude::*;

use crate::math::floor;
use crate::ray::NormalizedRay;
use crate::spec::{EMPTY, OCCUPANCY_CELLS as GRID, THIN};
use crate::strides::Strides;

/// Cells in all.
pub(crate) const CELLS: usize = GRID * GRID * GRID;
/// A word holds 4³ of what is below it: cells in a brick, bricks in a block.
pub(crate) const SIDE: usize = 4;
/// Bricks and blocks along each axis.
const BRICKS: usize = GRID / SIDE;
const BLOCKS: usize = BRICKS / SIDE;

/// Which word of a level and which bit in it belong to a place.
#[inline(always)]
fn place(at: [usize; 3], words: usize) -> (usize, u32) {
    let (word, bit) = place_of_lane(at.map(|c| c as u32), words);
    (word as usize, bit)
}

/// The same in 32 bits, so that it vectorises.
#[inline(always)]
fn place_of_lane([x, y, z]: [u32; 3], words: usize) -> (u32, u32) {
    let (words, side) = (words as u32, SIDE as u32);
    let word = x / side + words * (y / side + words * (z / side));
    (word, x % side + side * (y % side + side * (z % side)))
}

/// Steps of a training between updates of the occupancy.
const STEPS_PER_UPDATE: u64 = 32;
/// An update looks at one occupied cell in so many, and at one empty cell in so many.
const OCCUPIED_TURNS: usize = 4;
const EMPTY_TURNS: usize = 16;
/// Until this step empty cells are looked at as often as occupied ones.
const WARM_UP_STEPS: u64 = 512;
/// By this step each cell has been looked at.
const KNOWN_FROM: u64 = STEPS_PER_UPDATE * OCCUPIED_TURNS as u64;
/// Share of a density that is left when its cell is looked at again.
const KEPT_SHARE: f32 = 0.7;

/// Which cell along each axis of `side` a number means.
#[inline(always)]
pub(crate) fn corner(cell: usize, side: usize) -> [usize; 3] {
    [cell % side, cell / side % side, cell / (side * side)]
}

/// A cell and the cells that share a side, an edge or a corner with it, in order.
pub(crate) fn around(cell: usize) -> impl Iterator<Item = usize> {
    let [xs, ys, zs] = corner(cell, GRID).map(|c| c.saturating_sub(1)..=(c + 1).min(GRID - 1));
    zs.flat_map(move |z| {
        let xs = xs.clone();
        ys.clone().flat_map(move |y| xs.clone().map(move |x| x + GRID * (y + GRID * z)))
    })
}

/// A word a brick: a bit for each cell that isn't empty, and one for each dense cell.
fn words(held: impl Fn(usize) -> Cell + Sync) -> (Vec<u64>, Vec<u64>) {
    let bricks = (0..BRICKS * BRICKS * BRICKS).into_par_iter().with_min_len(256);
    bricks.map(|brick| words_of(brick, &held)).unzip()
}

/// A brick's words.
fn words_of(brick: usize, held: impl Fn(usize) -> Cell) -> (u64, u64) {
    let first = corner(brick, BRICKS).map(|c| c * SIDE);
    let (mut occupied, mut dense) = (0, 0);
    for bit in 0..SIDE * SIDE * SIDE {
        let [x, y, z] = corner(bit, SIDE);
        let held = held(first[0] + x + GRID * (first[1] + y + GRID * (first[2] + z)));
        occupied |= u64::from(held != Cell::Empty) << bit;
        dense |= u64::from(held == Cell::Dense) << bit;
    }
    (occupied, dense)
}

/// The cell along each axis that a place of the unit cube lies in.
#[inline(always)]
pub(crate) fn cell_of(place: [f32; 3]) -> [usize; 3] {
    place.map(|coordinate| cell_along(coordinate) as usize)
}

/// The cell along one axis. A cast would saturate, and so not vectorise.
#[inline(always)]
pub(crate) fn cell_along(coordinate: f32) -> u32 {
    floor((coordinate * GRID as f32).max(0.0).min(GRID as f32 - 1.0)).1
}

/// A density that a ray has met in a cell, where it stops light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Met {
    /// Number of the cell.
    pub cell: u32,
    /// Density for a cube side.
    pub density: f32,
}

impl Met {
    /// At a place of the unit cube.
    #[inline(always)]
    pub fn at(place: [f32; 3], density: f32) -> Self {
        let [x, y, z] = cell_of(place);
        Self { cell: (x + GRID * (y + GRID * z)) as u32, density }
    }
}

/// Density of a cell that hasn't been looked at.
const UNKNOWN: f32 = -1.0;

/// What a cell holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Cell {
    /// Nothing: rays leap over it.
    Empty,
    /// Little ([`THIN`]): in training, rays take every other sample, of double length.
    Thin,
    /// Much, or what isn't known yet.
    Dense,
}

impl Cell {
    /// As a byte of a file.
    fn byte(self) -> u8 {
        match self {
            Self::Empty => 0,
            Self::Thin => 1,
            Self::Dense => 2,
        }
    }

    /// From a byte of a file.
    pub(crate) fn from_byte(byte: u8) -> Self {
        match byte {
            0 => Self::Empty,
            1 => Self::Thin,
            _ => Self::Dense,
        }
    }
}

/// A slowly decaying maximum of the density seen in each cell, and what it makes of the cell: 128³
/// over the unit cube, x fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct Occupancy {
    density: Vec<f32>,
    /// Cells that may be occupied at all.
    allowed: Option<Vec<bool>>,
    /// A bit a cell that isn't empty, and a bit a brick that isn't.
    bricks: Vec<u64>,
    blocks: Vec<u64>,
    /// A bit a dense cell.
    dense: Vec<u64>,
    /// Lowest and highest corner of the bricks that hold something, in the unit cube.
    extent: [[f32; 3]; 2],
}

impl Occupancy {
    /// Everything may be occupied.
    pub fn full() -> Self {
        let mut full = Self {
            density: vec![UNKNOWN; CELLS],
            allowed: None,
            bricks: Vec::new(),
            blocks: Vec::new(),
            dense: Vec::new(),
            extent: [[0.0; 3], [1.0; 3]],
        };
        full.set(|_| Cell::Dense);
        full
    }

    /// Limits it to the cells that are occupied and those around them: for a training that goes on
    /// where the rest is known to be empty.
    pub(crate) fn limit_to_occupied(&mut self) {
        let is_near = |cell: usize| around(cell).any(|near| self.is_occupied(near));
        let mask = (0..CELLS).into_par_iter().map(is_near).collect();
        self.limit_to(mask);
    }

    /// Limits it to cells, besides what limits it already; all that is left may be occupied.
    pub(crate) fn limit_to(&mut self, mut mask: Vec<bool>) {
        if let Some(allowed) = &self.allowed {
            mask.iter_mut().zip(allowed).for_each(|(kept, allowed)| *kept &= allowed);
        }
        self.set(|cell| if mask[cell] { Cell::Dense } else { Cell::Empty });
        self.allowed = Some(mask);
    }

    /// Cells to look at, at a step of a training: none at most of them.
    pub fn cells_to_update(&self, step: u64) -> Vec<u32> {
        if step == 0 || !step.is_multiple_of(STEPS_PER_UPDATE) {
            return Vec::new();
        }
        // Whoever has an empty cell's turn has an occupied one's, too: only those are gone through.
        const { assert!(EMPTY_TURNS.is_multiple_of(OCCUPIED_TURNS)) };
        const { assert!(GRID.is_multiple_of(OCCUPIED_TURNS)) };
        let turn = (step / STEPS_PER_UPDATE) as usize;
        let planes = (0..GRID).into_par_iter().flat_map_iter(|z| {
            let first = (turn + GRID - z) % OCCUPIED_TURNS;
            (z * GRID * GRID + first..(z + 1) * GRID * GRID).step_by(OCCUPIED_TURNS)
        });
        planes.filter(|&cell| self.is_looked_at(cell, step)).map(|cell| cell as u32).collect()
    }

    /// Whether to look at a cell at a step that looks at some.
    fn is_looked_at(&self, cell: usize, step: u64) -> bool {
        let turn = (step / STEPS_PER_UPDATE) as usize;
        let allowed = self.allowed.as_ref().is_none_or(|allowed| allowed[cell]);
        let [.., z] = corner(cell, GRID);
        let turns = if step <= WARM_UP_STEPS || self.is_occupied(cell) {
            OCCUPIED_TURNS
        } else {
            EMPTY_TURNS
        };
        let wanted = (cell % (GRID * GRID) + z) % turns == turn % turns;
        allowed && wanted
    }

    /// How rays take samples at a step of a training: until every cell is known, by double strides.
    /// A training that goes on from another's field knows where it is.
    pub fn strides(&self, step: u64) -> Strides {
        if step < KNOWN_FROM && self.allowed.is_none() { Strides::Double } else { Strides::ByCell }
    }

    /// Where in a cell to look at that step, in the unit cube.
    pub fn place_in(cell: u32, seed: u64, step: u64) -> [f32; 3] {
        let mut rng = CounterRng::new(seed, 3, step * CELLS as u64 + u64::from(cell));
        corner(cell as usize, GRID).map(|c| (c as f32 + rng.uniform()) / GRID as f32)
    }

    /// Takes the densities that were found in cells, and decides anew what every cell holds, for
    /// rays with samples so far apart in the cube.
    pub fn update(&mut self, cells: &[u32], densities: &[f32], step: f32) {
        if cells.is_empty() {
            return;
        }
        for (&cell, &found) in cells.iter().zip(densities) {
            let density = &mut self.density[cell as usize];
            *density = (*density * KEPT_SHARE).max(found);
        }
        let mean = self.mean_density();
        // A hundredth of a step's light is worth a sample; while all is semi-transparent, only what
        // is denser than the mean.
        let (empty, thin) = (mean.min(EMPTY / step), THIN / step);
        let allowed = |cell: usize| self.allowed.as_ref().is_none_or(|allowed| allowed[cell]);
        let (bricks, dense) = words(|cell| match self.density[cell] {
            _ if !allowed(cell) => Cell::Empty,
            d if d < 0.0 => self.cell(cell),
            d if d < empty => Cell::Empty,
            d if d < thin => Cell::Thin,
            _ => Cell::Dense,
        });
        self.set_words(bricks, dense);
    }

    /// Raises cells to densities that rays have met, for the next update. Cells that haven't been
    /// looked at count as dense anyway.
    pub fn keep(&mut self, met: &[Met]) {
        for &Met { cell, density } in met {
            let known = &mut self.density[cell as usize];
            if *known != UNKNOWN {
                *known = known.max(density);
            }
        }
    }

    /// Mean density of the cells that have been looked at; parts are summed in order.
    fn mean_density(&self) -> f32 {
        let parts: Vec<(f64, u32)> = (self.density.par_chunks(GRID * GRID))
            .map(|part| {
                let known = part.iter().filter(|density| **density >= 0.0);
                known.fold((0.0, 0), |(sum, count), &d| (sum + f64::from(d), count + 1))
            })
            .collect();
        let (sum, count) =
            parts.iter().fold((0.0, 0), |(sum, count), part| (sum + part.0, count + part.1));
        (sum / f64::from(count.max(1))) as f32
    }

    /// Whether a cell may hold something.
    pub(crate) fn is_occupied(&self, cell: usize) -> bool {
        let (word, bit) = place(corner(cell, GRID), BRICKS);
        self.bricks[word] >> bit & 1 == 1
    }

    /// What a cell holds.
    pub(crate) fn cell(&self, cell: usize) -> Cell {
        let (word, bit) = place(corner(cell, GRID), BRICKS);
        match (self.bricks[word] >> bit & 1, self.dense[word] >> bit & 1) {
            (0, _) => Cell::Empty,
            (_, 0) => Cell::Thin,
            _ => Cell::Dense,
        }
    }

    /// Sets every cell anew.
    pub(crate) fn set(&mut self, held: impl Fn(usize) -> Cell + Sync) {
        let (bricks, dense) = words(held);
        self.set_words(bricks, dense);
    }

    fn set_words(&mut self, bricks: Vec<u64>, dense: Vec<u64>) {
        self.blocks = vec![0; BLOCKS * BLOCKS * BLOCKS];
        let (mut low, mut high) = ([BRICKS; 3], [0; 3]);
        for brick in (0..bricks.len()).filter(|&brick| bricks[brick] != 0) {
            let at = corner(brick, BRICKS);
            let (word, bit) = place(at, BLOCKS);
            self.blocks[word] |= 1 << bit;
            for axis in 0..3 {
                low[axis] = low[axis].min(at[axis]);
                high[axis] = high[axis].max(at[axis] + 1);
            }
        }
        if low == [BRICKS; 3] {
            // Nothing: an extent without an inside.
            low = high;
        }
        self.extent = [low, high].map(|at| at.map(|brick| brick as f32 / BRICKS as f32));
        (self.bricks, self.dense) = (bricks, dense);
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
    pub fn restore(&mut self, density: Vec<f32>, cells: &[u8]) {
        self.density = density;
        self.set(|cell| Cell::from_byte(cells[cell]));
    }

    /// Cells as bytes for a file: 0 is empty, 1 thin, 2 dense.
    pub fn to_bytes(&self) -> Vec<u8> {
        (0..CELLS).map(|cell| self.cell(cell).byte()).collect()
    }
}

/// Stands for a cell that isn't empty, where [`Occupancy::empty_around`] gives a size.
pub(crate) const OCCUPIED: u32 = 8;

/// The first 2³ bits of a word's 4³. The other mask keeps, of a bit's number, what says in which
/// eighth the bit is.
const EIGHTH: u64 = 0x33_0033;
const FIRST_OF_EIGHTH: u32 = 0b10_1010;
/// How far outside the extent a ray may pass and still march, for an origin within the unit cube:
/// more than positions are rounded by.
const MARGIN: f32 = 1e-5;

impl Occupancy {
    /// The range of t in which a straight ray passes the bricks that hold something, a little
    /// widened; `None` where it passes beside. `inverse` is 1 over its direction.
    #[inline(always)]
    pub(crate) fn crossing(&self, ray: &NormalizedRay, inverse: &[f32; 3]) -> Option<[f32; 2]> {
        let [low, high] = self.extent;
        let (mut from, mut to) = (ray.enter, ray.leave);
        for axis in 0..3 {
            let (origin, slope) = (ray.origin[axis], ray.direction[axis]);
            let margin = MARGIN * (1.0 + origin.abs());
            let (low, high) = (low[axis] - margin, high[axis] + margin);
            if slope == 0.0 {
                if origin < low || origin > high {
                    return None;
                }
                continue;
            }
            let (a, b) = ((low - origin) * inverse[axis], (high - origin) * inverse[axis]);
            (from, to) = (from.max(a.min(b)), to.min(a.max(b)));
        }
        (from < to).then_some([from, to])
    }

    /// For each cell the size of the largest empty cube around it: 2^size cells a side, 0 to 4.
    /// [`OCCUPIED`] where the cell isn't empty. Cells are given by an array an axis.
    ///
    /// Written so that all but the loads vectorises.
    #[inline(always)]
    pub(crate) fn empty_around<const N: usize>(&self, cells: &[[u32; N]; 3]) -> [u32; N] {
        let [xs, ys, zs] = cells;
        let (mut bricks, mut cell_bits) = ([0; N], [0; N]);
        let (mut blocks, mut brick_bits) = ([0; N], [0; N]);
        let (mut words, mut sizes) = ([[0; N]; 2], [0; N]);
        for i in 0..N {
            let cell = [xs[i], ys[i], zs[i]];
            (bricks[i], cell_bits[i]) = place_of_lane(cell, BRICKS);
            (blocks[i], brick_bits[i]) = place_of_lane(cell.map(|c| c / SIDE as u32), BLOCKS);
        }
        for i in 0..N {
            words[0][i] = self.bricks[bricks[i] as usize];
            words[1][i] = self.blocks[blocks[i] as usize];
        }
        // No branches: which size comes next can't be predicted.
        for i in 0..N {
            let [cells, bricks] = [words[0][i], words[1][i]];
            let size = u32::from(cells & EIGHTH << (cell_bits[i] & FIRST_OF_EIGHTH) == 0)
                + u32::from(cells == 0)
                + u32::from(bricks & EIGHTH << (brick_bits[i] & FIRST_OF_EIGHTH) == 0)
                + u32::from(bricks == 0);
            sizes[i] = if cells >> cell_bits[i] & 1 == 1 { OCCUPIED } else { size };
        }
        sizes
    }

    /// Whether an occupied cell is thin.
    #[inline(always)]
    pub(crate) fn is_thin(&self, cell: [usize; 3]) -> bool {
        let (word, bit) = place(cell, BRICKS);
        self.dense[word] >> bit & 1 == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What goes on stays in the cells that were occupied and their neighbours, whatever density is
    /// found elsewhere, and within a mask.
    #[test]
    fn going_on_stays_where_something_was() {
        let mut occupancy = Occupancy::full();
        assert_eq!(occupancy.strides(KNOWN_FROM - 1), Strides::Double);
        assert_eq!(occupancy.strides(KNOWN_FROM), Strides::ByCell);
        let cell = |x: usize, y: usize, z: usize| x + GRID * (y + GRID * z);
        let (inside, corner) = (cell(5, 60, 70), cell(0, GRID - 1, 0));
        occupancy.set(|c| if c == inside || c == corner { Cell::Thin } else { Cell::Empty });
        occupancy.limit_to_occupied();
        assert_eq!(occupancy.cells().count(), 27 + 8);
        assert_eq!(occupancy.strides(0), Strides::ByCell);
        let mut mask = vec![true; CELLS];
        mask[cell(6, 61, 71)] = false;
        occupancy.limit_to(mask);
        assert_eq!(occupancy.cells().count(), 26 + 8);
        let all: Vec<u32> = (0..CELLS as u32).collect();
        let updates = (1..=OCCUPIED_TURNS as u64)
            .map(|turn| occupancy.cells_to_update(turn * STEPS_PER_UPDATE).len());
        assert_eq!(updates.sum::<usize>(), 26 + 8, "each once a round of turns");
        occupancy.update(&all, &vec![1e3; CELLS], 0.003);
        assert_eq!(occupancy.cells().count(), 26 + 8);
    }

    #[test]
    fn cells_to_update_are_those_whose_turn_it_is() {
        let mut occupancy = Occupancy::full();
        occupancy.set(|cell| if cell / 5 % 7 == 0 { Cell::Thin } else { Cell::Empty });
        for step in [
            STEPS_PER_UPDATE,
            3 * STEPS_PER_UPDATE,
            WARM_UP_STEPS,
            WARM_UP_STEPS + STEPS_PER_UPDATE,
            WARM_UP_STEPS + 7 * STEPS_PER_UPDATE,
        ] {
            let expected = (0..CELLS).filter(|&cell| occupancy.is_looked_at(cell, step));
            let found = occupancy.cells_to_update(step);
            assert!(found.into_iter().map(|cell| cell as usize).eq(expected), "step {step}");
        }
    }

    /// A cell becomes empty when updates miss its surface, unless rays meet the surface.
    #[test]
    fn a_cell_that_rays_meet_stays() {
        let (missed, found, place) = (200_100, 1e3, [0.6, 0.2, 0.9]);
        let met = Met::at(place, found);
        assert_eq!(corner(met.cell as usize, GRID), cell_of(place));
        let mut occupancy = Occupancy::full();
        let all: Vec<u32> = (0..CELLS as u32).collect();
        let mut densities = vec![0.0; CELLS];
        occupancy.keep(&[met]);
        assert_eq!(occupancy.density()[met.cell as usize], UNKNOWN);
        (densities[missed], densities[met.cell as usize]) = (found, found);
        occupancy.update(&all, &densities, 0.003);
        assert_eq!(occupancy.cells().count(), 2);
        densities.fill(0.0);
        densities[0] = found;
        for _ in 0..50 {
            occupancy.keep(&[met, Met { density: 0.1, ..met }]);
            occupancy.update(&all, &densities, 0.003);
        }
        assert!(occupancy.cells().eq([0, met.cell as usize]));
    }

    /// As casts have it.
    #[test]
    fn places_lie_in_their_cells() {
        for x in (0..40_000).map(|i| i as f32 * 3e-5 - 0.1).chain([f32::NAN, f32::INFINITY]) {
            let expected = (x * GRID as f32).max(0.0).min(GRID as f32 - 1.0) as u32;
            assert_eq!(cell_along(x), expected, "{x}");
        }
    }

    /// The largest cube of cells is empty that begins at a multiple of its side.
    #[test]
    fn cubes_are_as_large_as_what_is_empty() {
        let mut occupancy = Occupancy::full();
        occupancy.set(|cell| match corner(cell, GRID) {
            [x, y, z] if x > 64 && (cell / 3) % 67 == 0 && y + z < 150 => Cell::Thin,
            [x, _, 40] if x % 16 == 3 => Cell::Dense,
            _ => Cell::Empty,
        });
        let is_empty = |low: [usize; 3], side: usize| {
            (0..side * side * side).all(|i| {
                let [x, y, z] = corner(i, side);
                let cell = low[0] + x + GRID * (low[1] + y + GRID * (low[2] + z));
                !occupancy.is_occupied(cell)
            })
        };
        let (mut rng, mut seen) = (CounterRng::new(6, 0, 0), [0; 6]);
        for _ in 0..3000 {
            let cell = [(); 3].map(|()| rng.below(GRID as u64) as usize);
            let largest =
                (0..=4).rev().find(|size| is_empty(cell.map(|c| c >> size << size), 1 << size));
            let [size] = occupancy.empty_around(&cell.map(|c| [c as u32]));
            assert_eq!(size, largest.unwrap_or(OCCUPIED), "{cell:?}");
            seen[size.min(5) as usize] += 1;
        }
        assert!(seen.iter().all(|&cells| cells > 0), "{seen:?}");
    }

    #[test]
    fn cells_are_those_set() {
        let mut occupancy = Occupancy::full();
        assert_eq!(occupancy.cells().count(), GRID * GRID * GRID);
        occupancy.set(|cell| if cell % 1000 == 3 { Cell::Dense } else { Cell::Empty });
        assert!(occupancy.cells().eq((0..GRID * GRID * GRID).filter(|c| c % 1000 == 3)));
    }
}

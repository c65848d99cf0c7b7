//! Occupancy grid of the unit cube: rays skip empty cells, and training rays sample thin cells at
//! double stride.

use std::sync::atomic::{AtomicU32, Ordering};

use numerics::CounterRng;
use rayon::prelude::*;

use crate::math::floor;
use crate::ray::NormalizedRay;
use crate::spec::Strides;
use crate::spec::{MAX_EMPTY_OPTICAL_DEPTH, MAX_THIN_OPTICAL_DEPTH, OCCUPANCY_CELLS as GRID};
use crate::trainer::PhaseClock;

/// Number of cells.
pub(crate) const CELLS: usize = GRID * GRID * GRID;
/// Side of the 4³ elements whose bits share a word: cells of a brick, bricks of a block.
pub(crate) const SIDE: usize = 4;
/// Number of bricks along each axis.
const BRICKS: usize = GRID / SIDE;
/// Number of blocks along each axis.
const BLOCKS: usize = BRICKS / SIDE;

/// Returns the word index and bit of an element, given its coordinates and the number of words
/// along each axis.
#[inline(always)]
fn word_and_bit(coordinates: [usize; 3], words: usize) -> (usize, u32) {
    let (word, bit) = word_and_bit_u32(coordinates.map(|c| c as u32), words);
    (word as usize, bit)
}

/// Computes [`word_and_bit`] in 32 bits, which vectorises.
#[inline(always)]
fn word_and_bit_u32([x, y, z]: [u32; 3], words: usize) -> (u32, u32) {
    let (words, side) = (words as u32, SIDE as u32);
    let word = x / side + words * (y / side + words * (z / side));
    (word, x % side + side * (y % side + side * (z % side)))
}

/// Number of training steps between updates until the end of the warm-up (docs/design/037).
const STEPS_PER_UPDATE: u64 = 32;
/// Number of training steps between later updates, since cells change slowly and rays raise
/// densities meanwhile (docs/design/037).
const STEPS_PER_LATE_UPDATE: u64 = 64;
/// Number of updates in which every occupied cell is evaluated once (docs/design/037).
const OCCUPIED_PERIOD: usize = 4;
/// Number of updates in which every empty cell is evaluated once (docs/design/037).
const EMPTY_PERIOD: usize = 16;
/// Last step at which empty cells are evaluated as often as occupied ones (docs/design/037).
const WARM_UP_STEPS: u64 = 512;
/// Step by which every cell has been evaluated once.
const FIRST_KNOWN_STEP: u64 = STEPS_PER_UPDATE * OCCUPIED_PERIOD as u64;
/// Number of bricks that a task classifies; chosen by hand.
const BRICKS_PER_TASK: usize = 256;
/// Number of cells whose densities a task stores; chosen by hand.
const CELLS_PER_TASK: usize = 4096;
/// Decay of a cell's density each time the cell is evaluated; chosen by hand.
const DENSITY_DECAY: f32 = 0.7;

/// Converts a linear index in a cube of `side` cells to (x, y, z), x fastest.
#[inline(always)]
pub(crate) fn cell_coordinates(cell: usize, side: usize) -> [usize; 3] {
    [cell % side, cell / side % side, cell / (side * side)]
}

/// Lists a cell and the cells that share a face, an edge or a corner with it, in ascending order.
pub(crate) fn cell_and_neighbours(cell: usize) -> impl Iterator<Item = usize> {
    let [xs, ys, zs] =
        cell_coordinates(cell, GRID).map(|c| c.saturating_sub(1)..=(c + 1).min(GRID - 1));
    zs.flat_map(move |z| {
        let xs = xs.clone();
        ys.clone().flat_map(move |y| xs.clone().map(move |x| x + GRID * (y + GRID * z)))
    })
}

/// Computes two words per brick: bits of the cells that aren't empty, and bits of the dense cells.
fn brick_words(kind: impl Fn(usize) -> Cell + Sync, clock: &PhaseClock) -> (Vec<u64>, Vec<u64>) {
    let firsts = (0..BRICKS * BRICKS * BRICKS).into_par_iter().step_by(BRICKS_PER_TASK);
    let words = firsts.map(|first| {
        let bricks = first..first + BRICKS_PER_TASK;
        clock.task(|| bricks.map(|brick| words_of_brick(brick, &kind)).collect::<Vec<_>>())
    });
    words.flatten_iter().unzip()
}

/// Computes the words of occupied and of dense cells of one brick.
fn words_of_brick(brick: usize, kind: impl Fn(usize) -> Cell) -> (u64, u64) {
    let first = cell_coordinates(brick, BRICKS).map(|c| c * SIDE);
    let (mut occupied, mut dense) = (0, 0);
    for bit in 0..SIDE * SIDE * SIDE {
        let [x, y, z] = cell_coordinates(bit, SIDE);
        let kind = kind(first[0] + x + GRID * (first[1] + y + GRID * (first[2] + z)));
        occupied |= u64::from(kind != Cell::Empty) << bit;
        dense |= u64::from(kind == Cell::Dense) << bit;
    }
    (occupied, dense)
}

/// Returns the coordinates of the cell that contains a position in the unit cube.
#[inline(always)]
pub(crate) fn cell_at(position: [f32; 3]) -> [usize; 3] {
    position.map(|coordinate| cell_along(coordinate) as usize)
}

/// Returns the cell of a coordinate along one axis. `as u32` saturates, which blocks vectorisation;
/// `floor` doesn't.
#[inline(always)]
pub(crate) fn cell_along(coordinate: f32) -> u32 {
    floor((coordinate * GRID as f32).max(0.0).min(GRID as f32 - 1.0)).1
}

/// Density of a training sample that stops light, and its cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CellHit {
    /// Linear index of the cell.
    pub cell: u32,
    /// Density per cube side.
    pub density: f32,
}

impl CellHit {
    /// Creates a hit at a position in the unit cube.
    #[inline(always)]
    pub fn at(position: [f32; 3], density: f32) -> Self {
        let [x, y, z] = cell_at(position);
        Self { cell: (x + GRID * (y + GRID * z)) as u32, density }
    }
}

/// Density of a cell that has never been evaluated.
const UNKNOWN_DENSITY: f32 = -1.0;

/// Kind of a cell; the discriminant is its byte in files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Cell {
    /// No density: rays leap over the cell.
    Empty = 0,
    /// Little density ([`MAX_THIN_OPTICAL_DEPTH`]): training rays take every other sample, of
    /// double length.
    Thin = 1,
    /// Higher or unknown density.
    Dense = 2,
}

impl Cell {
    /// Converts a byte of a file.
    pub(crate) fn from_byte(byte: u8) -> Self {
        match byte {
            0 => Self::Empty,
            1 => Self::Thin,
            _ => Self::Dense,
        }
    }
}

/// Density of each cell per cube side.
#[derive(Debug)]
struct CellDensities(Vec<AtomicU32>);

impl CellDensities {
    fn new(densities: Vec<f32>) -> Self {
        Self(densities.into_iter().map(|density| AtomicU32::new(density.to_bits())).collect())
    }

    fn get(&self, cell: usize) -> f32 {
        f32::from_bits(self.0[cell].load(Ordering::Relaxed))
    }

    fn set(&self, cell: usize, density: f32) {
        self.0[cell].store(density.to_bits(), Ordering::Relaxed);
    }

    /// Raises a cell's density unless it is unknown. Threads may do so in any order.
    fn raise(&self, cell: usize, density: f32) {
        let known = self.get(cell);
        if known != UNKNOWN_DENSITY && density > known {
            // Positive floats have the order of their bits.
            self.0[cell].fetch_max(density.to_bits(), Ordering::Relaxed);
        }
    }

    fn to_vec(&self) -> Vec<f32> {
        (0..self.0.len()).map(|cell| self.get(cell)).collect()
    }
}

impl Clone for CellDensities {
    fn clone(&self) -> Self {
        Self::new(self.to_vec())
    }
}

impl PartialEq for CellDensities {
    fn eq(&self, other: &Self) -> bool {
        (0..self.0.len().max(other.0.len())).all(|cell| self.get(cell) == other.get(cell))
    }
}

/// Returns the number of the update at a training step; `None` if the step has none.
fn update_at(step: u64) -> Option<usize> {
    let interval = if step <= WARM_UP_STEPS { STEPS_PER_UPDATE } else { STEPS_PER_LATE_UPDATE };
    (step > 0 && step.is_multiple_of(interval)).then(|| (step / interval) as usize)
}

/// Slowly decaying maximum of each cell's density, and the cell's kind: 128³ cells over the unit
/// cube, x fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct Occupancy {
    /// Density per cube side of each cell.
    density: CellDensities,
    /// Mask of the cells that may become occupied; `None` for all.
    allowed: Option<Vec<bool>>,
    /// True if the occupied cells are known from another field.
    is_known: bool,
    /// One word per brick: bits of the cells that aren't empty.
    bricks: Vec<u64>,
    /// One word per block: bits of the bricks that aren't empty.
    blocks: Vec<u64>,
    /// One word per brick: bits of the dense cells.
    dense: Vec<u64>,
    /// Lowest and highest corner of the occupied bricks, in the unit cube.
    extent: [[f32; 3]; 2],
}

impl Occupancy {
    /// Creates a grid of dense cells.
    pub fn full() -> Self {
        let mut full = Self {
            density: CellDensities::new(vec![UNKNOWN_DENSITY; CELLS]),
            allowed: None,
            is_known: false,
            bricks: Vec::new(),
            blocks: Vec::new(),
            dense: Vec::new(),
            extent: [[0.0; 3], [1.0; 3]],
        };
        full.set(|_| Cell::Dense);
        full
    }

    /// Limits occupancy to the occupied cells and their neighbours, for fine-tuning of a field
    /// whose other cells are known to be empty.
    pub(crate) fn limit_to_occupied(&mut self) {
        let mask = (0..CELLS)
            .into_par_iter()
            .map(|cell| cell_and_neighbours(cell).any(|near| self.is_occupied(near)))
            .collect();
        self.limit_to(mask);
        self.is_known = true;
    }

    /// Limits occupancy to a mask of cells, within earlier limits; all cells left become dense.
    pub(crate) fn limit_to(&mut self, mut mask: Vec<bool>) {
        for (cell, is_left) in mask.iter_mut().enumerate() {
            *is_left &= self.is_allowed(cell);
        }
        self.set(|cell| if mask[cell] { Cell::Dense } else { Cell::Empty });
        self.allowed = Some(mask);
    }

    fn is_allowed(&self, cell: usize) -> bool {
        self.allowed.as_ref().is_none_or(|allowed| allowed[cell])
    }

    /// Lists the cells to evaluate at a training step; at most steps there are none.
    pub fn cells_to_update(&self, step: u64) -> Vec<u32> {
        let Some(update) = update_at(step) else { return Vec::new() };
        // Cells due as empty are a subset of those due as occupied, so only the latter are visited.
        const { assert!(EMPTY_PERIOD.is_multiple_of(OCCUPIED_PERIOD)) };
        const { assert!(GRID.is_multiple_of(OCCUPIED_PERIOD)) };
        let planes = (0..GRID).into_par_iter().flat_map_iter(|z| {
            let first = (update + GRID - z) % OCCUPIED_PERIOD;
            (z * GRID * GRID + first..(z + 1) * GRID * GRID).step_by(OCCUPIED_PERIOD)
        });
        planes.filter(|&cell| self.is_due(cell, step, update)).map(|cell| cell as u32).collect()
    }

    /// Returns whether a cell is evaluated by the given update at a training step.
    fn is_due(&self, cell: usize, step: u64, update: usize) -> bool {
        let [.., z] = cell_coordinates(cell, GRID);
        let period = if step <= WARM_UP_STEPS || self.is_occupied(cell) {
            OCCUPIED_PERIOD
        } else {
            EMPTY_PERIOD
        };
        self.is_allowed(cell) && (cell % (GRID * GRID) + z) % period == update % period
    }

    /// Returns the strides of a training step: double until every cell has been evaluated, unless
    /// the training is limited to cells known from another field.
    pub fn strides(&self, step: u64) -> Strides {
        if step < FIRST_KNOWN_STEP && !self.is_known { Strides::Double } else { Strides::ByCell }
    }

    /// Draws the position in a cell, in the unit cube, at which its density is evaluated.
    pub fn random_position(cell: u32, seed: u64, step: u64) -> [f32; 3] {
        let mut rng = CounterRng::new(seed, 3, step * CELLS as u64 + u64::from(cell));
        cell_coordinates(cell as usize, GRID).map(|c| (c as f32 + rng.uniform()) / GRID as f32)
    }

    /// Stores the densities evaluated in `cells` and classifies every cell, for rays with samples
    /// `step` apart in cube sides.
    pub fn update(&mut self, cells: &[u32], densities: &[f32], step: f32, clock: &PhaseClock) {
        if cells.is_empty() {
            return;
        }
        let pieces = cells.par_chunks(CELLS_PER_TASK).zip(densities.par_chunks(CELLS_PER_TASK));
        pieces.for_each(|(cells, densities)| {
            clock.task(|| {
                for (&cell, &new_density) in cells.iter().zip(densities) {
                    let decayed = self.density.get(cell as usize) * DENSITY_DECAY;
                    self.density.set(cell as usize, decayed.max(new_density));
                }
            });
        });
        // While all space is semi-transparent, the mean keeps cells below it empty.
        let empty = self.mean_density(clock).min(MAX_EMPTY_OPTICAL_DEPTH / step);
        let thin = MAX_THIN_OPTICAL_DEPTH / step;
        let kind = |cell| match self.density.get(cell) {
            _ if !self.is_allowed(cell) => Cell::Empty,
            d if d < 0.0 => self.cell(cell),
            d if d < empty => Cell::Empty,
            d if d < thin => Cell::Thin,
            _ => Cell::Dense,
        };
        let (bricks, dense) = brick_words(kind, clock);
        self.set_words(bricks, dense);
    }

    /// Raises cells' densities to those of training samples, for the next update. Cells that were
    /// never evaluated are dense anyway.
    pub fn raise_densities(&self, hits: &[CellHit]) {
        for &CellHit { cell, density } in hits {
            self.density.raise(cell as usize, density);
        }
    }

    /// Returns the mean density of the cells that have been evaluated; sums have a fixed order.
    fn mean_density(&self, clock: &PhaseClock) -> f32 {
        let planes = (0..CELLS).into_par_iter().step_by(GRID * GRID);
        let parts: Vec<(f64, u32)> = planes
            .map(|first| {
                clock.task(|| {
                    let cells = (first..first + GRID * GRID).map(|cell| self.density.get(cell));
                    let known = cells.filter(|density| *density >= 0.0);
                    known.fold((0.0, 0), |(sum, count), d| (sum + f64::from(d), count + 1))
                })
            })
            .collect();
        let sum = parts.iter().fold(0.0, |sum, part| sum + part.0);
        let count = parts.iter().map(|part| part.1).sum::<u32>();
        (sum / f64::from(count.max(1))) as f32
    }

    /// Returns whether a cell isn't empty.
    pub(crate) fn is_occupied(&self, cell: usize) -> bool {
        let (word, bit) = word_and_bit(cell_coordinates(cell, GRID), BRICKS);
        self.bricks[word] >> bit & 1 == 1
    }

    /// Returns a cell's kind.
    pub(crate) fn cell(&self, cell: usize) -> Cell {
        let (word, bit) = word_and_bit(cell_coordinates(cell, GRID), BRICKS);
        match (self.bricks[word] >> bit & 1, self.dense[word] >> bit & 1) {
            (0, _) => Cell::Empty,
            (_, 0) => Cell::Thin,
            _ => Cell::Dense,
        }
    }

    /// Sets every cell's kind.
    pub(crate) fn set(&mut self, kind: impl Fn(usize) -> Cell + Sync) {
        let (bricks, dense) = brick_words(kind, &PhaseClock::start());
        self.set_words(bricks, dense);
    }

    fn set_words(&mut self, bricks: Vec<u64>, dense: Vec<u64>) {
        self.blocks = vec![0; BLOCKS * BLOCKS * BLOCKS];
        let (mut low, mut high) = ([BRICKS; 3], [0; 3]);
        for brick in (0..bricks.len()).filter(|&brick| bricks[brick] != 0) {
            let coordinates = cell_coordinates(brick, BRICKS);
            let (word, bit) = word_and_bit(coordinates, BLOCKS);
            self.blocks[word] |= 1 << bit;
            for axis in 0..3 {
                low[axis] = low[axis].min(coordinates[axis]);
                high[axis] = high[axis].max(coordinates[axis] + 1);
            }
        }
        if low == [BRICKS; 3] {
            // All cells are empty: an empty extent.
            low = high;
        }
        self.extent = [low, high].map(|corner| corner.map(|c| c as f32 / BRICKS as f32));
        (self.bricks, self.dense) = (bricks, dense);
    }

    /// Lists the occupied cells in ascending order.
    pub(crate) fn cells(&self) -> impl Iterator<Item = usize> + '_ {
        (0..CELLS).filter(|&cell| self.is_occupied(cell))
    }

    /// Returns each cell's density per cube side; below 0 if unknown.
    pub fn densities(&self) -> Vec<f32> {
        self.density.to_vec()
    }

    /// Returns a cell's density per cube side; below 0 if unknown.
    pub(crate) fn density(&self, cell: usize) -> f32 {
        self.density.get(cell)
    }

    /// Restores the densities and cells of a checkpoint.
    pub fn restore(&mut self, density: Vec<f32>, cells: &[u8]) {
        self.density = CellDensities::new(density);
        self.set(|cell| Cell::from_byte(cells[cell]));
    }

    /// Returns the cells as bytes of a file: 0 is empty, 1 thin, 2 dense.
    pub fn to_bytes(&self) -> Vec<u8> {
        (0..CELLS).map(|cell| self.cell(cell) as u8).collect()
    }
}

/// Value of [`Occupancy::empty_cube_log2_sides`] for a cell that isn't empty.
pub(crate) const OCCUPIED: u32 = 8;

/// Bits of the first 2³ elements of a word's 4³.
const EIGHTH: u64 = 0x33_0033;
/// Bits of an element's bit index that select its eighth of the word.
const FIRST_OF_EIGHTH: u32 = 0b10_1010;
/// Width by which the extent is enlarged for an origin within the unit cube: more than the rounding
/// errors of positions.
const MARGIN: f32 = 1e-5;

impl Occupancy {
    /// Returns the range of t in which a straight ray crosses the slightly enlarged extent of
    /// occupied bricks; `None` if the ray misses it. `inverse` is 1 over the ray's direction.
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

    /// Returns for each cell log2 of the side, 0 to 4, of the largest empty cube around the cell,
    /// in cells; [`OCCUPIED`] for a cell that isn't empty. `cells` has one array per axis.
    ///
    /// All operations but the loads vectorise.
    #[inline(always)]
    pub(crate) fn empty_cube_log2_sides<const N: usize>(&self, cells: &[[u32; N]; 3]) -> [u32; N] {
        let [xs, ys, zs] = cells;
        let (mut bricks, mut cell_bits) = ([0; N], [0; N]);
        let (mut blocks, mut brick_bits) = ([0; N], [0; N]);
        let (mut words, mut log2_sides) = ([[0; N]; 2], [0; N]);
        for i in 0..N {
            let cell = [xs[i], ys[i], zs[i]];
            (bricks[i], cell_bits[i]) = word_and_bit_u32(cell, BRICKS);
            (blocks[i], brick_bits[i]) = word_and_bit_u32(cell.map(|c| c / SIDE as u32), BLOCKS);
        }
        for i in 0..N {
            words[0][i] = self.bricks[bricks[i] as usize];
            words[1][i] = self.blocks[blocks[i] as usize];
        }
        // Without branches, since sides are unpredictable.
        for i in 0..N {
            let [cells, bricks] = [words[0][i], words[1][i]];
            let log2_side = u32::from(cells & EIGHTH << (cell_bits[i] & FIRST_OF_EIGHTH) == 0)
                + u32::from(cells == 0)
                + u32::from(bricks & EIGHTH << (brick_bits[i] & FIRST_OF_EIGHTH) == 0)
                + u32::from(bricks == 0);
            log2_sides[i] = if cells >> cell_bits[i] & 1 == 1 { OCCUPIED } else { log2_side };
        }
        log2_sides
    }

    /// Returns whether an occupied cell is thin.
    #[inline(always)]
    pub(crate) fn is_thin(&self, cell: [usize; 3]) -> bool {
        let (word, bit) = word_and_bit(cell, BRICKS);
        self.dense[word] >> bit & 1 == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fine-tuning is limited to the occupied cells with their neighbours, and to a mask, whatever
    /// densities other cells get.
    #[test]
    fn limits_hold_for_all_densities() {
        let mut occupancy = Occupancy::full();
        assert_eq!(occupancy.strides(FIRST_KNOWN_STEP - 1), Strides::Double);
        assert_eq!(occupancy.strides(FIRST_KNOWN_STEP), Strides::ByCell);
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
        let updates = (1..=OCCUPIED_PERIOD as u64)
            .map(|update| occupancy.cells_to_update(update * STEPS_PER_UPDATE).len());
        assert_eq!(updates.sum::<usize>(), 26 + 8, "each once in a period");
        occupancy.update(&all, &vec![1e3; CELLS], 0.003, &PhaseClock::start());
        assert_eq!(occupancy.cells().count(), 26 + 8);
    }

    #[test]
    fn cells_to_update_are_those_that_are_due() {
        let mut occupancy = Occupancy::full();
        occupancy.set(|cell| if cell / 5 % 7 == 0 { Cell::Thin } else { Cell::Empty });
        for step in [
            STEPS_PER_UPDATE,
            3 * STEPS_PER_UPDATE,
            WARM_UP_STEPS,
            WARM_UP_STEPS + STEPS_PER_LATE_UPDATE,
            WARM_UP_STEPS + 7 * STEPS_PER_LATE_UPDATE,
        ] {
            let update = update_at(step).unwrap();
            let expected = (0..CELLS).filter(|&cell| occupancy.is_due(cell, step, update));
            let found = occupancy.cells_to_update(step);
            assert!(!found.is_empty());
            assert!(found.into_iter().map(|cell| cell as usize).eq(expected), "step {step}");
        }
        assert!(occupancy.cells_to_update(WARM_UP_STEPS + STEPS_PER_UPDATE).is_empty());
    }

    /// A cell becomes empty when updates miss its surface, unless rays hit the surface.
    #[test]
    fn a_cell_that_rays_hit_stays_occupied() {
        let (missed_cell, high_density, position) = (200_100, 1e3, [0.6, 0.2, 0.9]);
        let hit = CellHit::at(position, high_density);
        assert_eq!(cell_coordinates(hit.cell as usize, GRID), cell_at(position));
        let mut occupancy = Occupancy::full();
        let all: Vec<u32> = (0..CELLS as u32).collect();
        let mut densities = vec![0.0; CELLS];
        occupancy.raise_densities(&[hit]);
        assert_eq!(occupancy.density(hit.cell as usize), UNKNOWN_DENSITY);
        (densities[missed_cell], densities[hit.cell as usize]) = (high_density, high_density);
        occupancy.update(&all, &densities, 0.003, &PhaseClock::start());
        assert_eq!(occupancy.cells().count(), 2);
        densities.fill(0.0);
        densities[0] = high_density;
        for _ in 0..50 {
            occupancy.raise_densities(&[hit, CellHit { density: 0.1, ..hit }]);
            occupancy.update(&all, &densities, 0.003, &PhaseClock::start());
        }
        assert!(occupancy.cells().eq([0, hit.cell as usize]));
    }

    /// Cells equal those of a cast by `as u32`, which saturates.
    #[test]
    fn coordinates_are_in_their_cells() {
        for x in (0..40_000).map(|i| i as f32 * 3e-5 - 0.1).chain([f32::NAN, f32::INFINITY]) {
            let expected = (x * GRID as f32).max(0.0).min(GRID as f32 - 1.0) as u32;
            assert_eq!(cell_along(x), expected, "{x}");
        }
    }

    /// The cube is the largest empty one that begins at a multiple of its side.
    #[test]
    fn empty_cubes_have_the_maximum_size() {
        let mut occupancy = Occupancy::full();
        occupancy.set(|cell| match cell_coordinates(cell, GRID) {
            [x, y, z] if x > 64 && (cell / 3) % 67 == 0 && y + z < 150 => Cell::Thin,
            [x, _, 40] if x % 16 == 3 => Cell::Dense,
            _ => Cell::Empty,
        });
        let is_empty = |corner: [usize; 3], side: usize| {
            (0..side * side * side).all(|i| {
                let [x, y, z] = cell_coordinates(i, side);
                let cell = corner[0] + x + GRID * (corner[1] + y + GRID * (corner[2] + z));
                !occupancy.is_occupied(cell)
            })
        };
        let (mut rng, mut counts) = (CounterRng::new(6, 0, 0), [0; 6]);
        for _ in 0..3000 {
            let cell = [(); 3].map(|()| rng.below(GRID as u64) as usize);
            let largest =
                (0..=4).rev().find(|size| is_empty(cell.map(|c| c >> size << size), 1 << size));
            let [size] = occupancy.empty_cube_log2_sides(&cell.map(|c| [c as u32]));
            assert_eq!(size, largest.unwrap_or(OCCUPIED), "{cell:?}");
            counts[size.min(5) as usize] += 1;
        }
        assert!(counts.iter().all(|&cells| cells > 0), "{counts:?}");
    }

    #[test]
    fn occupied_cells_are_those_set() {
        let mut occupancy = Occupancy::full();
        assert_eq!(occupancy.cells().count(), GRID * GRID * GRID);
        occupancy.set(|cell| if cell % 1000 == 3 { Cell::Dense } else { Cell::Empty });
        assert!(occupancy.cells().eq((0..GRID * GRID * GRID).filter(|c| c % 1000 == 3)));
    }
}

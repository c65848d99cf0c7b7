//! Multi-resolution grid: levels of growing resolution, four features per vertex, trilinear
//! interpolation.
//!
//! Vertices are stored in bricks of 2³, so that a cell's eight corners are in few cache lines. A
//! level whose bricks fit its table is stored densely; bricks of a finer level are hashed (Müller
//! et al. 2022, "Instant neural graphics primitives", eq. 4) without resolving collisions.

use crate::aligned::Aligned;
use crate::architecture::Architecture;
use crate::math::floor;
use crate::spec::{BRICK, FEATURES, HASH_FACTORS};
use numerics::kernel;
use numerics::simd::{LANES, Quad as _};

impl Architecture {
    /// Returns the number of floats in the grid.
    pub fn grid_len(&self) -> usize {
        levels(self).last().map_or(0, |level| level.range().end)
    }
}

/// Shape of one grid level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Level {
    /// Cells along each axis.
    pub(crate) resolution: [u32; 3],
    /// Number of entries in the table.
    pub(crate) entries: usize,
    /// Bricks along x and y.
    bricks_across: [u32; 2],
    /// True if bricks are hashed; `entries` is then a power of two.
    pub(crate) hashed: bool,
    /// Index of the table's first float.
    pub(crate) offset: usize,
}

impl Level {
    /// Returns the number of bricks in the table.
    pub(crate) fn bricks(&self) -> usize {
        self.entries / BRICK
    }

    pub(crate) fn range(&self) -> std::ops::Range<usize> {
        self.offset..self.offset + self.entries * FEATURES
    }
}

/// Returns the shapes of levels from `base_resolution` to `max_resolution` cells in equal ratios,
/// with at most `finest_z` cells along z and 2^`log2_hashmap_size` entries each.
pub(crate) fn levels(architecture: &Architecture) -> Vec<Level> {
    let Architecture { n_levels, base_resolution, max_resolution, finest_z, .. } = *architecture;
    let max_entries = 1 << architecture.log2_hashmap_size;
    let steps = f64::from(n_levels.max(2) - 1);
    let ratio = libm::pow(f64::from(max_resolution) / f64::from(base_resolution), 1.0 / steps);
    let mut offset = 0;
    (0..n_levels)
        .map(|i| {
            let cells = (f64::from(base_resolution) * ratio.powi(i as i32)).round() as u32;
            let resolution = [cells, cells, cells.min(finest_z)];
            let bricks = resolution.map(|n| (n + 1).div_ceil(2));
            let stored_vertices =
                bricks.iter().map(|n| u64::from(*n)).product::<u64>() * BRICK as u64;
            let hashed = stored_vertices > max_entries;
            let entries = if hashed { max_entries } else { stored_vertices } as usize;
            let level = Level {
                resolution,
                entries,
                bricks_across: [bricks[0], bricks[1]],
                hashed,
                offset,
            };
            offset += entries * FEATURES;
            level
        })
        .collect()
}

/// Cells around sixteen positions in the unit cube, and the positions within them. Rows are axes.
struct Cells {
    cell: [[u32; LANES]; 3],
    fraction: [[f32; LANES]; 3],
}

impl Cells {
    #[inline(always)]
    fn around(level: &Level, p: [&[f32; LANES]; 3]) -> Self {
        let mut cells = Self { cell: [[0; LANES]; 3], fraction: [[0.0; LANES]; 3] };
        for axis in 0..3 {
            let resolution = level.resolution[axis] as f32;
            let last = resolution - 1.0;
            for l in 0..LANES {
                let at = p[axis][l].max(0.0).min(1.0) * resolution;
                // A position on the far face, where `at` is the resolution, belongs to the last
                // cell, which contains `last + 0.5`.
                let (whole, cell) = floor(at.min(last + 0.5));
                cells.cell[axis][l] = cell;
                cells.fraction[axis][l] = at - whole;
            }
        }
        cells
    }
}

/// Returns the weight of a cell's first or second vertex along an axis.
#[inline(always)]
fn share(fraction: f32, is_second: u32) -> f32 {
    if is_second == 1 { fraction } else { 1.0 - fraction }
}

/// Returns the index of the brick with these coordinates. `mask` is the number of bricks - 1.
#[inline(always)]
fn brick_index(level: &Level, mask: u32, [x, y, z]: [u32; 3]) -> u32 {
    if level.hashed {
        (x ^ y.wrapping_mul(HASH_FACTORS[0]) ^ z.wrapping_mul(HASH_FACTORS[1])) & mask
    } else {
        let [across, down] = level.bricks_across;
        x + across * (y + down * z)
    }
}

/// Entry indices and weights of the eight corners around sixteen positions in the unit cube.
struct Corners {
    index: [[u32; LANES]; 8],
    weight: [[f32; LANES]; 8],
}

#[inline(always)]
fn corners(level: &Level, p: [&[f32; LANES]; 3], out: &mut Corners) {
    let Cells { cell, fraction } = Cells::around(level, p);
    let mask = level.bricks() as u32 - 1;
    for (corner, (index, weight)) in out.index.iter_mut().zip(&mut out.weight).enumerate() {
        let (dx, dy, dz) = (corner as u32 & 1, corner as u32 >> 1 & 1, corner as u32 >> 2);
        for l in 0..LANES {
            let (x, y, z) = (cell[0][l] + dx, cell[1][l] + dy, cell[2][l] + dz);
            let brick = brick_index(level, mask, [x >> 1, y >> 1, z >> 1]);
            index[l] = brick << 3 | (z & 1) << 2 | (y & 1) << 1 | x & 1;
            weight[l] =
                share(fraction[0][l], dx) * share(fraction[1][l], dy) * share(fraction[2][l], dz);
        }
    }
}

impl Corners {
    #[inline(always)]
    fn new() -> Self {
        Self { index: [[0; LANES]; 8], weight: [[0.0; LANES]; 8] }
    }
}

kernel! {
    /// Interpolates the features of `n` positions (three rows, unit cube) into four rows of `n`, a
    /// multiple of sixteen.
    pub(crate) fn encode<L>(level: &Level, table: &[f32], positions: &[f32], features: &mut [f32],
        n: usize) {
        let (table, _) = table.as_chunks::<FEATURES>();
        let mut around = Corners::new();
        let mut s = 0;
        while s < n {
            let (p, _) = positions[s..].as_chunks::<LANES>();
            corners(level, [&p[0], &p[n / LANES], &p[2 * n / LANES]], &mut around);
            let mut block = [[0.0f32; FEATURES]; LANES];
            for l in 0..LANES {
                let mut sum = L::Quad::splat(0.0);
                for c in 0..8 {
                    let entry = L::Quad::load(&table[around.index[c][l] as usize]);
                    sum = entry.mul_add(L::Quad::splat(around.weight[c][l]), sum);
                }
                sum.store(&mut block[l]);
            }
            for k in 0..FEATURES {
                let row: [f32; LANES] = std::array::from_fn(|l| block[l][k]);
                features[k * n + s..][..LANES].copy_from_slice(&row);
            }
            s += LANES;
        }
    }
}

/// Number of entries in half of a brick: a cache line, and a block of the optimiser.
const HALF_BRICK: usize = BRICK / 2;

/// Gradients with respect to the entries of a level's table, in two arrays: entries whose vertices
/// have an even z coordinate, and those with an odd one. Each cell has four corners in each array,
/// so threads add to the arrays in parallel, with equal work and without sharing cache lines.
#[derive(Debug)]
pub(crate) struct LevelGradients {
    pub(crate) halves: [HalfGradients; 2],
}

/// Gradients with respect to the entries whose vertices have an even or an odd z coordinate.
#[derive(Debug)]
pub(crate) struct HalfGradients {
    /// Lowest bit of the z coordinate.
    z_bit: u32,
    /// Sums of gradients, 16 floats for each brick's half.
    pub(crate) sums: Aligned,
    /// Marks of the bricks that have a gradient. A mark is a byte, since a bit would have to be
    /// read before it is set.
    pub(crate) touched: Vec<u8>,
}

impl LevelGradients {
    /// Creates gradients of zero.
    pub(crate) fn zeros(level: &Level) -> Self {
        let half = |z_bit| HalfGradients {
            z_bit,
            sums: Aligned::zeros(level.bricks() * LANES),
            touched: vec![0; level.bricks()],
        };
        Self { halves: [half(0), half(1)] }
    }

    /// Adds the gradients to a table with the level's layout.
    pub(crate) fn add_to(&self, table: &mut [f32]) {
        for (block, features) in table.chunks_exact_mut(LANES).enumerate() {
            let gradients = &self.halves[block % 2].sums[block / 2 * LANES..];
            for (sum, gradient) in features.iter_mut().zip(gradients) {
                *sum += gradient;
            }
        }
    }
}

impl HalfGradients {
    /// Adds each sample's feature gradient to the entries of this half, in sample order, and marks
    /// the bricks. `positions` is arranged by [`arrange_in_rows`].
    pub(crate) fn scatter(
        &mut self,
        level: &Level,
        positions: &[PositionRows],
        feature_gradients: &[[f32; FEATURES]],
    ) {
        let Self { z_bit, sums, touched } = self;
        scatter_half(level, *z_bit, positions, feature_gradients, sums, touched);
    }
}

/// Positions of sixteen samples in the unit cube: rows of x, y and z.
pub(crate) type PositionRows = [[f32; LANES]; 3];

kernel! {
    fn scatter_half<L>(
        level: &Level, z_bit: u32, positions: &[PositionRows],
        feature_gradients: &[[f32; FEATURES]], sums: &mut [f32], touched: &mut [u8],
    ) {
        let (sums, _) = sums.as_chunks_mut::<FEATURES>();
        let mask = level.bricks() as u32 - 1;
        let mut index = [[0u32; LANES]; HALF_BRICK];
        let mut weight = [[0.0f32; LANES]; HALF_BRICK];
        for (p, gradients) in positions.iter().zip(feature_gradients.chunks(LANES)) {
            let Cells { cell, fraction } = Cells::around(level, [&p[0], &p[1], &p[2]]);
            for (corner, (index, weight)) in index.iter_mut().zip(&mut weight).enumerate() {
                let (dx, dy) = (corner as u32 & 1, corner as u32 >> 1);
                for l in 0..LANES {
                    // Selects the cell's vertex along z whose lowest bit is `z_bit`.
                    let dz = (cell[2][l] ^ z_bit) & 1;
                    let (x, y, z) = (cell[0][l] + dx, cell[1][l] + dy, cell[2][l] + dz);
                    let brick = brick_index(level, mask, [x >> 1, y >> 1, z >> 1]);
                    index[l] = brick << 2 | (y & 1) << 1 | x & 1;
                    weight[l] = share(fraction[0][l], dx) * share(fraction[1][l], dy)
                        * share(fraction[2][l], dz);
                }
            }
            for (l, d) in gradients.iter().enumerate() {
                let d = L::Quad::load(d);
                for c in 0..HALF_BRICK {
                    let index = index[c][l] as usize;
                    touched[index / HALF_BRICK] = 1;
                    let entry = &mut sums[index];
                    d.mul_add(L::Quad::splat(weight[c][l]), L::Quad::load(entry)).store(entry);
                }
            }
        }
    }
}

/// Arranges positions in rows of sixteen; the last rows are padded with zeros.
pub(crate) fn arrange_in_rows(positions: &[[f32; 3]], rows: &mut Vec<PositionRows>) {
    rows.clear();
    rows.resize(positions.len().div_ceil(LANES), [[0.0; LANES]; 3]);
    for (i, position) in positions.iter().enumerate() {
        for axis in 0..3 {
            rows[i / LANES][axis][i % LANES] = position[axis];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use numerics::uniform;

    fn positions(n: usize) -> Vec<[f32; 3]> {
        let mut p: Vec<[f32; 3]> =
            (0..n as u64).map(|i| [0, 1, 2].map(|a| uniform(5, a, i))).collect();
        // Corners, faces and just outside.
        p[0] = [0.0; 3];
        p[1] = [1.0; 3];
        p[2] = [1.0, 0.5, 0.0];
        p[3] = [-0.1, 1.2, 0.3];
        p
    }

    /// Returns all x, then all y, then all z.
    fn rows(p: &[[f32; 3]]) -> Vec<f32> {
        (0..3).flat_map(|axis| p.iter().map(move |q| q[axis])).collect()
    }

    #[test]
    fn a_linear_function_is_interpolated_exactly() {
        let level = levels(&Architecture {
            n_levels: 1,
            max_resolution: 16,
            finest_z: 8,
            ..Architecture::default()
        })[0];
        let mut table = vec![0.0; level.entries * FEATURES];
        for z in 0..9 {
            for y in 0..17 {
                for x in 0..17 {
                    let brick = x / 2 + 9 * (y / 2 + 9 * (z / 2));
                    let vertex = brick * BRICK + x % 2 + 2 * (y % 2) + 4 * (z % 2);
                    table[vertex * FEATURES] = (x + 2 * y + 6 * z) as f32 / 16.0;
                }
            }
        }
        let p = positions(32);
        let mut out = vec![0.0; FEATURES * 32];
        encode(&level, &table, &rows(&p), &mut out, 32);
        for (q, value) in p.iter().zip(&out) {
            let c = q.map(|v| v.clamp(0.0, 1.0));
            assert!((value - (c[0] + 2.0 * c[1] + 3.0 * c[2])).abs() < 1e-5, "{q:?} {value}");
        }
    }

    /// Scattering is the adjoint of encoding: <encode(t), d> = <t, scatter(d)>.
    #[test]
    fn scatter_is_the_adjoint_of_encode() {
        let small = Architecture {
            n_levels: 4,
            base_resolution: 8,
            max_resolution: 128,
            log2_hashmap_size: 10,
            ..Architecture::default()
        };
        for level in
            [4096, 12].into_iter().flat_map(|finest_z| levels(&Architecture { finest_z, ..small }))
        {
            let n = 48;
            let table: Vec<f32> =
                (0..level.entries * FEATURES).map(|i| uniform(1, 0, i as u64) - 0.5).collect();
            let d: Vec<[f32; 4]> =
                (0..n as u64).map(|i| [0, 1, 2, 3].map(|k| uniform(2, k, i) - 0.5)).collect();
            let p = positions(n);
            let mut out = vec![0.0; FEATURES * n];
            encode(&level, &table, &rows(&p), &mut out, n);
            let mut rows = Vec::new();
            arrange_in_rows(&p, &mut rows);
            let mut gradients = LevelGradients::zeros(&level);
            for half in &mut gradients.halves {
                half.scatter(&level, &rows, &d);
                for (brick, sums) in half.sums.chunks(LANES).enumerate() {
                    let is_marked = half.touched[brick] == 1;
                    assert!(is_marked || sums.iter().all(|g| *g == 0.0), "brick {brick}");
                }
            }
            let mut gradient = vec![0.0; table.len()];
            gradients.add_to(&mut gradient);
            let left: f64 = (0..n)
                .flat_map(|s| (0..4).map(move |k| (s, k)))
                .map(|(s, k)| f64::from(out[k * n + s]) * f64::from(d[s][k]))
                .sum();
            let right: f64 =
                table.iter().zip(&gradient).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum();
            assert!((left - right).abs() < 1e-5 * left.abs().max(1.0), "{left} {right} {level:?}");
        }
    }
}

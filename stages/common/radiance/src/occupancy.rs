//! Which cells of the unit cube may hold something: what rays skip by.

use crate::ray::UnitRay;

/// Cells along each axis.
pub(crate) const GRID: usize = 128;
/// Cells along each axis of a block; empty blocks are skipped whole.
const BLOCK: usize = 8;
const BLOCKS: usize = GRID / BLOCK;

/// A slowly decaying maximum of the density seen in each cell, and the cells where it counts.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Occupancy {
    pub(crate) density: Vec<f32>,
    bits: Vec<u64>,
    blocks: Vec<u64>,
}

impl Occupancy {
    /// Everything may be occupied.
    pub(crate) fn full() -> Self {
        let mut full = Self { density: vec![0.0; GRID * GRID * GRID], bits: Vec::new(), blocks: Vec::new() };
        full.set(|_| true);
        full
    }

    pub(crate) fn is_occupied(&self, cell: usize) -> bool {
        self.bits[cell / 64] >> (cell % 64) & 1 == 1
    }

    /// Sets every cell anew. x runs fastest.
    pub(crate) fn set(&mut self, occupied: impl Fn(usize) -> bool) {
        self.bits = vec![0; GRID * GRID * GRID / 64];
        self.blocks = vec![0; (BLOCKS * BLOCKS * BLOCKS).div_ceil(64)];
        for cell in 0..GRID * GRID * GRID {
            if occupied(cell) {
                self.bits[cell / 64] |= 1 << (cell % 64);
                let (x, y, z) = (cell % GRID / BLOCK, cell / GRID % GRID / BLOCK, cell / (GRID * GRID) / BLOCK);
                let block = x + BLOCKS * (y + BLOCKS * z);
                self.blocks[block / 64] |= 1 << (block % 64);
            }
        }
    }

    /// Cells that are occupied, in order.
    pub(crate) fn cells(&self) -> impl Iterator<Item = usize> + '_ {
        self.bits.iter().enumerate().flat_map(|(word, &bits)| {
            let mut left = bits;
            std::iter::from_fn(move || {
                (left != 0).then(|| {
                    let bit = left.trailing_zeros() as usize;
                    left &= left - 1;
                    word * 64 + bit
                })
            })
        })
    }

    /// Cells as bytes, 1 where occupied, for a file.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        (0..GRID * GRID * GRID).map(|cell| u8::from(self.is_occupied(cell))).collect()
    }

    /// Distances of a ray's samples: at enter + (k + offset)·step wherever the cell is occupied.
    pub(crate) fn march(&self, ray: &UnitRay, step: f32, offset: f32, mut sample: impl FnMut(f32, [f32; 3])) {
        let inverse = ray.direction.map(|d| 1.0 / d);
        let last = GRID as f32 - 1.0;
        let mut k = 0u32;
        loop {
            let t = (k as f32 + offset).mul_add(step, ray.enter);
            if t >= ray.leave {
                return;
            }
            let p: [f32; 3] = std::array::from_fn(|i| ray.direction[i].mul_add(t, ray.origin[i]));
            let cell = p.map(|x| (x * GRID as f32).max(0.0).min(last) as usize);
            let block = cell.map(|c| c / BLOCK);
            let block_index = block[0] + BLOCKS * (block[1] + BLOCKS * block[2]);
            let (low, size) = if self.blocks[block_index / 64] >> (block_index % 64) & 1 == 0 {
                (block.map(|b| b * BLOCK), BLOCK)
            } else if !self.is_occupied(cell[0] + GRID * (cell[1] + GRID * cell[2])) {
                (cell, 1)
            } else {
                sample(t, p);
                k += 1;
                continue;
            };
            // Where the ray leaves this empty cell or block; at least one step on.
            let mut exit = f32::INFINITY;
            for i in 0..3 {
                let face = if ray.direction[i] > 0.0 { low[i] + size } else { low[i] } as f32 / GRID as f32;
                let until = (face - ray.origin[i]) * inverse[i];
                if ray.direction[i] != 0.0 && until < exit {
                    exit = until;
                }
            }
            let next = ((exit - ray.enter) / step - offset).ceil();
            // `as` saturates: an exit that is NaN or infinite moves on by one step.
            k = (k + 1).max(if next.is_finite() { next as u32 } else { 0 });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Draws;

    #[test]
    fn skipping_loses_no_sample() {
        let mut occupancy = Occupancy::full();
        occupancy.set(|cell| (cell / 7) % 11 == 0 && cell % GRID > 40);
        let step = 3.0f32.sqrt() / 512.0;
        for seed in 0..200 {
            let mut draws = Draws::new(1, 2, seed);
            let mut unit = || draws.uniform();
            let origin = [unit(), unit(), unit()];
            let d = [unit() - 0.5, unit() - 0.5, if seed % 5 == 0 { 0.0 } else { unit() - 0.5 }];
            let length = d.iter().map(|x| x * x).sum::<f32>().sqrt();
            let direction = d.map(|x| x / length);
            let leave = (0..3)
                .filter(|&i| direction[i] != 0.0)
                .map(|i| (if direction[i] > 0.0 { 1.0 - origin[i] } else { -origin[i] }) / direction[i])
                .fold(f32::INFINITY, f32::min);
            let ray = UnitRay { origin, direction, enter: 0.0, leave };
            let mut found = Vec::new();
            occupancy.march(&ray, step, 0.3, |t, _| found.push(t));
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

    #[test]
    fn cells_are_those_set() {
        let mut occupancy = Occupancy::full();
        assert_eq!(occupancy.cells().count(), GRID * GRID * GRID);
        occupancy.set(|cell| cell % 1000 == 3);
        assert!(occupancy.cells().eq((0..GRID * GRID * GRID).filter(|c| c % 1000 == 3)));
    }
}

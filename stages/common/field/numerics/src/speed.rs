//! A fixed piece of work like that of a field: dense layers and reads of hashed entries.

use crate::kernel;
use crate::simd::{LANES, Quad};

/// Width of the layer, and number of samples.
const WIDTH: usize = 64;
/// Vectors of samples, and outputs, of a tile.
const TILE: usize = 4;
/// Base-2 logarithm of the number of table entries, 16 MB: more than most caches.
const LOG2_ENTRIES: u32 = 20;
/// Layers of a piece of work. Layers and reads take about equal times on two cores with AVX-512.
const LAYERS: usize = 40;
/// Table reads of a piece of work.
const READS: u32 = 32_768;
/// Multiplier of the hash (Knuth).
const HASH: u32 = 2_654_435_761;

/// Data of the work, for a measurement of a machine's speed.
#[derive(Clone, Debug)]
pub struct SpeedTest {
    weights: Vec<f32>,
    samples: Vec<f32>,
    table: Vec<[f32; 4]>,
    outputs: Vec<f32>,
    sum: [f32; 4],
}

impl Default for SpeedTest {
    fn default() -> Self {
        Self {
            weights: vec![0.01; WIDTH * WIDTH],
            samples: vec![0.5; WIDTH * WIDTH],
            table: vec![[0.25; 4]; 1 << LOG2_ENTRIES],
            outputs: vec![0.0; WIDTH * WIDTH],
            sum: [0.0; 4],
        }
    }
}

impl SpeedTest {
    /// Carries out one piece of work, of less than a millisecond. Returns a number that depends on
    /// all of it.
    pub fn work(&mut self) -> f32 {
        for _ in 0..LAYERS {
            layer(&self.weights, &self.samples, &mut self.outputs);
            // The next layer depends on this one.
            self.samples[0] = self.outputs[0];
        }
        read_table(&self.table, &mut self.sum);
        self.outputs[0] + self.sum[0]
    }
}

kernel! {
    /// Multiplies 64 samples by a layer of 64 inputs and outputs.
    fn layer<L>(weights: &[f32], samples: &[f32], outputs: &mut [f32]) {
        for first in (0..WIDTH).step_by(TILE) {
            let mut sums = [[L::splat(0.0); WIDTH / LANES]; TILE];
            for input in 0..WIDTH {
                let row = &samples[input * WIDTH..(input + 1) * WIDTH];
                for output in 0..TILE {
                    let weight = L::splat(weights[input * WIDTH + first + output]);
                    for lane in 0..WIDTH / LANES {
                        let values = row[lane * LANES..(lane + 1) * LANES].try_into();
                        let values = L::load(values.expect("a row has whole vectors"));
                        sums[output][lane] = values.mul_add(weight, sums[output][lane]);
                    }
                }
            }
            for output in 0..TILE {
                for lane in 0..WIDTH / LANES {
                    let at = (first + output) * WIDTH + lane * LANES;
                    let to = (&mut outputs[at..at + LANES]).try_into();
                    sums[output][lane].store(to.expect("a row has whole vectors"));
                }
            }
        }
    }
}

kernel! {
    /// Sums table entries at hashed indices.
    fn read_table<L>(table: &[[f32; 4]], sum: &mut [f32; 4]) {
        let mut total = L::Quad::load(sum);
        let half = L::Quad::splat(0.5);
        for i in 0..READS {
            let index = (i.wrapping_mul(HASH) >> (u32::BITS - LOG2_ENTRIES)) as usize;
            total = total.mul_add(half, L::Quad::load(&table[index]));
        }
        total.store(sum);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::by_every_family;

    /// Layers sum 64 products, and the table's sum approaches a fixed point.
    #[test]
    fn the_work_has_equal_results_in_every_family() {
        let mut results = Vec::new();
        by_every_family(|_| {
            let mut test = SpeedTest::default();
            results.push(test.work());
            assert!((test.outputs[WIDTH] - 0.01 * 0.5 * WIDTH as f32).abs() < 0.01);
            assert!((test.sum[3] - 0.5).abs() < 1e-6);
        });
        assert!(results.iter().all(|result| *result == results[0]), "{results:?}");
    }
}

//! Fixed work like that of a field: dense layers and reads of hashed entries.

use std::sync::Arc;

use crate::kernel;
use crate::simd::{LANES, Quad};

/// Number of inputs and of outputs of a layer.
const WIDTH: usize = 64;
/// Number of samples.
const SAMPLES: usize = 64;
/// Number of outputs of a tile.
const TILE_OUTPUTS: usize = 4;
/// Base-2 logarithm of the number of table entries. The table has 16 MB, more than most caches.
const LOG2_ENTRIES: u32 = 20;
/// Number of layers per call. Layers and reads take about equal times on two cores with AVX-512.
const LAYERS: usize = 40;
/// Number of table reads per call.
const READS: u32 = 32_768;
/// Multiplier of the hash (Knuth).
const HASH: u32 = 2_654_435_761;

/// Fixed work, with its data, whose running time measures a machine's speed. Clones share the
/// table, as the threads of a training do.
#[derive(Clone, Debug)]
pub struct SpeedTest {
    weights: Vec<f32>,
    samples: Vec<f32>,
    table: Arc<[[f32; 4]]>,
    outputs: Vec<f32>,
    sum: [f32; 4],
}

impl Default for SpeedTest {
    fn default() -> Self {
        Self {
            weights: vec![0.01; WIDTH * WIDTH],
            samples: vec![0.5; WIDTH * SAMPLES],
            table: vec![[0.25; 4]; 1 << LOG2_ENTRIES].into(),
            outputs: vec![0.0; WIDTH * SAMPLES],
            sum: [0.0; 4],
        }
    }
}

impl SpeedTest {
    /// Does the work once, in less than a millisecond. Returns a number that depends on all of it.
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
        for first in (0..WIDTH).step_by(TILE_OUTPUTS) {
            let mut sums = [[L::splat(0.0); SAMPLES / LANES]; TILE_OUTPUTS];
            for input in 0..WIDTH {
                let row = &samples[input * SAMPLES..(input + 1) * SAMPLES];
                for output in 0..TILE_OUTPUTS {
                    let weight = L::splat(weights[input * WIDTH + first + output]);
                    for vector in 0..SAMPLES / LANES {
                        let values = row[vector * LANES..(vector + 1) * LANES].try_into();
                        let values = L::load(values.expect("a row has whole vectors"));
                        sums[output][vector] = values.mul_add(weight, sums[output][vector]);
                    }
                }
            }
            for output in 0..TILE_OUTPUTS {
                for vector in 0..SAMPLES / LANES {
                    let at = (first + output) * SAMPLES + vector * LANES;
                    let to = (&mut outputs[at..at + LANES]).try_into();
                    sums[output][vector].store(to.expect("a row has whole vectors"));
                }
            }
        }
    }
}

kernel! {
    /// Adds table entries at hashed indices to `sum`, which is halved before each addition.
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
    use crate::simd::test_every_family;

    /// Each output of a layer sums 64 products, and the repeatedly halved sum of table entries
    /// converges.
    #[test]
    fn every_family_has_equal_results() {
        let mut results = Vec::new();
        test_every_family(|_| {
            let mut test = SpeedTest::default();
            results.push(test.work());
            assert!((test.outputs[SAMPLES] - 0.01 * 0.5 * WIDTH as f32).abs() < 0.01);
            assert!((test.sum[3] - 0.5).abs() < 1e-6);
        });
        assert!(results.iter().all(|result| *result == results[0]), "{results:?}");
    }
}

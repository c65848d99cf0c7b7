//! Input and output of marching.

use crate::occupancy::Occupancy;
use crate::ray::NormalizedRay;
use crate::spec::Strides;

/// Value that replaces the number of the next step of a ray without further samples.
pub(crate) const DONE: u32 = u32::MAX;

/// Rays to march, and their sampling.
#[derive(Clone, Copy, Debug)]
pub(crate) struct March<'a> {
    pub(crate) occupancy: &'a Occupancy,
    pub(crate) rays: &'a [NormalizedRay],
    /// Shift of each ray's samples, in steps.
    pub(crate) offsets: &'a [f32],
    /// Distance between samples, in cube sides.
    pub(crate) step: f32,
    pub(crate) strides: Strides,
}

/// Samples found by marching, in the order of rounds, then of rays. Padding follows each round's
/// samples.
#[derive(Debug, Default)]
pub(crate) struct MarchedSamples {
    /// Ray parameter of each sample.
    pub(crate) t: Vec<f32>,
    /// Length of each sample in steps: 1 or 2.
    pub(crate) lengths: Vec<f32>,
    /// Position of each sample in the unit cube.
    pub(crate) positions: Vec<[f32; 3]>,
    /// Index of each active ray's first sample in the last round. An additional last element is
    /// the end of the round's samples, without padding.
    pub(crate) starts: Vec<usize>,
    pub(super) slots: SampleSlots,
}

/// Samples of rays that march in parallel lanes, before they are sorted by ray.
#[derive(Debug, Default)]
pub(super) struct SampleSlots {
    /// Maximum number of samples per ray in this round.
    max_samples: usize,
    /// Number of samples of each active ray in this round.
    pub(super) counts: Vec<usize>,
    /// t and length of each sample: `max_samples` slots per ray.
    samples: Vec<[f32; 2]>,
}

impl SampleSlots {
    #[inline(always)]
    pub(super) fn begin(&mut self, rays: usize, max_samples: usize) {
        self.max_samples = max_samples;
        self.counts.clear();
        self.counts.resize(rays, 0);
        self.samples.resize(rays * max_samples, [0.0; 2]);
    }

    /// Returns t and length of an active ray's sample.
    #[inline(always)]
    pub(super) fn sample(&self, active_index: usize, slot: usize) -> [f32; 2] {
        self.samples[active_index * self.max_samples + slot]
    }

    /// Puts a sample into the next slot of an active ray.
    #[inline(always)]
    pub(super) fn put(&mut self, active_index: usize, t: f32, length: f32) {
        let count = &mut self.counts[active_index];
        self.samples[active_index * self.max_samples + *count] = [t, length];
        *count += 1;
    }
}

impl MarchedSamples {
    #[inline(always)]
    pub(super) fn push(&mut self, t: f32, length: f32, position: [f32; 3]) {
        self.t.push(t);
        self.lengths.push(length);
        self.positions.push(position);
    }
}

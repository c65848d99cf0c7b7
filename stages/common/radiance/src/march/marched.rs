//! Rays to march, and the samples found.

use crate::occupancy::Occupancy;
use crate::ray::NormalizedRay;
use crate::strides::Strides;

/// Where a ray's march stands: the number of its next step; [`DONE`] once it has left the box.
pub(crate) const DONE: u32 = u32::MAX;

/// Rays to march, and how.
#[derive(Clone, Copy, Debug)]
pub(crate) struct March<'a> {
    pub(crate) occupancy: &'a Occupancy,
    pub(crate) rays: &'a [NormalizedRay],
    /// Share of a step by which each ray's samples are shifted.
    pub(crate) offsets: &'a [f32],
    /// Distance between samples, in cube sides.
    pub(crate) step: f32,
    pub(crate) strides: Strides,
}

/// Samples found by marching, ray by ray.
#[derive(Debug, Default)]
pub(crate) struct Marched {
    /// Where each sample lies along its ray.
    pub(crate) t: Vec<f32>,
    /// How many steps it stands for.
    pub(crate) lengths: Vec<f32>,
    /// Its place in the unit cube.
    pub(crate) positions: Vec<[f32; 3]>,
    /// First sample of each active ray, and the end.
    pub(crate) starts: Vec<usize>,
    pub(super) slots: Slots,
}

/// Samples of rays that march side by side, until all are found.
#[derive(Debug, Default)]
pub(super) struct Slots {
    /// Most samples of a ray.
    most: usize,
    /// How many samples each active ray has so far.
    pub(super) counts: Vec<usize>,
    /// t and length of each sample: `most` slots a ray.
    samples: Vec<[f32; 2]>,
}

impl Slots {
    #[inline(always)]
    pub(super) fn begin(&mut self, rays: usize, most: usize) {
        self.most = most;
        self.counts.clear();
        self.counts.resize(rays, 0);
        self.samples.resize(rays * most, [0.0; 2]);
    }

    /// t and length of an active ray's sample.
    #[inline(always)]
    pub(super) fn sample(&self, place: usize, slot: usize) -> [f32; 2] {
        self.samples[place * self.most + slot]
    }

    /// Puts a sample into the next slot of an active ray.
    #[inline(always)]
    pub(super) fn put(&mut self, place: usize, t: f32, length: f32) {
        let count = &mut self.counts[place];
        self.samples[place * self.most + *count] = [t, length];
        *count += 1;
    }
}

impl Marched {
    #[inline(always)]
    pub(super) fn push(&mut self, t: f32, length: f32, position: [f32; 3]) {
        self.t.push(t);
        self.lengths.push(length);
        self.positions.push(position);
    }
}

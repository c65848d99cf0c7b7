//! Forward and backward pass of a few rays through the whole field, in reused buffers: nothing is
//! allocated after the buffers have grown.

use crate::aligned::Aligned;
use crate::field::Field;
use crate::grid::PositionRows;
use crate::march::March;
use crate::ray::NormalizedRay;
use crate::samples::{Counted, RaySum, Round, Samples, gather, rounds_of};
use crate::shading::{LayerInput, NetworkGradients, RayGradients, Shading, dot};
use crate::spec::Strides;
use crate::spec::{DENSITY_OUTPUTS, FEATURES};
use numerics::kernel;
use numerics::simd::LANES;

/// Number of rays in a chunk, whose samples fill the vectors and fit the cache (docs/design/006).
pub(crate) const CHUNK_RAYS: usize = 64;

/// Gradients with respect to grid features, in sample order. Scattered to the grid after all shards
/// have run.
#[derive(Debug, Default)]
pub(crate) struct FeatureGradients {
    pub(crate) positions: Vec<[f32; 3]>,
    /// The positions in rows, arranged once all samples are listed.
    pub(crate) rows: Vec<PositionRows>,
    /// One list per level, as long as `positions`.
    pub(crate) levels: Vec<Vec<[f32; FEATURES]>>,
}

impl FeatureGradients {
    pub(crate) fn clear(&mut self) {
        self.positions.clear();
        for level in &mut self.levels {
            level.clear();
        }
    }
}

/// Russian roulette on samples' gradients: small ones are dropped at random before they reach the
/// density network and the grid (docs/design/037).
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Roulette {
    /// Threshold m as a multiple of the chunk's mean gradient norm; 0 keeps all samples. A sample
    /// whose norm g is below m is kept with probability g/m, its gradient multiplied by m/g, so the
    /// expected gradient is unchanged.
    pub(crate) limit: f32,
    /// Random start of the running sum by which samples are chosen, in 0..1.
    pub(crate) draw: f32,
}

/// Buffers of one worker.
#[derive(Debug, Default)]
pub(crate) struct Chunk {
    pub(crate) sums: Vec<RaySum>,
    /// Samples marched in the last forward pass.
    pub(crate) samples: Samples,
    /// Samples with a colour in the last forward pass.
    pub(crate) counted: Counted,
    shading: Shading,
    backward: BackwardBuffers,
}

/// Buffers of the backward pass through the density network.
#[derive(Debug, Default)]
struct BackwardBuffers {
    /// Gradients with respect to the density network's outputs: of the samples that count, then of
    /// the chosen.
    gradients: Vec<[f32; DENSITY_OUTPUTS]>,
    lengths: Aligned,
    /// Indices of the chosen samples, by round.
    chosen: Vec<u32>,
    rounds: Vec<Round>,
    features: Aligned,
    hidden: Aligned,
    rows: [Aligned; 2],
}

kernel! {
    fn lengths_of<L>(gradients: &[[f32; DENSITY_OUTPUTS]], lengths: &mut [f32]) {
        for (gradient, length) in gradients.iter().zip(lengths) {
            *length = dot(gradient, gradient).sqrt();
        }
    }
}

impl BackwardBuffers {
    /// Chooses among the samples that count; afterwards `gradients` has those of the chosen ones.
    fn choose(&mut self, samples: &Samples, counted: &Counted, roulette: Roulette) {
        let count = counted.sample.len();
        lengths_of(&self.gradients, self.lengths.grow(count));
        let limit =
            roulette.limit * self.lengths[..count].iter().sum::<f32>() / count.max(1) as f32;
        let mut sum = roulette.draw;
        self.chosen.clear();
        self.rounds.clear();
        for (round, range) in rounds_of(&samples.rounds, count) {
            self.rounds.push(Round { first_selected: self.chosen.len(), ..*round });
            for k in range {
                let mut gradient = self.gradients[k];
                if self.lengths[k] < limit {
                    let share = self.lengths[k] / limit;
                    sum += share;
                    if sum < 1.0 {
                        continue;
                    }
                    sum -= 1.0;
                    gradient = gradient.map(|g| g / share);
                }
                self.gradients[self.chosen.len()] = gradient;
                self.chosen.push(counted.sample[k]);
            }
        }
    }

    /// Propagates the chosen samples' gradients to the density network's weights and the grid's
    /// features.
    fn run(
        &mut self,
        field: &Field,
        samples: &Samples,
        network: &mut NetworkGradients<'_>,
        into: &mut FeatureGradients,
    ) {
        let count = self.chosen.len();
        if count == 0 {
            return;
        }
        let m = count.next_multiple_of(LANES);
        let [first, second] = field.layers.density;
        let widest = first.inputs.max(first.outputs).max(DENSITY_OUTPUTS);
        let [a, b] = &mut self.rows;
        let (a, b) = (a.grow(widest * m), b.grow(widest * m));
        for (o, row) in a[..DENSITY_OUTPUTS * m].chunks_exact_mut(m).enumerate() {
            row.iter_mut().zip(&self.gradients).for_each(|(value, gradient)| *value = gradient[o]);
            row[count..].fill(0.0);
        }
        let features = self.features.grow(first.inputs * m);
        gather(&self.rounds, &self.chosen, &samples.rows.features, first.inputs, features, m);
        let hidden = self.hidden.grow(first.outputs * m);
        gather(&self.rounds, &self.chosen, &samples.rows.hidden, first.outputs, hidden, m);
        network.backward(second, LayerInput::Hidden(hidden), m, a, b);
        network.backward(first, LayerInput::First(features), m, b, a);

        into.positions.extend(self.chosen.iter().map(|&i| samples.marched.positions[i as usize]));
        into.levels.resize_with(field.levels.len(), Vec::new);
        for (list, rows) in into.levels.iter_mut().zip(a.chunks_exact(FEATURES * m)) {
            list.extend(
                (0..count).map(|k| -> [f32; FEATURES] { std::array::from_fn(|f| rows[f * m + k]) }),
            );
        }
    }
}

impl Chunk {
    /// Renders rays into [`Chunk::sums`]. `offsets` are shifts of each ray's samples, in steps.
    pub(crate) fn forward(
        &mut self,
        field: &Field,
        rays: &[NormalizedRay],
        offsets: &[f32],
        strides: Strides,
    ) {
        self.sums.clear();
        self.sums.resize(rays.len(), RaySum { transmittance: 1.0, ..RaySum::default() });
        let march =
            March { occupancy: &field.occupancy, rays, offsets, step: field.march_step(), strides };
        self.samples.march(field, &march, &mut self.counted, &mut self.sums);
        self.counted.collect(&self.samples, rays.len());
        self.shading.forward(field, rays, &self.samples, &self.counted, &mut self.sums);
    }

    /// Propagates gradients from the rays of the last forward pass: adds to the networks' gradients
    /// and appends to the grid's.
    pub(crate) fn backward(
        &mut self,
        field: &Field,
        upstream: RayGradients<'_>,
        roulette: Roulette,
        network: &mut NetworkGradients<'_>,
        into: &mut FeatureGradients,
    ) {
        if self.counted.sample.is_empty() {
            return;
        }
        let Self { sums, samples, counted, shading, backward } = self;
        let gradients = &mut backward.gradients;
        shading.backward(field, (samples, counted, sums), upstream, network, gradients);
        backward.choose(samples, counted, roulette);
        backward.run(field, samples, network, into);
    }
}

#[cfg(test)]
impl Chunk {
    /// Positions of each ray's samples that count, from front to back.
    pub(crate) fn kept_positions(&self) -> Vec<Vec<[f32; 3]>> {
        let at =
            |&k: &u32| self.samples.marched.positions[self.counted.sample[k as usize] as usize];
        (0..self.sums.len() as u32)
            .map(|r| self.counted.samples_of_ray(r).iter().map(at).collect())
            .collect()
    }
}

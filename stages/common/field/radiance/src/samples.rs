//! Samples of a chunk's rays, marched in rounds: positions, densities and weights.

use crate::aligned::Aligned;
use crate::composite::{optical_depths, weights};
use crate::field::Field;
use crate::grid::encode;
use crate::march::{DONE, March, MarchedSamples, march};
use crate::math::exp;
use crate::mlp::{After, multiply};
use crate::occupancy::CellHit;
use crate::spec::Strides;
use crate::spec::{
    DENSITY_OUTPUTS, FEATURES, MAX_OPTICAL_DEPTH, MAX_RAW_DENSITY, MIN_HIT_WEIGHT,
    MIN_TRANSMITTANCE, MIN_WEIGHT, TRAINING_ROUND_SAMPLES,
};
use numerics::simd::LANES;

/// Sums over one ray's samples. Before marching, the caller sets `transmittance` to 1.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RaySum {
    pub(crate) colour: [f32; 3],
    pub(crate) transmittance: f32,
    /// Σ w over the samples in [`Counted`].
    pub(crate) weight: f32,
    /// Σ w·distance over the samples in [`Counted`], in scene units.
    pub(crate) distance: f32,
    /// Parameter t at which the transmittance falls below one half.
    pub(crate) median: Option<f32>,
}

/// Number of samples per ray in a round of rendering: a trained field's surfaces stop rays early.
/// Chosen by hand.
const RENDERING_ROUND: usize = 8;

/// Samples that were marched together, padded to whole vectors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Round {
    /// Index of the first sample; a buffer with k rows per round has this round at k·first_sample.
    pub(crate) first_sample: usize,
    /// Number of samples with padding: the length of a row.
    pub(crate) n: usize,
    /// Index of the round's first sample in a list of selected samples.
    pub(crate) first_selected: usize,
}

impl Round {
    /// Returns the range of the round's `rows` rows in a buffer.
    fn range(self, rows: usize) -> std::ops::Range<usize> {
        rows * self.first_sample..rows * (self.first_sample + self.n)
    }
}

/// Inputs and activations of the density network. Activations are stored by round, then by row.
#[derive(Debug, Default)]
pub(crate) struct DensityRows {
    /// Positions of the last round only: three rows.
    positions: Aligned,
    pub(crate) features: Aligned,
    pub(crate) hidden: Aligned,
    pub(crate) outputs: Aligned,
}

impl DensityRows {
    /// Runs the network at a round's `positions` (three rows of n).
    fn run(&mut self, field: &Field, round: Round) {
        let n = round.n;
        if n == 0 {
            return;
        }
        let [first, second] = field.layers.density;
        for (buffer, rows) in [
            (&mut self.features, first.inputs),
            (&mut self.hidden, first.outputs),
            (&mut self.outputs, second.outputs),
        ] {
            buffer.grow(round.range(rows).end);
        }
        let features = &mut self.features[round.range(first.inputs)];
        for (level, rows) in field.levels.iter().zip(features.chunks_exact_mut(FEATURES * n)) {
            encode(level, &field.grid[level.range()], &self.positions[..3 * n], rows, n);
        }
        let hidden = &mut self.hidden[round.range(first.outputs)];
        multiply(first.matrix(&field.network), features, hidden, n, After::Relu);
        let outputs = &mut self.outputs[round.range(second.outputs)];
        multiply(second.matrix(&field.network), hidden, outputs, n, After::Linear);
    }

    /// Runs the network at `n` positions (three rows) and returns its outputs, one row each.
    pub(crate) fn outputs_at(&mut self, field: &Field, positions: &[f32], n: usize) -> &[f32] {
        self.positions.grow(3 * n).copy_from_slice(positions);
        self.run(field, Round { first_sample: 0, n, first_selected: 0 });
        &self.outputs[..DENSITY_OUTPUTS * n]
    }

    /// Evaluates the density at `n` positions (three rows), for the occupancy.
    pub(crate) fn densities(
        &mut self,
        field: &Field,
        positions: &[f32],
        n: usize,
        densities: &mut [f32],
    ) {
        optical_depths(&self.outputs_at(field, positions, n)[..n], 1.0, densities);
    }
}

/// Samples of a chunk's rays. Each round has the next few samples of every active ray.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    pub(crate) rounds: Vec<Round>,
    pub(crate) marched: MarchedSamples,
    pub(crate) rows: DensityRows,
    /// Number of samples without padding.
    pub(crate) count: usize,
    /// Optical depth of each sample.
    tau: Aligned,
    /// Optical depth before each sample.
    before: Aligned,
    pub(crate) transmittance: Aligned,
    pub(crate) weight: Aligned,
    /// Optical depth of each ray so far.
    depth: Vec<f32>,
    /// Rays that haven't ended.
    active: Vec<u32>,
    /// Index of each ray's next step, or [`DONE`].
    next: Vec<u32>,
}

impl Samples {
    /// Marches rays to their ends, and lists in `counted` the samples that count.
    pub(crate) fn march(
        &mut self,
        field: &Field,
        rays: &March<'_>,
        counted: &mut Counted,
        sums: &mut [RaySum],
    ) {
        self.rounds.clear();
        self.marched.t.clear();
        self.marched.lengths.clear();
        self.marched.positions.clear();
        self.count = 0;
        self.next.clear();
        self.next.resize(sums.len(), 0);
        self.depth.clear();
        self.depth.resize(sums.len(), 0.0);
        self.active.clear();
        self.active.extend(0..sums.len() as u32);
        counted.sample.clear();
        counted.ray_of_sample.clear();
        while !self.active.is_empty() {
            self.march_round(field, rays, counted, sums);
        }
        for (sum, &depth) in sums.iter_mut().zip(&self.depth) {
            if depth > 0.0 {
                sum.transmittance = exp(-depth);
            }
        }
    }

    /// Marches one round, and removes the rays that end from the active ones.
    fn march_round(
        &mut self,
        field: &Field,
        rays: &March<'_>,
        counted: &mut Counted,
        sums: &mut [RaySum],
    ) {
        let round = self.take_samples(rays, counted.sample.len());
        self.rows.run(field, round);
        self.compute_weights(round, rays.step, sums);
        self.list_counted(counted);
        self.rounds.push(round);
        let (next, depth) = (&self.next, &self.depth);
        self.active.retain(|&r| next[r as usize] != DONE && depth[r as usize] < MAX_OPTICAL_DEPTH);
    }

    /// Finds the next samples of every active ray, and copies their positions to the network's
    /// rows. `first_selected` is the number of counted samples of earlier rounds.
    fn take_samples(&mut self, rays: &March<'_>, first_selected: usize) -> Round {
        let max_samples = match rays.strides {
            Strides::Single => RENDERING_ROUND,
            Strides::ByCell | Strides::Double => {
                TRAINING_ROUND_SAMPLES[self.rounds.len().min(TRAINING_ROUND_SAMPLES.len() - 1)]
            }
        };
        let first_sample = self.marched.t.len();
        self.marched.starts.clear();
        march(rays, max_samples, &self.active, &mut self.next, &mut self.marched);
        let count = self.marched.t.len() - first_sample;
        let n = count.next_multiple_of(LANES);
        self.count += count;
        self.marched.t.resize(first_sample + n, 0.0);
        self.marched.lengths.resize(first_sample + n, 0.0);
        self.marched.positions.resize(first_sample + n, [0.0; 3]);
        self.rows.positions.grow(3 * n);
        for (axis, row) in self.rows.positions[..3 * n].chunks_exact_mut(n.max(1)).enumerate() {
            for (value, p) in row.iter_mut().zip(&self.marched.positions[first_sample..]) {
                *value = p[axis];
            }
        }
        Round { first_sample, n, first_selected }
    }

    /// Computes each sample's optical depth, transmittance and weight from the network's outputs,
    /// and the rays' median t. `step` is the length of one step in cube sides.
    fn compute_weights(&mut self, round: Round, step: f32, sums: &mut [RaySum]) {
        let Round { first_sample: start, n, .. } = round;
        for buffer in [&mut self.tau, &mut self.before, &mut self.transmittance, &mut self.weight] {
            buffer.grow(start + n);
        }
        let range = start..start + n;
        let tau = &mut self.tau[range.clone()];
        if n > 0 {
            optical_depths(&self.rows.outputs[DENSITY_OUTPUTS * start..][..n], step, tau);
            for (tau, length) in tau.iter_mut().zip(&self.marched.lengths[start..]) {
                *tau *= length;
            }
        }
        let before = &mut self.before[range.clone()];
        for (&r, range) in self.active.iter().zip(self.marched.starts.windows(2)) {
            let mut depth = self.depth[r as usize];
            for i in range[0] - start..range[1] - start {
                before[i] = depth;
                depth += tau[i];
                if before[i] <= std::f32::consts::LN_2 && depth > std::f32::consts::LN_2 {
                    sums[r as usize].median = Some(self.marched.t[start + i]);
                }
            }
            self.depth[r as usize] = depth;
        }
        // Padding.
        before[self.marched.starts[self.active.len()] - start..].fill(0.0);
        weights(before, tau, &mut self.transmittance[range.clone()], &mut self.weight[range]);
    }

    /// Lists the last round's samples that count.
    fn list_counted(&self, counted: &mut Counted) {
        for (&r, range) in self.active.iter().zip(self.marched.starts.windows(2)) {
            for i in range[0]..range[1] {
                if self.transmittance[i] > MIN_TRANSMITTANCE && self.weight[i] > MIN_WEIGHT {
                    counted.sample.push(i as u32);
                    counted.ray_of_sample.push(r);
                }
            }
        }
    }

    /// Lists the densities and cells of samples that stop light. `step` is the length of one step
    /// in cube sides.
    pub(crate) fn list_hits(&self, counted: &Counted, step: f32, hits: &mut Vec<CellHit>) {
        let MarchedSamples { positions, lengths, .. } = &self.marched;
        let samples = counted.sample.iter().map(|&i| i as usize);
        hits.extend(
            samples
                .filter(|&i| self.weight[i] > MIN_HIT_WEIGHT)
                .map(|i| CellHit::at(positions[i], self.tau[i] / (lengths[i] * step))),
        );
    }

    /// Returns the derivative of a sample's optical depth with respect to its raw density.
    fn optical_depth_slope(&self, sample: usize, raw: f32) -> f32 {
        if raw < MAX_RAW_DENSITY { self.tau[sample] } else { 0.0 }
    }
}

/// Samples that count: those with transmittance and weight above [`MIN_TRANSMITTANCE`] and
/// [`MIN_WEIGHT`], which alone have colour and gradient.
#[derive(Debug, Default)]
pub(crate) struct Counted {
    /// Sample indices, by round.
    pub(crate) sample: Vec<u32>,
    /// Ray of each sample.
    ray_of_sample: Vec<u32>,
    /// Indices in `sample`, by ray from front to back.
    sorted_by_ray: Vec<u32>,
    /// First entry of each ray in `sorted_by_ray`, and the end.
    ray_starts: Vec<usize>,
    /// Rays with at least one sample that counts.
    pub(crate) rays: Vec<u32>,
    /// Outputs of the density network per sample. The first one, the raw density, is replaced by
    /// dτ/d(raw).
    pub(crate) outputs: Vec<[f32; DENSITY_OUTPUTS]>,
}

impl Counted {
    /// Returns the indices in `sample` of a ray's samples, from front to back.
    pub(crate) fn samples_of_ray(&self, ray: u32) -> &[u32] {
        &self.sorted_by_ray[self.ray_starts[ray as usize]..self.ray_starts[ray as usize + 1]]
    }

    /// Returns the maximum number of samples of a ray.
    pub(crate) fn max_samples_per_ray(&self) -> usize {
        self.ray_starts.windows(2).map(|r| r[1] - r[0]).max().unwrap_or(0)
    }

    /// Sorts the samples by ray, and copies their network outputs out of the rounds.
    pub(crate) fn collect(&mut self, samples: &Samples, rays: usize) {
        self.ray_starts.clear();
        self.ray_starts.resize(rays + 1, 0);
        for &r in &self.ray_of_sample {
            self.ray_starts[r as usize + 1] += 1;
        }
        for r in 0..rays {
            self.ray_starts[r + 1] += self.ray_starts[r];
        }
        self.rays.clear();
        self.rays.extend(
            (0..rays as u32)
                .filter(|&r| self.ray_starts[r as usize] < self.ray_starts[r as usize + 1]),
        );
        self.sorted_by_ray.clear();
        self.sorted_by_ray.resize(self.sample.len(), 0);
        // Filling advances each ray's start to its end, which is the next ray's start.
        for (k, &r) in self.ray_of_sample.iter().enumerate() {
            let next = &mut self.ray_starts[r as usize];
            self.sorted_by_ray[*next] = k as u32;
            *next += 1;
        }
        self.ray_starts.rotate_right(1);
        self.ray_starts[0] = 0;

        self.outputs.clear();
        for (round, range) in rounds_of(&samples.rounds, self.sample.len()) {
            let rows = &samples.rows.outputs[round.range(DENSITY_OUTPUTS)];
            for &i in &self.sample[range] {
                let column = i as usize - round.first_sample;
                let mut outputs: [f32; DENSITY_OUTPUTS] =
                    std::array::from_fn(|o| rows[o * round.n + column]);
                outputs[0] = samples.optical_depth_slope(i as usize, outputs[0]);
                self.outputs.push(outputs);
            }
        }
    }
}

/// Returns each round with the range of its samples in a list of `count` selected samples.
pub(crate) fn rounds_of(
    rounds: &[Round],
    count: usize,
) -> impl Iterator<Item = (&Round, std::ops::Range<usize>)> {
    let ends = rounds.iter().skip(1).map(|r| r.first_selected).chain([count]);
    rounds.iter().zip(ends).map(|(round, end)| (round, round.first_selected..end))
}

/// Copies the columns of the samples in `list` to `to`. `from` has `rows` rows for each round; rows
/// of `to` have length `m`, padded with 0.
pub(crate) fn gather(
    rounds: &[Round],
    list: &[u32],
    from: &[f32],
    rows: usize,
    to: &mut [f32],
    m: usize,
) {
    for (round, range) in rounds_of(rounds, list.len()) {
        for (row, target) in to.chunks_exact_mut(m.max(1)).enumerate() {
            let source = &from[rows * round.first_sample + row * round.n..][..round.n];
            for (value, &i) in target[range.clone()].iter_mut().zip(&list[range.clone()]) {
                *value = source[i as usize - round.first_sample];
            }
        }
    }
    for target in to.chunks_exact_mut(m.max(1)) {
        target[list.len()..].fill(0.0);
    }
}

//! Samples of a few rays, marched in rounds: where they lie, their density, and their weights.

use crate::aligned::Aligned;
use crate::composite::{optical_depths, weights};
use crate::field::Field;
use crate::grid::encode;
use crate::march::{DONE, March, Marched, march};
use crate::math::exp;
use crate::mlp::{After, multiply};
use crate::occupancy::Met;
use crate::simd::LANES;
use crate::spec::{DARK, DENSITY_OUTPUTS, FAINT, FEATURES, MAX_RAW_DENSITY, MET, TRAINING_ROUNDS};
use crate::strides::Strides;

/// What one ray adds up to.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RaySum {
    pub(crate) colour: [f32; 3],
    pub(crate) transmittance: f32,
    /// Σ w over the samples that count.
    pub(crate) weight: f32,
    /// Σ w·distance over them, in scene units.
    pub(crate) distance: f32,
    /// Where along the ray the transmittance falls below one half: its t.
    pub(crate) median: Option<f32>,
}

/// Samples of each ray in a round of rendering: a trained field's surfaces stop rays within few.
const RENDERING_ROUND: usize = 8;

/// Samples that were marched together. Their rows have a length of `n`, whole vectors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Round {
    /// First sample of the round; what has k rows begins at k·start.
    pub(crate) start: usize,
    pub(crate) n: usize,
    /// First of its samples in a list of samples.
    pub(crate) first: usize,
}

impl Round {
    /// Where the `rows` rows of the round lie.
    fn range(self, rows: usize) -> std::ops::Range<usize> {
        rows * self.start..rows * (self.start + self.n)
    }
}

/// Activations of the density network: rows of all samples of a round, round after round.
#[derive(Debug, Default)]
pub(crate) struct DensityRows {
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
            buffer.fit(round.range(rows).end);
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

    /// Outputs of the network at `n` positions (three rows): a row each.
    pub(crate) fn outputs_at(&mut self, field: &Field, positions: &[f32], n: usize) -> &[f32] {
        self.positions.fit(3 * n).copy_from_slice(positions);
        self.run(field, Round { start: 0, n, first: 0 });
        &self.outputs[..DENSITY_OUTPUTS * n]
    }

    /// Density of `n` positions (three rows): for the occupancy.
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

/// All samples of a few rays, in rounds: of every ray that is still lit, the next few.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    pub(crate) rounds: Vec<Round>,
    pub(crate) marched: Marched,
    pub(crate) rows: DensityRows,
    /// Samples without those that fill rounds up.
    pub(crate) count: usize,
    tau: Aligned,
    /// Optical depth before each sample.
    before: Aligned,
    pub(crate) transmittance: Aligned,
    pub(crate) weight: Aligned,
    /// Optical depth of each ray so far.
    depth: Vec<f32>,
    /// Rays still lit, and the step that each ray's march has come to.
    active: Vec<u32>,
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
        counted.ray.clear();
        while !self.active.is_empty() {
            self.round(field, rays, counted, sums);
        }
        for (sum, &depth) in sums.iter_mut().zip(&self.depth) {
            if depth > 0.0 {
                sum.transmittance = exp(-depth);
            }
        }
    }

    /// Takes every active ray some samples further, and drops those that end.
    fn round(
        &mut self,
        field: &Field,
        rays: &March<'_>,
        counted: &mut Counted,
        sums: &mut [RaySum],
    ) {
        let round = self.take_samples(rays, counted.sample.len());
        self.rows.run(field, round);
        self.weigh(round, rays.step, sums);
        self.list_counted(counted);
        self.rounds.push(round);
        let (next, depth) = (&self.next, &self.depth);
        self.active.retain(|&r| next[r as usize] != DONE && depth[r as usize] < DARK);
    }

    /// Takes the next samples of every active ray, and puts their positions into the network's
    /// rows. So far `counted` samples count.
    fn take_samples(&mut self, rays: &March<'_>, counted: usize) -> Round {
        let most = match rays.strides {
            Strides::Even => RENDERING_ROUND,
            Strides::ByCell | Strides::Double => {
                TRAINING_ROUNDS[self.rounds.len().min(TRAINING_ROUNDS.len() - 1)]
            }
        };
        let start = self.marched.t.len();
        self.marched.starts.clear();
        march(rays, most, &self.active, &mut self.next, &mut self.marched);
        let count = self.marched.t.len() - start;
        let n = count.next_multiple_of(LANES);
        self.count += count;
        self.marched.t.resize(start + n, 0.0);
        self.marched.lengths.resize(start + n, 0.0);
        self.marched.positions.resize(start + n, [0.0; 3]);
        self.rows.positions.fit(3 * n);
        for (axis, row) in self.rows.positions[..3 * n].chunks_exact_mut(n.max(1)).enumerate() {
            for (value, p) in row.iter_mut().zip(&self.marched.positions[start..]) {
                *value = p[axis];
            }
        }
        Round { start, n, first: counted }
    }

    /// Finds each sample's optical depth, transmittance and weight from the network's outputs, and
    /// where a ray's light is halved. A sample stands for `step` times its length, in cube sides.
    fn weigh(&mut self, round: Round, step: f32, sums: &mut [RaySum]) {
        let Round { start, n, .. } = round;
        for buffer in [&mut self.tau, &mut self.before, &mut self.transmittance, &mut self.weight] {
            buffer.fit(start + n);
        }
        let whole = start..start + n;
        let tau = &mut self.tau[whole.clone()];
        if n > 0 {
            optical_depths(&self.rows.outputs[DENSITY_OUTPUTS * start..][..n], step, tau);
            tau.iter_mut()
                .zip(&self.marched.lengths[start..])
                .for_each(|(tau, length)| *tau *= length);
        }
        let before = &mut self.before[whole.clone()];
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
        // What fills the round up.
        before[self.marched.starts[self.active.len()] - start..].fill(0.0);
        weights(before, tau, &mut self.transmittance[whole.clone()], &mut self.weight[whole]);
    }

    /// Lists those of the last round's samples that count.
    fn list_counted(&self, counted: &mut Counted) {
        for (&r, range) in self.active.iter().zip(self.marched.starts.windows(2)) {
            for i in range[0]..range[1] {
                if self.transmittance[i] > FAINT && self.weight[i] > FAINT {
                    counted.sample.push(i as u32);
                    counted.ray.push(r);
                }
            }
        }
    }

    /// Lists the cells where samples stop light. A sample stands for `step` times its length, in
    /// cube sides.
    pub(crate) fn list_met(&self, counted: &Counted, step: f32, met: &mut Vec<Met>) {
        let Marched { positions, lengths, .. } = &self.marched;
        let samples = counted.sample.iter().map(|&i| i as usize);
        met.extend(
            samples
                .filter(|&i| self.weight[i] > MET)
                .map(|i| Met::at(positions[i], self.tau[i] / (lengths[i] * step))),
        );
    }

    /// Derivative of a sample's optical depth by its raw density.
    fn slope(&self, sample: usize, raw: f32) -> f32 {
        if raw < MAX_RAW_DENSITY { self.tau[sample] } else { 0.0 }
    }
}

/// The samples that count: what they hold, and whose they are.
#[derive(Debug, Default)]
pub(crate) struct Counted {
    /// Samples, round by round, and their rays.
    pub(crate) sample: Vec<u32>,
    ray: Vec<u32>,
    /// Places in `sample`, ray by ray from front to back; and the first of each ray.
    along: Vec<u32>,
    ray_starts: Vec<usize>,
    /// Rays that have any.
    pub(crate) rays: Vec<u32>,
    /// Outputs of the density network, sample by sample; instead of the raw density its slope:
    /// dτ/d(raw).
    pub(crate) outputs: Vec<[f32; DENSITY_OUTPUTS]>,
}

impl Counted {
    /// A ray's places, from front to back.
    pub(crate) fn of_ray(&self, ray: u32) -> &[u32] {
        &self.along[self.ray_starts[ray as usize]..self.ray_starts[ray as usize + 1]]
    }

    /// Most samples of a ray.
    pub(crate) fn longest(&self) -> usize {
        self.ray_starts.windows(2).map(|r| r[1] - r[0]).max().unwrap_or(0)
    }

    /// Finds each ray's samples, and takes out of the rounds what they hold.
    pub(crate) fn collect(&mut self, samples: &Samples, rays: usize) {
        self.ray_starts.clear();
        self.ray_starts.resize(rays + 1, 0);
        for &r in &self.ray {
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
        self.along.clear();
        self.along.resize(self.sample.len(), 0);
        // Filled from each ray's start, which thereby becomes its end: the next ray's start.
        for (k, &r) in self.ray.iter().enumerate() {
            let place = &mut self.ray_starts[r as usize];
            self.along[*place] = k as u32;
            *place += 1;
        }
        self.ray_starts.rotate_right(1);
        self.ray_starts[0] = 0;

        self.outputs.clear();
        for (round, range) in rounds_of(&samples.rounds, self.sample.len()) {
            let rows =
                &samples.rows.outputs[DENSITY_OUTPUTS * round.start..][..DENSITY_OUTPUTS * round.n];
            for &i in &self.sample[range] {
                let column = i as usize - round.start;
                let mut outputs: [f32; DENSITY_OUTPUTS] =
                    std::array::from_fn(|o| rows[o * round.n + column]);
                outputs[0] = samples.slope(i as usize, outputs[0]);
                self.outputs.push(outputs);
            }
        }
    }
}

/// Each round and the places of its samples in a list of so many.
pub(crate) fn rounds_of(
    rounds: &[Round],
    count: usize,
) -> impl Iterator<Item = (&Round, std::ops::Range<usize>)> {
    let ends = rounds.iter().skip(1).map(|r| r.first).chain([count]);
    rounds.iter().zip(ends).map(|(round, end)| (round, round.first..end))
}

/// Copies the columns of a list of samples out of the rounds, whose `rows` rows lie in `from`, to
/// rows of stride `m`; what pads the result is 0.
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
            let source = &from[rows * round.start + row * round.n..][..round.n];
            for (value, &i) in target[range.clone()].iter_mut().zip(&list[range.clone()]) {
                *value = source[i as usize - round.start];
            }
        }
    }
    for target in to.chunks_exact_mut(m.max(1)) {
        target[list.len()..].fill(0.0);
    }
}

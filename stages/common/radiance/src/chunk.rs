//! A few rays at a time through the whole field and back, in buffers that are reused: nothing is allocated once they have grown.

use crate::composite::{
    MAX_RAW, Regularisers, add_distortion_gradients, likeness, optical_depth_gradients, optical_depths, weights,
};
use crate::field::{COLOUR_INPUTS, DENSITY_OUTPUTS, Field};
use crate::grid::{FEATURES, encode};
use crate::math::{exp, sigmoid};
use crate::mlp::{After, Layer, add_outer, multiply};
use crate::occupancy::{DONE, march};
use crate::ray::NormalizedRay;
use crate::simd::{LANES, kernel};
use crate::spherical::{BASIS, spherical_harmonics};

/// Samples behind this transmittance, and those of less weight, get no colour and no gradient.
const FAINT: f32 = 1e-4;
/// Optical depth at which a ray ends: -ln([`FAINT`]).
const DARK: f32 = 9.210_34;

/// What one ray adds up to.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RaySum {
    pub(crate) colour: [f32; 3],
    pub(crate) transmittance: f32,
    /// Σ w over the samples with colour.
    pub(crate) weight: f32,
    /// Σ w·distance over the same, in scene units.
    pub(crate) distance: f32,
    /// Where along the ray the transmittance falls below one half: its t.
    pub(crate) median: Option<f32>,
}

/// Gradients by grid features, in sample order: what is scattered once all shards are done.
#[derive(Debug, Default)]
pub(crate) struct FeatureGradients {
    pub(crate) positions: Vec<[f32; 3]>,
    /// One list a level, as long as `positions`.
    pub(crate) levels: Vec<Vec<[f32; FEATURES]>>,
}

/// Samples of each ray in the first rounds and in all later ones: few while a surface may stop the ray, then more.
const ROUNDS: [usize; 4] = [8, 8, 16, 32];

/// Samples that were marched together. Their rows have a length of `n`, whole vectors.
#[derive(Clone, Copy, Debug)]
struct Round {
    /// First sample of the round; what has k rows begins at k·start.
    start: usize,
    n: usize,
    /// First of its samples that count.
    kept: usize,
}

impl Round {
    /// Where the `rows` rows of the round lie.
    fn range(self, rows: usize) -> std::ops::Range<usize> {
        rows * self.start..rows * (self.start + self.n)
    }
}

/// Buffers of one worker. Samples are in rounds: of every ray that is still lit, the next few. "Rows" are one feature of all
/// samples of a round; of the `m` samples that count, rows are gathered again to be shaded.
#[derive(Debug, Default)]
pub(crate) struct Chunk {
    pub(crate) sums: Vec<RaySum>,
    samples: usize,
    rounds: Vec<Round>,
    /// Rays still lit, and the step that each ray's march has come to.
    active: Vec<u32>,
    next: Vec<u32>,
    /// First sample of each active ray in the round.
    starts: Vec<usize>,
    /// Optical depth of each ray so far.
    depth: Vec<f32>,
    /// Where each sample lies along its ray, and in the unit cube.
    t: Vec<f32>,
    marched: Vec<[f32; 3]>,
    positions: Vec<f32>,
    features: Vec<f32>,
    hidden: Vec<f32>,
    density: Vec<f32>,
    tau: Vec<f32>,
    before: Vec<f32>,
    transmittance: Vec<f32>,
    weight: Vec<f32>,
    /// Samples that count, round by round, and their rays.
    kept: Vec<u32>,
    kept_ray: Vec<u32>,
    /// The same, as places in `kept`, ray by ray from front to back; and the first of each ray.
    along: Vec<u32>,
    ray_starts: Vec<usize>,
    bases: Vec<[f32; BASIS]>,
    kept_features: Vec<f32>,
    kept_hidden: Vec<f32>,
    colour_in: Vec<f32>,
    colour_hidden: [Vec<f32>; 2],
    colour: Vec<f32>,
    gradient: [Vec<f32>; 3],
    tau_gradient: Vec<f32>,
}

/// At least `len` floats, with what was in them before.
fn fit(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if buffer.len() < len {
        buffer.resize(len, 0.0);
    }
    &mut buffer[..len]
}

kernel! {
    fn sigmoids<L>(values: &mut [f32]) {
        for v in values {
            *v = sigmoid(*v);
        }
    }
}

/// Density of positions (three rows of n): for the occupancy grid.
pub(crate) fn densities<'a>(chunk: &'a mut Chunk, field: &Field, positions: &[f32], n: usize) -> &'a [f32] {
    fit(&mut chunk.positions, 3 * n).copy_from_slice(positions);
    chunk.density_network(field, Round { start: 0, n, kept: 0 });
    let raw = &chunk.density[..n];
    let density = fit(&mut chunk.tau, n);
    optical_depths(raw, 1.0, density);
    density
}

impl Chunk {
    /// Features, hidden layer and density of a round's positions, `self.positions` (three rows of n).
    fn density_network(&mut self, field: &Field, round: Round) {
        let n = round.n;
        if n == 0 {
            return;
        }
        let positions = &self.positions[..3 * n];
        let [first, second] = field.layers.density;
        let part = |buffer: &mut Vec<f32>, rows: usize| {
            fit(buffer, round.range(rows).end);
        };
        part(&mut self.features, first.inputs);
        part(&mut self.hidden, first.outputs);
        part(&mut self.density, second.outputs);
        let features = &mut self.features[round.range(first.inputs)];
        for (level, rows) in field.levels.iter().zip(features.chunks_exact_mut(FEATURES * n)) {
            encode(level, &field.grid[level.range()], positions, rows, n);
        }
        let hidden = &mut self.hidden[round.range(first.outputs)];
        multiply(&field.network[first.range()], features, hidden, first.inputs, first.outputs, n, After::Relu);
        let density = &mut self.density[round.range(second.outputs)];
        multiply(&field.network[second.range()], hidden, density, second.inputs, second.outputs, n, After::Linear);
    }

    /// Renders rays into [`Chunk::sums`]. `offsets` shift each ray's samples by a share of a step.
    pub(crate) fn forward(&mut self, field: &Field, rays: &[NormalizedRay], offsets: &[f32]) {
        let step = field.step();
        for list in [&mut self.kept, &mut self.kept_ray, &mut self.active, &mut self.next] {
            list.clear();
        }
        self.rounds.clear();
        self.t.clear();
        self.marched.clear();
        self.samples = 0;
        self.next.resize(rays.len(), 0);
        self.depth.clear();
        self.depth.resize(rays.len(), 0.0);
        self.sums.clear();
        self.sums.resize(rays.len(), RaySum { transmittance: 1.0, ..RaySum::default() });
        self.active.extend(0..rays.len() as u32);
        while !self.active.is_empty() {
            let most = ROUNDS[self.rounds.len().min(ROUNDS.len() - 1)];
            self.round(field, rays, offsets, step, most);
        }
        for (sum, &depth) in self.sums.iter_mut().zip(&self.depth) {
            if depth > 0.0 {
                sum.transmittance = exp(-depth);
            }
        }
        self.order(rays.len());
        self.shade(field, rays);
    }

    /// Takes every active ray some samples further, and drops those that end.
    fn round(&mut self, field: &Field, rays: &[NormalizedRay], offsets: &[f32], step: f32, most: usize) {
        let start = self.t.len();
        self.starts.clear();
        let (t, marched, starts) = (&mut self.t, &mut self.marched, &mut self.starts);
        march(&field.occupancy, rays, offsets, step, most, &self.active, &mut self.next, t, marched, starts);
        let count = self.t.len() - start;
        let round = Round { start, n: count.next_multiple_of(LANES), kept: self.kept.len() };
        let n = round.n;
        self.samples += count;
        self.t.resize(start + n, 0.0);
        self.marched.resize(start + n, [0.0; 3]);
        fit(&mut self.positions, 3 * n);
        for (axis, row) in self.positions[..3 * n].chunks_exact_mut(n.max(1)).enumerate() {
            for (value, p) in row.iter_mut().zip(&self.marched[start..]) {
                *value = p[axis];
            }
        }
        self.density_network(field, round);
        for buffer in [&mut self.tau, &mut self.before, &mut self.transmittance, &mut self.weight] {
            fit(buffer, start + n);
        }
        let whole = start..start + n;
        let tau = &mut self.tau[whole.clone()];
        if n > 0 {
            optical_depths(&self.density[DENSITY_OUTPUTS * start..][..n], step, tau);
        }
        let before = &mut self.before[whole.clone()];
        for (&r, range) in self.active.iter().zip(self.starts.windows(2)) {
            let mut depth = self.depth[r as usize];
            for i in range[0] - start..range[1] - start {
                before[i] = depth;
                depth += tau[i];
                if before[i] <= std::f32::consts::LN_2 && depth > std::f32::consts::LN_2 {
                    self.sums[r as usize].median = Some(self.t[start + i]);
                }
            }
            self.depth[r as usize] = depth;
        }
        before[count..].fill(0.0);
        weights(before, tau, &mut self.transmittance[whole.clone()], &mut self.weight[whole]);
        for (&r, range) in self.active.iter().zip(self.starts.windows(2)) {
            for i in range[0]..range[1] {
                if self.transmittance[i] > FAINT && self.weight[i] > FAINT {
                    self.kept.push(i as u32);
                    self.kept_ray.push(r);
                }
            }
        }
        self.rounds.push(round);
        let (next, depth) = (&self.next, &self.depth);
        self.active.retain(|&r| next[r as usize] != DONE && depth[r as usize] < DARK);
    }

    /// Finds each ray's samples among those that count.
    fn order(&mut self, rays: usize) {
        self.ray_starts.clear();
        self.ray_starts.resize(rays + 1, 0);
        for &r in &self.kept_ray {
            self.ray_starts[r as usize + 1] += 1;
        }
        for r in 0..rays {
            self.ray_starts[r + 1] += self.ray_starts[r];
        }
        self.along.clear();
        self.along.resize(self.kept.len(), 0);
        // Filled from each ray's start, which thereby becomes its end: the next ray's start.
        for (k, &r) in self.kept_ray.iter().enumerate() {
            let place = &mut self.ray_starts[r as usize];
            self.along[*place] = k as u32;
            *place += 1;
        }
        self.ray_starts.rotate_right(1);
        self.ray_starts[0] = 0;
    }

    /// Colours of the samples that count, and each ray's sums.
    fn shade(&mut self, field: &Field, rays: &[NormalizedRay]) {
        let m = self.kept.len().next_multiple_of(LANES);
        let input = fit(&mut self.colour_in, COLOUR_INPUTS * m);
        gather(&self.rounds, &self.kept, &self.density, DENSITY_OUTPUTS, 1, &mut input[..(DENSITY_OUTPUTS - 1) * m], m);
        self.bases.clear();
        self.bases.extend(rays.iter().map(|r| spherical_harmonics(r.view)));
        for (k, row) in input[(DENSITY_OUTPUTS - 1) * m..].chunks_exact_mut(m.max(1)).enumerate() {
            for (value, &r) in row.iter_mut().zip(&self.kept_ray) {
                *value = self.bases[r as usize][k];
            }
            row[self.kept.len()..].fill(0.0);
        }
        let [first, second, third] = field.layers.colour;
        let [hidden1, hidden2] = &mut self.colour_hidden;
        let (hidden1, hidden2) = (fit(hidden1, first.outputs * m), fit(hidden2, second.outputs * m));
        multiply(&field.network[first.range()], input, hidden1, first.inputs, first.outputs, m, After::Relu);
        multiply(&field.network[second.range()], hidden1, hidden2, second.inputs, second.outputs, m, After::Relu);
        let colour = fit(&mut self.colour, 3 * m);
        multiply(&field.network[third.range()], hidden2, colour, third.inputs, third.outputs, m, After::Linear);
        sigmoids(colour);
        for ((sum, ray), range) in self.sums.iter_mut().zip(rays).zip(self.ray_starts.windows(2)) {
            for &k in &self.along[range[0]..range[1]] {
                let (k, i) = (k as usize, self.kept[k as usize] as usize);
                let w = self.weight[i];
                for c in 0..3 {
                    sum.colour[c] = w.mul_add(colour[c * m + k], sum.colour[c]);
                }
                sum.weight += w;
                sum.distance = w.mul_add(ray.distance(self.t[i]), sum.distance);
            }
        }
    }

    /// Goes back from each ray's colour gradient, and from the distortion and floater losses times their factors: adds to the
    /// networks' partial sums (`lanes`) and appends to `into`. `transposed` are the weights output by output.
    #[allow(clippy::too_many_arguments, reason = "what a pass reads and where it adds; a struct of them would have one use")]
    pub(crate) fn backward(
        &mut self,
        field: &Field,
        transposed: &[f32],
        colour_gradients: &[[f32; 3]],
        backgrounds: &[[f32; 3]],
        regularisers: Regularisers,
        lanes: &mut [f32],
        into: &mut FeatureGradients,
    ) {
        let count = self.kept.len();
        if count == 0 {
            return;
        }
        let m = count.next_multiple_of(LANES);
        let [g1, g2, g3] = &mut self.gradient;
        let widest = field.layers.all().iter().map(|l| l.inputs.max(l.outputs)).max().unwrap_or(0);
        let (a, b) = (fit(g1, widest * m), fit(g2, widest * m));
        // By the raw colours, and by the optical depths.
        let tau_gradient = fit(&mut self.tau_gradient, m);
        tau_gradient[count..].fill(0.0);
        for c in 0..3 {
            a[c * m + count..(c + 1) * m].fill(0.0);
        }
        let longest = self.ray_starts.windows(2).map(|r| r[1] - r[0]).max().unwrap_or(0);
        let along = fit(g3, 5 * longest);
        let (shade, rest) = along.split_at_mut(longest);
        let (transmittance, rest) = rest.split_at_mut(longest);
        let (weight, rest) = rest.split_at_mut(longest);
        let (t, by_depth) = rest.split_at_mut(longest);
        for (r, range) in self.ray_starts.windows(2).enumerate() {
            let (g, background) = (colour_gradients[r], backgrounds[r]);
            let places = &self.along[range[0]..range[1]];
            for (j, &k) in places.iter().enumerate() {
                let (k, i) = (k as usize, self.kept[k as usize] as usize);
                (transmittance[j], weight[j], t[j]) = (self.transmittance[i], self.weight[i], self.t[i]);
                shade[j] = 0.0;
                for c in 0..3 {
                    let colour = self.colour[c * m + k];
                    shade[j] = g[c].mul_add(colour, shade[j]);
                    a[c * m + k] = g[c] * weight[j] * colour * (1.0 - colour);
                }
            }
            let seen_behind: f32 = (0..3).map(|c| g[c] * background[c]).sum();
            let behind = self.sums[r].transmittance * seen_behind;
            let len = places.len();
            let floater = regularisers.floater_loss * self.sums[r].transmittance;
            if floater > 0.0 {
                for (shade, &k) in shade.iter_mut().zip(places) {
                    let colour = std::array::from_fn(|c| self.colour[c * m + k as usize]);
                    *shade = floater.mul_add(likeness(colour, background), *shade);
                }
            }
            if regularisers.distortion > 0.0 {
                add_distortion_gradients(&t[..len], &weight[..len], field.step(), regularisers.distortion, &mut shade[..len]);
            }
            optical_depth_gradients(&shade[..len], &transmittance[..len], &weight[..len], behind, &mut by_depth[..len]);
            for (&k, &gradient) in places.iter().zip(&by_depth[..len]) {
                tau_gradient[k as usize] = gradient;
            }
        }

        let [first, second, third] = field.layers.colour;
        let [hidden1, hidden2] = &self.colour_hidden;
        let input = &self.colour_in[..COLOUR_INPUTS * m];
        let (hidden1, hidden2) = (&hidden1[..first.outputs * m], &hidden2[..second.outputs * m]);
        let mut back = |layer: Layer, x: &[f32], after: After<'_>, a: &mut [f32], b: &mut [f32]| {
            let dy = &a[..layer.outputs * m];
            add_outer(x, dy, &mut lanes[layer.offset * LANES..layer.range().end * LANES], layer.inputs, layer.outputs, m);
            multiply(&transposed[layer.range()], dy, &mut b[..layer.inputs * m], layer.outputs, layer.inputs, m, after);
        };
        back(third, hidden2, After::Gate(hidden2), a, b);
        back(second, hidden1, After::Gate(hidden1), b, a);
        back(first, input, After::Linear, a, b);

        // Row 0 is the raw density; rows 1.. are the colour network's inputs, whose direction part ends here.
        let density = &mut *a;
        let raw = |round: &Round, i: u32| self.density[DENSITY_OUTPUTS * round.start + (i as usize - round.start)];
        for (round, range) in kept_ranges(&self.rounds, count) {
            for k in range {
                let i = self.kept[k];
                let slope = if raw(round, i) < MAX_RAW { self.tau[i as usize] } else { 0.0 };
                density[k] = tau_gradient[k] * slope;
            }
        }
        density[count..m].fill(0.0);
        density[m..DENSITY_OUTPUTS * m].copy_from_slice(&b[..(DENSITY_OUTPUTS - 1) * m]);
        let [first, second] = field.layers.density;
        let features = fit(&mut self.kept_features, first.inputs * m);
        gather(&self.rounds, &self.kept, &self.features, first.inputs, 0, features, m);
        let hidden = fit(&mut self.kept_hidden, first.outputs * m);
        gather(&self.rounds, &self.kept, &self.hidden, first.outputs, 0, hidden, m);
        back(second, hidden, After::Gate(hidden), density, b);
        back(first, features, After::Linear, b, density);

        into.positions.extend(self.kept.iter().map(|&i| self.marched[i as usize]));
        into.levels.resize_with(field.levels.len(), Vec::new);
        for (list, rows) in into.levels.iter_mut().zip(density.chunks_exact(FEATURES * m)) {
            list.extend((0..count).map(|k| -> [f32; FEATURES] { std::array::from_fn(|f| rows[f * m + k]) }));
        }
    }
}

/// Each round and the places of its samples in the list of those that count.
fn kept_ranges(rounds: &[Round], count: usize) -> impl Iterator<Item = (&Round, std::ops::Range<usize>)> {
    let ends = rounds.iter().skip(1).map(|r| r.kept).chain([count]);
    rounds.iter().zip(ends).map(|(round, end)| (round, round.kept..end))
}

/// Copies the kept samples' columns out of the rounds, whose `rows` rows lie in `from`, to rows of stride `m`, leaving out the
/// first `skipped` rows; what pads the result is 0.
fn gather(rounds: &[Round], kept: &[u32], from: &[f32], rows: usize, skipped: usize, to: &mut [f32], m: usize) {
    for (round, range) in kept_ranges(rounds, kept.len()) {
        for (row, target) in (skipped..rows).zip(to.chunks_exact_mut(m.max(1))) {
            let source = &from[rows * round.start + row * round.n..][..round.n];
            for (value, &i) in target[range.clone()].iter_mut().zip(&kept[range.clone()]) {
                *value = source[i as usize - round.start];
            }
        }
    }
    for target in to.chunks_exact_mut(m.max(1)) {
        target[kept.len()..].fill(0.0);
    }
}

impl Chunk {
    /// Samples marched in the last forward pass.
    pub(crate) fn samples(&self) -> usize {
        self.samples
    }

    /// Samples that got a colour in the last forward pass.
    pub(crate) fn coloured(&self) -> usize {
        self.kept.len()
    }
}

#[cfg(test)]
impl Chunk {
    /// Positions of each ray's samples that count, from front to back.
    pub(crate) fn kept_positions(&self) -> Vec<Vec<[f32; 3]>> {
        let at = |&k: &u32| self.marched[self.kept[k as usize] as usize];
        self.ray_starts.windows(2).map(|r| self.along[r[0]..r[1]].iter().map(at).collect()).collect()
    }
}

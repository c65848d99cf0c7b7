//! A few rays at a time through the whole field and back, in buffers that are reused: nothing is allocated once they have grown.

use crate::composite::{MAX_RAW, optical_depth_gradients, optical_depths, weights};
use crate::field::{COLOUR_INPUTS, DENSITY_OUTPUTS, Field};
use crate::grid::{FEATURES, encode};
use crate::math::{exp, sigmoid};
use crate::mlp::{After, Layer, add_outer, multiply};
use crate::ray::UnitRay;
use crate::simd::{LANES, kernel};
use crate::spherical::{BASIS, spherical_harmonics};

/// Samples behind this transmittance, and those of less weight, get no colour and no gradient.
const FAINT: f32 = 1e-4;

/// What one ray adds up to.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RaySum {
    pub(crate) colour: [f32; 3],
    pub(crate) transmittance: f32,
    /// Σ w over the samples with colour.
    pub(crate) weight: f32,
    /// Σ w·t over the same, in cube sides.
    pub(crate) distance: f32,
    /// Where the transmittance falls below one half, in cube sides.
    pub(crate) median: Option<f32>,
}

/// Gradients by grid features, in sample order: what is scattered once all shards are done.
#[derive(Debug, Default)]
pub(crate) struct FeatureGradients {
    pub(crate) positions: Vec<[f32; 3]>,
    /// One list a level, as long as `positions`.
    pub(crate) levels: Vec<Vec<[f32; FEATURES]>>,
}

/// Buffers of one worker. "Rows" are one feature of all samples; `n` samples are all, `m` those that count.
#[derive(Debug, Default)]
pub(crate) struct Chunk {
    pub(crate) sums: Vec<RaySum>,
    /// First sample of each ray, and the end.
    starts: Vec<usize>,
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
    /// Samples that count, and the first of each ray among them.
    kept: Vec<u32>,
    kept_starts: Vec<usize>,
    kept_features: Vec<f32>,
    kept_hidden: Vec<f32>,
    colour_in: Vec<f32>,
    colour_hidden: [Vec<f32>; 2],
    colour: Vec<f32>,
    gradient: [Vec<f32>; 3],
    tau_gradient: Vec<f32>,
}

/// At least `len` floats; what was in them doesn't matter.
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
    chunk.density_network(field, n);
    let raw = &chunk.density[..n];
    let density = fit(&mut chunk.tau, n);
    optical_depths(raw, 1.0, density);
    density
}

impl Chunk {
    /// Features, hidden layer and density of the positions in `self.positions` (three rows of n).
    fn density_network(&mut self, field: &Field, n: usize) {
        if n == 0 {
            return;
        }
        let positions = &self.positions[..3 * n];
        let features = fit(&mut self.features, field.levels.len() * FEATURES * n);
        for (level, rows) in field.levels.iter().zip(features.chunks_exact_mut(FEATURES * n)) {
            encode(level, &field.grid[level.range()], positions, rows, n);
        }
        let [first, second] = field.layers.density;
        let hidden = fit(&mut self.hidden, first.outputs * n);
        multiply(&field.network[first.range()], features, hidden, first.inputs, first.outputs, n, After::Relu);
        let density = fit(&mut self.density, DENSITY_OUTPUTS * n);
        multiply(&field.network[second.range()], hidden, density, second.inputs, second.outputs, n, After::Linear);
    }

    /// Renders rays into [`Chunk::sums`]. `offsets` shift each ray's samples by a share of a step.
    pub(crate) fn forward(&mut self, field: &Field, rays: &[UnitRay], offsets: &[f32]) {
        let step = field.step();
        self.t.clear();
        self.marched.clear();
        self.starts.clear();
        for (ray, &offset) in rays.iter().zip(offsets) {
            self.starts.push(self.t.len());
            let (t, marched) = (&mut self.t, &mut self.marched);
            field.occupancy.march(ray, step, offset, |at, p| {
                t.push(at);
                marched.push(p);
            });
        }
        self.starts.push(self.t.len());
        let count = self.t.len();
        let n = count.next_multiple_of(LANES);
        let positions = fit(&mut self.positions, 3 * n);
        for (axis, row) in positions.chunks_exact_mut(n.max(1)).enumerate() {
            for (value, p) in row.iter_mut().zip(&self.marched) {
                *value = p[axis];
            }
            row[count..].fill(0.0);
        }
        self.density_network(field, n);
        let tau = fit(&mut self.tau, n);
        optical_depths(&self.density[..n], step, tau);
        let before = fit(&mut self.before, n);
        self.sums.clear();
        for range in self.starts.windows(2) {
            let (mut depth, mut median) = (0.0f32, None);
            for i in range[0]..range[1] {
                before[i] = depth;
                depth += tau[i];
                if median.is_none() && depth > std::f32::consts::LN_2 {
                    median = Some(self.t[i]);
                }
            }
            let transmittance = if range[0] == range[1] { 1.0 } else { exp(-depth) };
            self.sums.push(RaySum { transmittance, median, ..RaySum::default() });
        }
        before[count..].fill(0.0);
        let (transmittance, weight) = (fit(&mut self.transmittance, n), fit(&mut self.weight, n));
        weights(before, tau, transmittance, weight);
        self.kept.clear();
        self.kept_starts.clear();
        for range in self.starts.windows(2) {
            self.kept_starts.push(self.kept.len());
            self.kept.extend((range[0]..range[1]).filter(|&i| transmittance[i] > FAINT && weight[i] > FAINT).map(|i| i as u32));
        }
        self.kept_starts.push(self.kept.len());
        self.shade(field, rays, n);
    }

    /// Colours of the samples that count, and each ray's sums.
    fn shade(&mut self, field: &Field, rays: &[UnitRay], n: usize) {
        let m = self.kept.len().next_multiple_of(LANES);
        let input = fit(&mut self.colour_in, COLOUR_INPUTS * m);
        gather(
            &self.kept,
            &self.density[n.min(self.density.len())..],
            n,
            DENSITY_OUTPUTS - 1,
            &mut input[..(DENSITY_OUTPUTS - 1) * m],
            m,
        );
        let directions = &mut input[(DENSITY_OUTPUTS - 1) * m..];
        for (ray, range) in rays.iter().zip(self.kept_starts.windows(2)) {
            if range[0] < range[1] {
                let basis = spherical_harmonics(ray.direction);
                for k in 0..BASIS {
                    directions[k * m + range[0]..k * m + range[1]].fill(basis[k]);
                }
            }
        }
        for k in 0..BASIS {
            directions[k * m + self.kept.len()..(k + 1) * m].fill(0.0);
        }
        let [first, second, third] = field.layers.colour;
        let [hidden1, hidden2] = &mut self.colour_hidden;
        let (hidden1, hidden2) = (fit(hidden1, first.outputs * m), fit(hidden2, second.outputs * m));
        multiply(&field.network[first.range()], input, hidden1, first.inputs, first.outputs, m, After::Relu);
        multiply(&field.network[second.range()], hidden1, hidden2, second.inputs, second.outputs, m, After::Relu);
        let colour = fit(&mut self.colour, 3 * m);
        multiply(&field.network[third.range()], hidden2, colour, third.inputs, third.outputs, m, After::Linear);
        sigmoids(colour);
        for (sum, range) in self.sums.iter_mut().zip(self.kept_starts.windows(2)) {
            for k in range[0]..range[1] {
                let i = self.kept[k] as usize;
                let w = self.weight[i];
                for c in 0..3 {
                    sum.colour[c] = w.mul_add(colour[c * m + k], sum.colour[c]);
                }
                sum.weight += w;
                sum.distance = w.mul_add(self.t[i], sum.distance);
            }
        }
    }

    /// Goes back from each ray's colour gradient: adds to the networks' partial sums (`lanes`) and appends to `into`.
    /// `transposed` are the weights output by output.
    pub(crate) fn backward(
        &mut self,
        field: &Field,
        transposed: &[f32],
        colour_gradients: &[[f32; 3]],
        backgrounds: &[[f32; 3]],
        lanes: &mut [f32],
        into: &mut FeatureGradients,
    ) {
        let count = self.kept.len();
        if count == 0 {
            return;
        }
        let m = count.next_multiple_of(LANES);
        let n = self.t.len().next_multiple_of(LANES);
        let [g1, g2, g3] = &mut self.gradient;
        let widest = field.layers.all().iter().map(|l| l.inputs.max(l.outputs)).max().unwrap_or(0);
        let (a, b) = (fit(g1, widest * m), fit(g2, widest * m));
        // By the raw colours, and by the optical depths.
        let tau_gradient = fit(&mut self.tau_gradient, m);
        tau_gradient[count..].fill(0.0);
        for c in 0..3 {
            a[c * m + count..(c + 1) * m].fill(0.0);
        }
        let longest = self.kept_starts.windows(2).map(|r| r[1] - r[0]).max().unwrap_or(0);
        let along = fit(g3, 3 * longest);
        let (shade, rest) = along.split_at_mut(longest);
        let (transmittance, weight) = rest.split_at_mut(longest);
        for (r, range) in self.kept_starts.windows(2).enumerate() {
            let (g, background) = (colour_gradients[r], backgrounds[r]);
            let len = range[1] - range[0];
            for (j, k) in (range[0]..range[1]).enumerate() {
                let i = self.kept[k] as usize;
                (transmittance[j], weight[j]) = (self.transmittance[i], self.weight[i]);
                shade[j] = 0.0;
                for c in 0..3 {
                    let colour = self.colour[c * m + k];
                    shade[j] = g[c].mul_add(colour, shade[j]);
                    a[c * m + k] = g[c] * weight[j] * colour * (1.0 - colour);
                }
            }
            let seen_behind: f32 = (0..3).map(|c| g[c] * background[c]).sum();
            let behind = self.sums[r].transmittance * seen_behind;
            optical_depth_gradients(
                &shade[..len],
                &transmittance[..len],
                &weight[..len],
                behind,
                &mut tau_gradient[range[0]..range[1]],
            );
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
        for k in 0..count {
            let i = self.kept[k] as usize;
            let slope = if self.density[i] < MAX_RAW { self.tau[i] } else { 0.0 };
            density[k] = tau_gradient[k] * slope;
        }
        density[count..m].fill(0.0);
        density[m..DENSITY_OUTPUTS * m].copy_from_slice(&b[..(DENSITY_OUTPUTS - 1) * m]);
        let [first, second] = field.layers.density;
        let features = fit(&mut self.kept_features, first.inputs * m);
        gather(&self.kept, &self.features, n, first.inputs, features, m);
        let hidden = fit(&mut self.kept_hidden, first.outputs * m);
        gather(&self.kept, &self.hidden, n, first.outputs, hidden, m);
        back(second, hidden, After::Gate(hidden), density, b);
        back(first, features, After::Linear, b, density);

        into.positions.extend(self.kept.iter().map(|&i| self.marched[i as usize]));
        into.levels.resize_with(field.levels.len(), Vec::new);
        for (list, rows) in into.levels.iter_mut().zip(density.chunks_exact(FEATURES * m)) {
            list.extend((0..count).map(|k| -> [f32; FEATURES] { std::array::from_fn(|f| rows[f * m + k]) }));
        }
    }
}

/// Copies the kept samples' columns of `rows` rows (stride `n`) to rows of stride `m`; what pads them is 0.
fn gather(kept: &[u32], from: &[f32], n: usize, rows: usize, to: &mut [f32], m: usize) {
    for r in 0..rows {
        let source = &from[r * n..];
        let target = &mut to[r * m..(r + 1) * m];
        for (value, &i) in target.iter_mut().zip(kept) {
            *value = source[i as usize];
        }
        target[kept.len()..].fill(0.0);
    }
}

impl Chunk {
    /// Samples marched in the last forward pass.
    pub(crate) fn samples(&self) -> usize {
        self.t.len()
    }
}

#[cfg(test)]
impl Chunk {
    /// Sample positions of each ray, and which of them got a colour.
    pub(crate) fn marched_and_kept(&self) -> (Vec<Vec<[f32; 3]>>, Vec<Vec<bool>>) {
        let ranges = self.starts.windows(2).map(|r| r[0]..r[1]);
        let kept = |i: usize| self.kept.binary_search(&(i as u32)).is_ok();
        (ranges.clone().map(|r| self.marched[r].to_vec()).collect(), ranges.map(|r| r.map(kept).collect()).collect())
    }
}

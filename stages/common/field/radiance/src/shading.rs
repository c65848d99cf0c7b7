//! Deferred shading (Hedman et al. 2021, "Baking neural radiance fields", SNeRG): view features are
//! composited along a ray. From these and the direction one small network per ray computes the view
//! colour, which is added to the raw colour of each of the ray's samples.

use crate::aligned::Aligned;
use crate::composite::optical_depth_gradients;
use crate::field::Field;
use crate::math::sigmoid;
use crate::math::spherical_harmonics;
use crate::mlp::Layers;
use crate::mlp::{After, Layer, add_outer, multiply};
use crate::ray::NormalizedRay;
use crate::regularisers::{Regularisers, ShadedRay};
use crate::samples::{Counted, RaySum, Samples};
use crate::spec::{
    DENSITY_OUTPUTS, FIRST_RAW_COLOUR, FIRST_VIEW_FEATURE, VIEW_FEATURES, VIEW_INPUTS,
};
use numerics::kernel;
use numerics::simd::LANES;

/// Buffers of the view network, one column per ray with samples, and of the samples' colours.
#[derive(Debug, Default)]
pub(crate) struct Shading {
    input: Aligned,
    hidden: [Aligned; 2],
    /// View-dependent part of raw colours: three rows.
    view_colour: Aligned,
    /// Colours: three rows, one column per sample that counts.
    colour: Aligned,
    gradient: [Aligned; 2],
    along: AlongRay,
}

/// One ray's samples from front to back.
#[derive(Debug, Default)]
struct AlongRay {
    transmittance: Aligned,
    weight: Aligned,
    t: Aligned,
    /// Gradient with respect to each sample's weight.
    by_weight: Aligned,
    /// Gradient with respect to each sample's optical depth.
    by_optical_depth: Aligned,
}

/// Inputs of a backward pass, one entry per ray.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RayGradients<'a> {
    /// Gradient with respect to the colour over the background.
    pub(crate) colours: &'a [[f32; 3]],
    pub(crate) backgrounds: &'a [[f32; 3]],
    /// Weights of the regularisers for one ray.
    pub(crate) regularisers: Regularisers,
}

/// The networks' transposed weights, and the sums of gradients with respect to the weights.
pub(crate) struct NetworkGradients<'a> {
    pub(crate) transposed: &'a [f32],
    pub(crate) sums: &'a mut [f32],
}

/// Input of a layer in the forward pass: rows of n.
#[derive(Clone, Copy)]
pub(crate) enum LayerInput<'a> {
    /// Input of the network.
    First(&'a [f32]),
    /// Output of the previous layer's ReLU.
    Hidden(&'a [f32]),
}

impl NetworkGradients<'_> {
    /// Propagates `dy`, the gradient with respect to a layer's outputs, to `dx`, the gradient with
    /// respect to the layer's input before any ReLU: rows of n. Adds the gradient with respect to
    /// the layer's weights.
    pub(crate) fn backward(
        &mut self,
        layer: Layer,
        input: LayerInput<'_>,
        n: usize,
        dy: &[f32],
        dx: &mut [f32],
    ) {
        let (x, after) = match input {
            LayerInput::First(x) => (x, After::Linear),
            LayerInput::Hidden(x) => (x, After::Gate(x)),
        };
        let dy = &dy[..layer.outputs * n];
        add_outer(x, dy, &mut self.sums[layer.range()], layer.inputs, layer.outputs, n);
        let dx = &mut dx[..layer.inputs * n];
        multiply(layer.transposed_matrix(self.transposed), dy, dx, n, after);
    }
}

kernel! {
    fn sigmoids<L>(values: &mut [f32]) {
        for v in values {
            *v = sigmoid(*v);
        }
    }
}

kernel! {
    /// Composites view features into the view network's `input`, one column per ray, and adds
    /// weights and distances to the rays' sums.
    fn composite<L>(samples: &Samples, counted: &Counted, rays: &[NormalizedRay],
        sums: &mut [RaySum], input: &mut [f32], n: usize) {
        for (column, &r) in counted.rays.iter().enumerate() {
            let (ray, sum) = (&rays[r as usize], &mut sums[r as usize]);
            let mut outputs = [0.0f32; DENSITY_OUTPUTS];
            for &k in counted.samples_of_ray(r) {
                let i = counted.sample[k as usize] as usize;
                let w = samples.weight[i];
                for (sum, value) in outputs.iter_mut().zip(&counted.outputs[k as usize]) {
                    *sum = w.mul_add(*value, *sum);
                }
                sum.weight += w;
                sum.distance = w.mul_add(ray.distance(samples.marched.t[i]), sum.distance);
            }
            let features = outputs[FIRST_VIEW_FEATURE..].iter().copied();
            for (row, value) in features.chain(spherical_harmonics(ray.view)).enumerate() {
                input[row * n + column] = value;
            }
        }
    }
}

kernel! {
    /// Adds each ray's view colour to its samples' raw colours: `colour` has three rows with one
    /// column per sample that counts, `view_colour` three rows of n.
    fn raw_colours<L>(counted: &Counted, view_colour: &[f32], n: usize, colour: &mut [f32]) {
        let m = counted.sample.len();
        for (column, &r) in counted.rays.iter().enumerate() {
            let view_colour = [0, 1, 2].map(|c| view_colour[c * n + column]);
            for &k in counted.samples_of_ray(r) {
                let k = k as usize;
                for c in 0..3 {
                    colour[c * m + k] = counted.outputs[k][FIRST_RAW_COLOUR + c] + view_colour[c];
                }
            }
        }
    }
}

kernel! {
    /// Adds the samples' weighted colours to their rays' sums.
    fn sum_colours<L>(samples: &Samples, counted: &Counted, colour: &[f32], sums: &mut [RaySum]) {
        let m = counted.sample.len();
        for &r in &counted.rays {
            let sum = &mut sums[r as usize].colour;
            for &k in counted.samples_of_ray(r) {
                let w = samples.weight[counted.sample[k as usize] as usize];
                for c in 0..3 {
                    sum[c] = w.mul_add(colour[c * m + k as usize], sum[c]);
                }
            }
        }
    }
}

kernel! {
    /// Computes the gradient with respect to each ray's view colour, three rows of n, from the
    /// samples' colours `colour` and the gradients `colours` with respect to each ray's colour.
    fn view_colour_gradients<L>(
        samples: &Samples, counted: &Counted, colour: &[f32], colours: &[[f32; 3]],
        gradient: &mut [f32], n: usize,
    ) {
        let m = counted.sample.len();
        for (column, &r) in counted.rays.iter().enumerate() {
            let g = colours[r as usize];
            let mut sum = [0.0f32; 3];
            for &k in counted.samples_of_ray(r) {
                let w = samples.weight[counted.sample[k as usize] as usize];
                for c in 0..3 {
                    let colour = colour[c * m + k as usize];
                    sum[c] = (g[c] * w).mul_add(colour * (1.0 - colour), sum[c]);
                }
            }
            for c in 0..3 {
                gradient[c * n + column] = sum[c];
            }
        }
    }
}

/// Returns the sum of products, in one order on every machine.
#[inline(always)]
pub(crate) fn dot(a: &[f32; DENSITY_OUTPUTS], b: &[f32; DENSITY_OUTPUTS]) -> f32 {
    let mut products: [f32; DENSITY_OUTPUTS] = std::array::from_fn(|o| a[o] * b[o]);
    let mut width = DENSITY_OUTPUTS / 2;
    while width > 0 {
        for o in 0..width {
            products[o] += products[o + width];
        }
        width /= 2;
    }
    products[0]
}

/// Gradients of one ray, from which its samples' gradients follow.
#[derive(Clone, Copy)]
struct UpstreamGradient<'a> {
    /// Indices of the ray's samples among those that count, from front to back.
    indices: &'a [u32],
    /// Gradient with respect to the ray's colour.
    colour: [f32; 3],
    /// Gradient with respect to the composited outputs of the density network.
    composited: [f32; DENSITY_OUTPUTS],
}

kernel! {
    /// Computes the gradients of one ray's samples with respect to the density network's outputs,
    /// except the raw density. Fills `along` with transmittances, weights, t and the gradient with
    /// respect to each weight.
    fn gradients_along<L>(
        samples: &Samples, counted: &Counted, colour: &[f32], ray: &UpstreamGradient<'_>,
        along: &mut AlongRay, gradients: &mut [[f32; DENSITY_OUTPUTS]],
    ) {
        let (indices, g, composited) = (ray.indices, ray.colour, &ray.composited);
        let m = counted.sample.len();
        for (j, &k) in indices.iter().enumerate() {
            let (k, i) = (k as usize, counted.sample[k as usize] as usize);
            let w = samples.weight[i];
            (along.transmittance[j], along.weight[j], along.t[j]) = (samples.transmittance[i], w,
                samples.marched.t[i]);
            let mut by_weight = dot(composited, &counted.outputs[k]);
            let gradient = &mut gradients[k];
            *gradient = composited.map(|c| w * c);
            for c in 0..3 {
                let colour = colour[c * m + k];
                by_weight = g[c].mul_add(colour, by_weight);
                gradient[FIRST_RAW_COLOUR + c] = g[c] * w * colour * (1.0 - colour);
            }
            along.by_weight[j] = by_weight;
        }
    }
}

/// Runs the view network on `n` columns of `input`, and returns the view colours: three rows of n.
pub(crate) fn view_network<'a>(
    field: &Field,
    input: &[f32],
    hidden: &mut [Aligned; 2],
    view_colour: &'a mut Aligned,
    n: usize,
) -> &'a mut [f32] {
    let Layers { view, .. } = field.layers;
    let [hidden1, hidden2] = hidden;
    let hidden1 = hidden1.grow(view[0].outputs * n);
    multiply(view[0].matrix(&field.network), input, hidden1, n, After::Relu);
    let hidden2 = hidden2.grow(view[1].outputs * n);
    multiply(view[1].matrix(&field.network), hidden1, hidden2, n, After::Relu);
    let view_colour = view_colour.grow(view[2].outputs * n);
    multiply(view[2].matrix(&field.network), hidden2, view_colour, n, After::Linear);
    view_colour
}

impl AlongRay {
    fn grow(&mut self, longest: usize) {
        for buffer in [
            &mut self.transmittance,
            &mut self.weight,
            &mut self.t,
            &mut self.by_weight,
            &mut self.by_optical_depth,
        ] {
            buffer.grow(longest);
        }
    }
}

impl Shading {
    /// Computes the colours of the samples that count, and each ray's sums.
    pub(crate) fn forward(
        &mut self,
        field: &Field,
        rays: &[NormalizedRay],
        samples: &Samples,
        counted: &Counted,
        sums: &mut [RaySum],
    ) {
        let (m, n) = (counted.sample.len(), counted.rays.len().next_multiple_of(LANES));
        let input = self.input.grow(VIEW_INPUTS * n);
        for row in input.chunks_exact_mut(n.max(1)) {
            row[counted.rays.len()..].fill(0.0);
        }
        composite(samples, counted, rays, sums, input, n);
        let view_colour = view_network(field, input, &mut self.hidden, &mut self.view_colour, n);
        let colour = self.colour.grow(3 * m);
        raw_colours(counted, view_colour, n, colour);
        sigmoids(colour);
        sum_colours(samples, counted, colour, sums);
    }

    /// Propagates gradients from rays to the density network's outputs of every sample that counts,
    /// and adds the view network's gradients.
    pub(crate) fn backward(
        &mut self,
        field: &Field,
        (samples, counted, sums): (&Samples, &Counted, &[RaySum]),
        upstream: RayGradients<'_>,
        network: &mut NetworkGradients<'_>,
        gradients: &mut Vec<[f32; DENSITY_OUTPUTS]>,
    ) {
        let (m, n) = (counted.sample.len(), counted.rays.len().next_multiple_of(LANES));
        let colour = &self.colour[..3 * m];
        let Layers { view: [first, second, third], .. } = field.layers;
        let widest = first.outputs.max(second.outputs).max(VIEW_INPUTS);
        let [a, b] = &mut self.gradient;
        let (a, b) = (a.grow(widest * n), b.grow(widest * n));
        for row in a[..3 * n].chunks_exact_mut(n) {
            row[counted.rays.len()..].fill(0.0);
        }
        view_colour_gradients(samples, counted, colour, upstream.colours, a, n);
        let [hidden1, hidden2] = &self.hidden;
        let (hidden1, hidden2) = (&hidden1[..first.outputs * n], &hidden2[..second.outputs * n]);
        network.backward(third, LayerInput::Hidden(hidden2), n, a, b);
        network.backward(second, LayerInput::Hidden(hidden1), n, b, a);
        network.backward(first, LayerInput::First(&self.input[..VIEW_INPUTS * n]), n, a, b);

        gradients.clear();
        gradients.resize(m, [0.0; DENSITY_OUTPUTS]);
        let along = &mut self.along;
        along.grow(counted.max_samples_per_ray());
        let step = field.march_step();
        let channels: [&[f32]; 3] = std::array::from_fn(|c| &colour[c * m..(c + 1) * m]);
        for (column, &r) in counted.rays.iter().enumerate() {
            let (g, background) = (upstream.colours[r as usize], upstream.backgrounds[r as usize]);
            let (indices, transmittance) =
                (counted.samples_of_ray(r), sums[r as usize].transmittance);
            let len = indices.len();
            let mut composited = [0.0; DENSITY_OUTPUTS];
            for f in 0..VIEW_FEATURES {
                composited[FIRST_VIEW_FEATURE + f] = b[f * n + column];
            }
            let ray_gradient = UpstreamGradient { indices, colour: g, composited };
            gradients_along(samples, counted, colour, &ray_gradient, along, gradients);
            let (t, weight) = (&along.t[..len], &along.weight[..len]);
            let ray = ShadedRay { t, weight, step, channels, indices, transmittance, background };
            let by_weight = &mut along.by_weight[..len];
            upstream.regularisers.add_gradients(&ray, by_weight);
            let behind = transmittance * (0..3).map(|c| g[c] * background[c]).sum::<f32>();
            optical_depth_gradients(
                by_weight,
                &along.transmittance[..len],
                weight,
                behind,
                &mut along.by_optical_depth[..len],
            );
            for (&k, &by_optical_depth) in indices.iter().zip(&*along.by_optical_depth) {
                gradients[k as usize][0] = by_optical_depth * counted.outputs[k as usize][0];
            }
        }
    }
}

//! Deferred shading (Hedman et al. 2021, "Baking neural radiance fields", SNeRG): view features are
//! composited along a ray, one small network makes of them and the direction what is added to the
//! raw colours of all the ray's samples. So colours cost a network a ray.

use crate::aligned::Aligned;
use crate::composite::optical_depth_gradients;
use crate::field::Field;
use crate::math::sigmoid;
use crate::mlp::Layers;
use crate::mlp::{After, Layer, add_outer, multiply};
use crate::ray::NormalizedRay;
use crate::regularisers::{LossGradients, Regularisers, ShadedRay};
use crate::samples::{Counted, RaySum, Samples};
use crate::simd::{LANES, kernel};
use crate::spec::{DENSITY_OUTPUTS, RAW_COLOUR, VIEW_FEATURE, VIEW_FEATURES, VIEW_INPUTS};
use crate::spherical::spherical_harmonics;

/// Buffers of the view network, a column a ray that has samples, and of the samples' colours.
#[derive(Debug, Default)]
pub(crate) struct Shading {
    input: Aligned,
    hidden: [Aligned; 2],
    /// What is added to the raw colours: three rows.
    added: Aligned,
    /// Colours: three rows, a column a sample that counts.
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
    by_weight: Aligned,
    by_depth: Aligned,
}

/// What a backward pass starts from, an entry a ray.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RayGradients<'a> {
    /// By the colour over the background.
    pub(crate) colours: &'a [[f32; 3]],
    pub(crate) backgrounds: &'a [[f32; 3]],
    /// Their weights for one ray.
    pub(crate) regularisers: Regularisers,
}

/// The networks' weights output by output, and where their gradients are added.
pub(crate) struct NetworkGradients<'a> {
    pub(crate) transposed: &'a [f32],
    pub(crate) sums: &'a mut [f32],
}

/// What a layer got on the way forward: rows of n.
#[derive(Clone, Copy)]
pub(crate) enum LayerInput<'a> {
    /// What the network got.
    First(&'a [f32]),
    /// What the layer before gave, through its ReLU.
    Hidden(&'a [f32]),
}

impl NetworkGradients<'_> {
    /// Goes back through a layer from `dy`, the gradient by its outputs, to `dx`, the gradient by
    /// its input before any ReLU: rows of n. Adds the gradient by its weights.
    pub(crate) fn back(
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
    /// Composites view features into the view network's `input`, a column a ray, and adds weights
    /// and distances to the rays' sums.
    fn composite<L>(samples: &Samples, counted: &Counted, rays: &[NormalizedRay],
        sums: &mut [RaySum], input: &mut [f32], n: usize) {
        for (column, &r) in counted.rays.iter().enumerate() {
            let (ray, sum) = (&rays[r as usize], &mut sums[r as usize]);
            let mut outputs = [0.0f32; DENSITY_OUTPUTS];
            for &k in counted.of_ray(r) {
                let i = counted.sample[k as usize] as usize;
                let w = samples.weight[i];
                for (sum, value) in outputs.iter_mut().zip(&counted.outputs[k as usize]) {
                    *sum = w.mul_add(*value, *sum);
                }
                sum.weight += w;
                sum.distance = w.mul_add(ray.distance(samples.marched.t[i]), sum.distance);
            }
            let features = outputs[VIEW_FEATURE..].iter().copied();
            for (row, value) in features.chain(spherical_harmonics(ray.view)).enumerate() {
                input[row * n + column] = value;
            }
        }
    }
}

kernel! {
    /// Adds each ray's part to its samples' raw colours: `colour` has three rows, a column a sample
    /// that counts; `added` has three rows of n.
    fn raw_colours<L>(counted: &Counted, added: &[f32], n: usize, colour: &mut [f32]) {
        let m = counted.sample.len();
        for (column, &r) in counted.rays.iter().enumerate() {
            let added = [0, 1, 2].map(|c| added[c * n + column]);
            for &k in counted.of_ray(r) {
                let k = k as usize;
                for c in 0..3 {
                    colour[c * m + k] = counted.outputs[k][RAW_COLOUR + c] + added[c];
                }
            }
        }
    }
}

kernel! {
    /// Adds the samples' colours to their rays'.
    fn sum_colours<L>(samples: &Samples, counted: &Counted, colour: &[f32], sums: &mut [RaySum]) {
        let m = counted.sample.len();
        for &r in &counted.rays {
            let sum = &mut sums[r as usize].colour;
            for &k in counted.of_ray(r) {
                let w = samples.weight[counted.sample[k as usize] as usize];
                for c in 0..3 {
                    sum[c] = w.mul_add(colour[c * m + k as usize], sum[c]);
                }
            }
        }
    }
}

kernel! {
    /// Gradient by what was added to each ray's raw colours: `gradient` has three rows of n.
    /// `colour` has the samples' colours, `colours` the gradient by each ray's.
    fn gradients_by_added<L>(
        samples: &Samples, counted: &Counted, colour: &[f32], colours: &[[f32; 3]],
        gradient: &mut [f32], n: usize,
    ) {
        let m = counted.sample.len();
        for (column, &r) in counted.rays.iter().enumerate() {
            let g = colours[r as usize];
            let mut sum = [0.0f32; 3];
            for &k in counted.of_ray(r) {
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

/// Sum of products, in one order on every machine.
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

/// A ray's gradients, from which those of its samples follow.
#[derive(Clone, Copy)]
struct AtRay<'a> {
    /// Places of its samples among those that count, from front to back.
    places: &'a [u32],
    /// Gradient by its colour.
    colour: [f32; 3],
    /// Gradient by its composited outputs of the density network.
    composited: [f32; DENSITY_OUTPUTS],
}

kernel! {
    /// Gradients of one ray's samples by the density network's outputs, but for that by the raw
    /// density; `along` gets transmittances, weights, places and the gradient by each weight.
    fn gradients_along<L>(
        samples: &Samples, counted: &Counted, colour: &[f32], ray: &AtRay<'_>, along: &mut AlongRay,
        gradients: &mut [[f32; DENSITY_OUTPUTS]],
    ) {
        let (places, g, composited) = (ray.places, ray.colour, &ray.composited);
        let m = counted.sample.len();
        for (j, &k) in places.iter().enumerate() {
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
                gradient[RAW_COLOUR + c] = g[c] * w * colour * (1.0 - colour);
            }
            along.by_weight[j] = by_weight;
        }
    }
}

/// Runs the view network on `n` columns of its `input`; what is added to raw colours: three rows of
/// n.
pub(crate) fn view_network<'a>(
    field: &Field,
    input: &[f32],
    hidden: &mut [Aligned; 2],
    added: &'a mut Aligned,
    n: usize,
) -> &'a mut [f32] {
    let Layers { view, .. } = field.layers;
    let [hidden1, hidden2] = hidden;
    let hidden1 = hidden1.fit(view[0].outputs * n);
    multiply(view[0].matrix(&field.network), input, hidden1, n, After::Relu);
    let hidden2 = hidden2.fit(view[1].outputs * n);
    multiply(view[1].matrix(&field.network), hidden1, hidden2, n, After::Relu);
    let added = added.fit(view[2].outputs * n);
    multiply(view[2].matrix(&field.network), hidden2, added, n, After::Linear);
    added
}

impl AlongRay {
    fn fit(&mut self, longest: usize) {
        for buffer in [
            &mut self.transmittance,
            &mut self.weight,
            &mut self.t,
            &mut self.by_weight,
            &mut self.by_depth,
        ] {
            buffer.fit(longest);
        }
    }
}

impl Shading {
    /// Colours of the samples that count, and each ray's sums.
    pub(crate) fn forward(
        &mut self,
        field: &Field,
        rays: &[NormalizedRay],
        samples: &Samples,
        counted: &Counted,
        sums: &mut [RaySum],
    ) {
        let (m, n) = (counted.sample.len(), counted.rays.len().next_multiple_of(LANES));
        let input = self.input.fit(VIEW_INPUTS * n);
        for row in input.chunks_exact_mut(n.max(1)) {
            row[counted.rays.len()..].fill(0.0);
        }
        composite(samples, counted, rays, sums, input, n);
        let added = view_network(field, input, &mut self.hidden, &mut self.added, n);
        let colour = self.colour.fit(3 * m);
        raw_colours(counted, added, n, colour);
        sigmoids(colour);
        sum_colours(samples, counted, colour, sums);
    }

    /// Goes back from rays to the density network's outputs of every sample that counts, and adds
    /// the view network's gradients.
    pub(crate) fn backward(
        &mut self,
        field: &Field,
        (samples, counted, sums): (&Samples, &Counted, &[RaySum]),
        towards: RayGradients<'_>,
        network: &mut NetworkGradients<'_>,
        gradients: &mut Vec<[f32; DENSITY_OUTPUTS]>,
    ) {
        let (m, n) = (counted.sample.len(), counted.rays.len().next_multiple_of(LANES));
        let colour = &self.colour[..3 * m];
        let Layers { view: [first, second, third], .. } = field.layers;
        let widest = first.outputs.max(second.outputs).max(VIEW_INPUTS);
        let [a, b] = &mut self.gradient;
        let (a, b) = (a.fit(widest * n), b.fit(widest * n));
        for row in a[..3 * n].chunks_exact_mut(n) {
            row[counted.rays.len()..].fill(0.0);
        }
        gradients_by_added(samples, counted, colour, towards.colours, a, n);
        let [hidden1, hidden2] = &self.hidden;
        let (hidden1, hidden2) = (&hidden1[..first.outputs * n], &hidden2[..second.outputs * n]);
        network.back(third, LayerInput::Hidden(hidden2), n, a, b);
        network.back(second, LayerInput::Hidden(hidden1), n, b, a);
        network.back(first, LayerInput::First(&self.input[..VIEW_INPUTS * n]), n, a, b);

        gradients.clear();
        gradients.resize(m, [0.0; DENSITY_OUTPUTS]);
        let along = &mut self.along;
        along.fit(counted.longest());
        let step = field.step();
        let channels: [&[f32]; 3] = std::array::from_fn(|c| &colour[c * m..(c + 1) * m]);
        for (column, &r) in counted.rays.iter().enumerate() {
            let (g, background) = (towards.colours[r as usize], towards.backgrounds[r as usize]);
            let (places, transmittance) = (counted.of_ray(r), sums[r as usize].transmittance);
            let len = places.len();
            let mut composited = [0.0; DENSITY_OUTPUTS];
            (0..VIEW_FEATURES).for_each(|f| composited[VIEW_FEATURE + f] = b[f * n + column]);
            let at = AtRay { places, colour: g, composited };
            gradients_along(samples, counted, colour, &at, along, gradients);
            let (t, weight) = (&along.t[..len], &along.weight[..len]);
            let ray = ShadedRay { t, weight, step, channels, places, transmittance, background };
            let mut loss = LossGradients {
                by_weight: &mut along.by_weight[..len],
                behind: transmittance * (0..3).map(|c| g[c] * background[c]).sum::<f32>(),
            };
            towards.regularisers.add_gradients(&ray, &mut loss);
            optical_depth_gradients(
                loss.by_weight,
                &along.transmittance[..len],
                weight,
                loss.behind,
                &mut along.by_depth[..len],
            );
            for (&k, &by_depth) in places.iter().zip(&*along.by_depth) {
                gradients[k as usize][0] = by_depth * counted.outputs[k as usize][0];
            }
        }
    }
}

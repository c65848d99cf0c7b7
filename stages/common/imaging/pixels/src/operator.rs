use crate::image_buffer::Image;
use crate::pillow_resample::{Filter, coefficients};

/// Linear resampling along one axis in floats: output `i` is Σ weight·input over a run of inputs.
/// All runs have one length, so that callers' loops have a fixed length; padding weights are 0.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisTaps {
    inputs: usize,
    length: usize,
    firsts: Vec<usize>,
    weights: Vec<f32>,
}

impl AxisTaps {
    /// Computes Pillow's unrounded weights from `inputs` samples to `outputs`.
    ///
    /// # Panics
    /// If a side is 0.
    pub fn new(filter: Filter, inputs: usize, outputs: usize) -> Self {
        assert!(inputs > 0 && outputs > 0, "a side of 0 pixels can't be resized");
        let runs: Vec<(usize, Vec<f64>)> = if inputs == outputs {
            (0..inputs).map(|i| (i, vec![1.0])).collect()
        } else {
            coefficients(inputs, outputs, filter)
        };
        let length = runs.iter().map(|(_, w)| w.len()).max().unwrap_or(0);
        let mut weights = vec![0.0; length * outputs];
        let mut firsts = Vec::with_capacity(outputs);
        for (i, (first, run)) in runs.iter().enumerate() {
            // A run near the end starts earlier, so that its padding stays inside.
            let start = (*first).min(inputs - length);
            for (k, weight) in run.iter().enumerate() {
                weights[i * length + first - start + k] = *weight as f32;
            }
            firsts.push(start);
        }
        Self { inputs, length, firsts, weights }
    }

    /// Returns the first input of output `i`, and the weights of the run that begins there.
    pub fn run(&self, i: usize) -> (usize, &[f32]) {
        (self.firsts[i], &self.weights[i * self.length..(i + 1) * self.length])
    }

    /// Returns the weight of an input in an output; 0 outside the output's run.
    pub fn weight(&self, output: usize, input: usize) -> f32 {
        let (first, weights) = self.run(output);
        input.checked_sub(first).and_then(|k| weights.get(k)).copied().unwrap_or(0.0)
    }

    /// Returns the number of outputs.
    pub fn outputs(&self) -> usize {
        self.firsts.len()
    }

    /// Computes the weights P = (s·K·Kᵀ + ρ)⁻¹·K. K is the matrix of this resampling's weights,
    /// with a row for each output; s = inputs/outputs, and ρ is the ridge. For ρ = 0, s·Pᵀ is the
    /// pseudo-inverse K⁺ along one axis: K⁺·r is the smallest change of the inputs that adds r to
    /// the outputs. Rows of P sum to nearly 1, as those of K do: a constant r changes every input
    /// as much by Pᵀ·r as by Kᵀ·r. Detail that K attenuates is amplified. Weights farther than
    /// `reach` outputs from an input are omitted.
    pub fn inverse(&self, reach: usize) -> Self {
        let (n, scale) = (self.outputs(), self.inputs as f64 / self.outputs() as f64);
        // The Gram matrix is banded: a run overlaps few others.
        let band = (1..n)
            .take_while(|d| (0..n - d).any(|a| self.dot(a, a + d) != 0.0))
            .last()
            .unwrap_or(0);
        // Lower Cholesky factor, row by row: column a - band + k of row a is factor[a][k].
        let mut factor = vec![vec![0.0; band + 1]; n];
        for a in 0..n {
            for b in a.saturating_sub(band)..=a {
                let from = a.saturating_sub(band);
                let product: f64 = (from..b)
                    .filter(|k| k + band >= b)
                    .map(|k| factor[a][k + band - a] * factor[b][k + band - b])
                    .sum();
                let rest = scale * self.dot(b, a) - product;
                factor[a][b + band - a] =
                    if a == b { (rest + RIDGE).sqrt() } else { rest / factor[b][band] };
            }
        }
        let length = ((2.0 * reach as f64 * scale).ceil() as usize).min(self.inputs);
        let (mut firsts, mut weights) = (Vec::with_capacity(n), Vec::with_capacity(n * length));
        let mut z = vec![0.0; n];
        for q in 0..n {
            z.fill(0.0);
            z[q] = 1.0;
            for a in 0..n {
                let sum: f64 =
                    (a.saturating_sub(band)..a).map(|b| factor[a][b + band - a] * z[b]).sum();
                z[a] = (z[a] - sum) / factor[a][band];
            }
            for a in (0..n).rev() {
                let sum: f64 =
                    (a + 1..n.min(a + band + 1)).map(|b| factor[b][a + band - b] * z[b]).sum();
                z[a] = (z[a] - sum) / factor[a][band];
            }
            let start = ((q as f64 + 0.5) * scale - 0.5 * length as f64).round().max(0.0) as usize;
            let first = start.min(self.inputs - length);
            firsts.push(first);
            // z vanishes farther than 2·reach outputs from q; 4·reach is a safe limit.
            let near = q.saturating_sub(4 * reach)..(q + 4 * reach + 1).min(n);
            weights.extend((first..first + length).map(|i| {
                let distance = ((i as f64 + 0.5) / scale - (q as f64 + 0.5)).abs();
                let within = f64::from(u8::from(distance <= reach as f64));
                (within * near.clone().map(|a| z[a] * f64::from(self.weight(a, i))).sum::<f64>())
                    as f32
            }));
        }
        Self { inputs: self.inputs, length, firsts, weights }
    }

    /// Returns the inner product of two outputs' weights.
    fn dot(&self, a: usize, b: usize) -> f64 {
        let (first, weights) = self.run(a);
        let products = weights.iter().enumerate();
        products.map(|(k, &w)| f64::from(w) * f64::from(self.weight(b, first + k))).sum()
    }
}

/// Ridge that bounds the pseudo-inverse: frequencies that a kernel attenuates below this power are
/// not restored; chosen by hand.
const RIDGE: f64 = 0.02;

/// Separable resampling of images as a linear operator: [`resize_pillow`](crate::resize_pillow)
/// without rounding and clipping. `apply` and `adjoint` are each other's transpose.
#[derive(Clone, Debug, PartialEq)]
pub struct Resampling {
    /// Resampling along rows.
    pub x: AxisTaps,
    /// Resampling along columns.
    pub y: AxisTaps,
}

impl Resampling {
    /// Creates the operator from one (width, height) to another.
    ///
    /// # Panics
    /// If a side is 0.
    pub fn new(filter: Filter, from: (usize, usize), to: (usize, usize)) -> Self {
        Self { x: AxisTaps::new(filter, from.0, to.0), y: AxisTaps::new(filter, from.1, to.1) }
    }

    /// Computes [`AxisTaps::inverse`] along both axes.
    pub fn inverse(&self, reach: usize) -> Self {
        Self { x: self.x.inverse(reach), y: self.y.inverse(reach) }
    }

    /// Resamples an image.
    ///
    /// # Panics
    /// Unless the image has the operator's input size.
    pub fn apply(&self, image: &Image) -> Image {
        assert_eq!(
            (image.width, image.height),
            (self.x.inputs, self.y.inputs),
            "the operator is for another size"
        );
        let (width, height, channels) = (self.x.outputs(), self.y.outputs(), image.channels);
        let mut narrow = vec![0.0; width * image.height * channels];
        for (j, row) in image.data.chunks_exact(image.width * channels).enumerate() {
            let out = &mut narrow[j * width * channels..(j + 1) * width * channels];
            for (i, pixel) in out.chunks_exact_mut(channels).enumerate() {
                let (first, weights) = self.x.run(i);
                let inputs = row[first * channels..].chunks_exact(channels);
                for (k, input) in inputs.take(weights.len()).enumerate() {
                    for c in 0..channels {
                        pixel[c] += weights[k] * input[c];
                    }
                }
            }
        }
        let mut data = vec![0.0; width * height * channels];
        for (j, out) in data.chunks_exact_mut(width * channels).enumerate() {
            let (first, weights) = self.y.run(j);
            for (k, w) in weights.iter().enumerate() {
                add_scaled(out, *w, &narrow[(first + k) * out.len()..][..out.len()]);
            }
        }
        Image::new(width, height, channels, data)
    }

    /// Applies the transpose: spreads each output sample over its inputs.
    ///
    /// # Panics
    /// Unless the image has the operator's output size.
    pub fn adjoint(&self, image: &Image) -> Image {
        assert_eq!(
            (image.width, image.height),
            (self.x.outputs(), self.y.outputs()),
            "the operator is for another size"
        );
        let (width, height, channels) = (self.x.inputs, self.y.inputs, image.channels);
        let mut tall = vec![0.0; image.width * height * channels];
        for (j, row) in image.data.chunks_exact(image.width * channels).enumerate() {
            let (first, weights) = self.y.run(j);
            for (k, w) in weights.iter().enumerate() {
                add_scaled(&mut tall[(first + k) * row.len()..][..row.len()], *w, row);
            }
        }
        let mut data = vec![0.0; width * height * channels];
        for (j, row) in tall.chunks_exact(image.width * channels).enumerate() {
            let out = &mut data[j * width * channels..(j + 1) * width * channels];
            for (i, pixel) in row.chunks_exact(channels).enumerate() {
                let (first, weights) = self.x.run(i);
                let inputs = out[first * channels..].chunks_exact_mut(channels);
                for (k, input) in inputs.take(weights.len()).enumerate() {
                    for c in 0..channels {
                        input[c] += weights[k] * pixel[c];
                    }
                }
            }
        }
        Image::new(width, height, channels, data)
    }
}

/// Adds `weight · values` to the sums.
#[inline]
fn add_scaled(sums: &mut [f32], weight: f32, values: &[f32]) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += weight * value;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::image_buffer::Rgba8;
    use crate::pillow_resample::resize_pillow;

    fn image(width: usize, height: usize, seed: u64) -> Image {
        let mut x = seed;
        let data = (0..width * height * 3).map(|_| {
            x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (x >> 40) as f32 / (1 << 24) as f32
        });
        Image::new(width, height, 3, data.collect())
    }

    /// K·(s·Pᵀ) is the identity up to the ridge, for every filter. Far from the border, a flat
    /// residual changes all inputs nearly equally.
    #[test]
    fn inverse_undoes_the_map() {
        for filter in Filter::ALL {
            for (hr, lr) in
                [(80, 40), (100, 25), (60, 40), (54, 20), (40, 40), (3, 2), (2, 1), (1, 1)]
            {
                let map = AxisTaps::new(filter, hr, lr);
                let inverse = map.inverse(40);
                let scale = hr as f32 / lr as f32;
                for a in 0..lr {
                    for b in 0..lr {
                        let entry: f32 =
                            (0..hr).map(|i| map.weight(a, i) * scale * inverse.weight(b, i)).sum();
                        let expected = f32::from(u8::from(a == b));
                        assert!(
                            (entry - expected).abs() < 0.06,
                            "{filter:?} {hr} → {lr}: {a} {b} {entry}"
                        );
                    }
                }
            }
        }
        let inverse = AxisTaps::new(Filter::Lanczos, 200, 100).inverse(3);
        for i in 40..160 {
            let flat: f32 = (0..100).map(|q| inverse.weight(q, i)).sum();
            assert!((flat - 0.5).abs() < 0.03, "{i}: {flat}");
        }
    }

    proptest! {
        /// <K x, y> = <x, Kᵀ y>, for every filter and any pair of sizes.
        #[test]
        fn adjoint_is_the_transpose(
            (w, h) in (1usize..40, 1usize..40), (v, u) in (1usize..40, 1usize..40), seed: u64,
            filter in prop::sample::select(Filter::ALL.to_vec()),
        ) {
            let operator = Resampling::new(filter, (w, h), (v, u));
            let (x, y) = (image(w, h, seed), image(v, u, !seed));
            let dot = |a: &Image, b: &Image| a.data.iter().zip(&b.data).map(|(&a,
                &b)| f64::from(a) * f64::from(b)).sum::<f64>();
            let (left, right) = (dot(&operator.apply(&x), &y), dot(&x, &operator.adjoint(&y)));
            prop_assert!((left - right).abs() < 1e-4 * left.abs().max(1.0), "{left} {right}");
        }
    }

    /// The operator agrees with Pillow, which makes the LR images, except for Pillow's rounding.
    #[test]
    fn operator_agrees_with_pillow() {
        for filter in Filter::ALL {
            for (width, height) in [(20, 15), (27, 11), (13, 30), (40, 45)] {
                let mut image = image(40, 30, 7).to_rgba8();
                // Away from black and white nothing is clipped.
                image
                    .data
                    .chunks_exact_mut(4)
                    .for_each(|p| p[..3].iter_mut().for_each(|c| *c = 64 + *c / 2));
                let bytes: Rgba8 = resize_pillow(&image, width, height, filter);
                let operator = Resampling::new(filter, (40, 30), (width, height));
                let floats = operator.apply(&Image::premultiplied(&image).over(1.0));
                for (p, q) in bytes.data.chunks_exact(4).zip(floats.data.chunks_exact(3)) {
                    // Two passes, each rounded to half a level.
                    (0..3).for_each(|c| {
                        assert!(
                            (f32::from(p[c]) / 255.0 - q[c]).abs() < 1.3 / 255.0,
                            "{filter:?} {p:?} {q:?}"
                        );
                    });
                }
            }
        }
    }
}

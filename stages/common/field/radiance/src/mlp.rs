//! Matrix kernels of the small networks. Activations are rows of `n` samples (a multiple of 16);
//! weights are stored by input (`w[i·outputs + j]`). There are no biases; the view network
//! has a constant input, the first spherical harmonic. Sizes of tiles are chosen by hand.

use crate::spec::{DENSITY_OUTPUTS, VIEW_INPUTS};
use numerics::kernel;
use numerics::simd::{LANES, Lanes, Quad as _};

#[inline(always)]
fn load_vector<L: Lanes>(from: &[f32], at: usize) -> L {
    L::load(from[at..at + LANES].try_into().expect("a row has whole vectors"))
}

#[inline(always)]
fn store_vector<L: Lanes>(value: L, to: &mut [f32], at: usize) {
    value.store((&mut to[at..at + LANES]).try_into().expect("a row has whole vectors"));
}

/// Weights of one layer, plain or transposed.
#[derive(Clone, Copy)]
pub(crate) struct Matrix<'a> {
    /// Weights by input.
    weights: &'a [f32],
    inputs: usize,
    outputs: usize,
}

/// Operation on a sum before it is stored.
#[derive(Clone, Copy)]
pub(crate) enum After<'a> {
    /// Identity.
    Linear,
    /// max(0, ·).
    Relu,
    /// Derivative of ReLU: 0 where the gate, of the output's shape, isn't above 0.
    Gate(&'a [f32]),
}

/// Product of weights and activations.
#[derive(Clone, Copy)]
struct Product<'a> {
    matrix: Matrix<'a>,
    /// One row of `n` samples per input.
    x: &'a [f32],
    n: usize,
    after: After<'a>,
}

/// Computes outputs j to j + TO for TV vectors of samples from `s` on, all in registers. The order
/// of the sum over inputs doesn't depend on the tile.
#[inline(always)]
fn tile<L: Lanes, const TO: usize, const TV: usize>(
    product: &Product<'_>,
    y: &mut [f32],
    s: usize,
    j: usize,
) {
    let Product { matrix: Matrix { weights: w, inputs, outputs }, x, n, after } = *product;
    let mut acc = [[L::splat(0.0); TV]; TO];
    for i in 0..inputs {
        let xs: [L; TV] = std::array::from_fn(|v| load_vector(x, i * n + s + v * LANES));
        let ws: &[f32; TO] =
            w[i * outputs + j..i * outputs + j + TO].try_into().expect("a tile of weights");
        for o in 0..TO {
            let b = L::splat(ws[o]);
            for v in 0..TV {
                acc[o][v] = xs[v].mul_add(b, acc[o][v]);
            }
        }
    }
    for o in 0..TO {
        for v in 0..TV {
            let at = (j + o) * n + s + v * LANES;
            let sum = match after {
                After::Linear => acc[o][v],
                After::Relu => acc[o][v].positive(),
                After::Gate(gate) => acc[o][v].where_positive(load_vector(gate, at)),
            };
            store_vector(sum, y, at);
        }
    }
}

#[inline(always)]
fn all_outputs<L: Lanes, const TO: usize, const TV: usize>(
    product: &Product<'_>,
    y: &mut [f32],
    s: usize,
) {
    let outputs = product.matrix.outputs;
    let mut j = 0;
    while j + TO <= outputs {
        tile::<L, TO, TV>(product, y, s, j);
        j += TO;
    }
    while j < outputs {
        tile::<L, 1, TV>(product, y, s, j);
        j += 1;
    }
}

kernel! {
    /// Computes y = after(wᵀ·x), from one row of `n` samples per input to one per output; with
    /// transposed weights, the backward pass.
    pub(crate) fn multiply<L>(matrix: Matrix<'_>, x: &[f32], y: &mut [f32], n: usize,
        after: After<'_>) {
        let product = Product { matrix, x, n, after };
        let mut s = 0;
        if L::WIDE {
            while s + 2 * LANES <= n {
                all_outputs::<L, 8, 2>(&product, y, s);
                s += 2 * LANES;
            }
            if s < n {
                all_outputs::<L, 16, 1>(&product, y, s);
            }
        } else {
            while s < n {
                all_outputs::<L, 4, 1>(&product, y, s);
                s += LANES;
            }
        }
    }
}

/// Adds the weights' gradients of inputs i to i + TI and outputs j to j + TJ.
#[inline(always)]
fn outer_tile<L: Lanes, const TI: usize, const TJ: usize>(
    x: &[f32],
    dy: &[f32],
    gradient: &mut [f32],
    (outputs, n): (usize, usize),
    i: usize,
    j: usize,
) {
    let mut acc = [[L::splat(0.0); TJ]; TI];
    let mut s = 0;
    while s < n {
        let xs: [L; TI] = std::array::from_fn(|k| load_vector(x, (i + k) * n + s));
        for l in 0..TJ {
            let d: L = load_vector(dy, (j + l) * n + s);
            for k in 0..TI {
                acc[k][l] = xs[k].mul_add(d, acc[k][l]);
            }
        }
        s += LANES;
    }
    for (k, acc) in acc.iter().enumerate() {
        let to = &mut gradient[(i + k) * outputs + j..][..TJ];
        for (to, acc) in to.chunks_mut(4).zip(acc.chunks(4)) {
            let (mut four, mut sums) = ([L::splat(0.0); 4], [0.0; 4]);
            four[..acc.len()].copy_from_slice(acc);
            L::sums(four).store(&mut sums);
            for (to, sum) in to.iter_mut().zip(sums) {
                *to += sum;
            }
        }
    }
}

/// Adds the weights' gradients of inputs i to i + TI and all outputs.
#[inline(always)]
fn outer_row<L: Lanes, const TI: usize, const TJ: usize>(
    x: &[f32],
    dy: &[f32],
    gradient: &mut [f32],
    (outputs, n): (usize, usize),
    i: usize,
) {
    let mut j = 0;
    while j + TJ <= outputs {
        outer_tile::<L, TI, TJ>(x, dy, gradient, (outputs, n), i, j);
        j += TJ;
    }
    while j < outputs {
        outer_tile::<L, TI, 1>(x, dy, gradient, (outputs, n), i, j);
        j += 1;
    }
}

kernel! {
    /// Adds x·dyᵀ, the gradient of the weights.
    pub(crate) fn add_outer<L>(x: &[f32], dy: &[f32], gradient: &mut [f32], inputs: usize,
        outputs: usize, n: usize) {
        let shape = (outputs, n);
        let mut i = 0;
        if L::WIDE {
            while i + 4 <= inputs {
                outer_row::<L, 4, 4>(x, dy, gradient, shape, i);
                i += 4;
            }
        } else {
            while i + 2 <= inputs {
                outer_row::<L, 2, 2>(x, dy, gradient, shape, i);
                i += 2;
            }
        }
        while i < inputs {
            outer_row::<L, 1, 1>(x, dy, gradient, shape, i);
            i += 1;
        }
    }
}

/// Shape of one layer, and offset of its weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Layer {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    pub(crate) offset: usize,
}

impl Layer {
    pub(crate) fn range(self) -> std::ops::Range<usize> {
        self.offset..self.offset + self.inputs * self.outputs
    }

    /// Returns the layer's weights from those of all layers.
    #[inline]
    pub(crate) fn matrix(self, weights: &[f32]) -> Matrix<'_> {
        Matrix { weights: &weights[self.range()], inputs: self.inputs, outputs: self.outputs }
    }

    /// Returns the layer's transposed weights from those of all layers by [`Layer::transpose`].
    #[inline]
    pub(crate) fn transposed_matrix(self, transposed: &[f32]) -> Matrix<'_> {
        Matrix { weights: &transposed[self.range()], inputs: self.outputs, outputs: self.inputs }
    }

    /// Writes the layer's weights to `to`, by output.
    pub(crate) fn transpose(self, weights: &[f32], to: &mut [f32]) {
        let (w, t) = (&weights[self.range()], &mut to[self.range()]);
        for i in 0..self.inputs {
            for j in 0..self.outputs {
                t[j * self.inputs + i] = w[i * self.outputs + j];
            }
        }
    }
}

/// Layers of both networks. Density: a sample's features → raw density, raw colour and view
/// features. View: a ray's composited view features and direction → view colour.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layers {
    pub(crate) density: [Layer; 2],
    pub(crate) view: [Layer; 3],
}

impl Layers {
    pub(crate) fn new(features: usize, hidden: usize) -> Self {
        let mut offset = 0;
        let [a, b, c, d, e] = [
            (features, hidden),
            (hidden, DENSITY_OUTPUTS),
            (VIEW_INPUTS, hidden),
            (hidden, hidden),
            (hidden, 3),
        ]
        .map(|(inputs, outputs)| {
            let layer = Layer { inputs, outputs, offset };
            offset += inputs * outputs;
            layer
        });
        Self { density: [a, b], view: [c, d, e] }
    }

    pub(crate) fn all(&self) -> [Layer; 5] {
        let ([a, b], [c, d, e]) = (self.density, self.view);
        [a, b, c, d, e]
    }

    pub(crate) fn len(&self) -> usize {
        self.view[2].range().end
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use numerics::simd::test_every_family;
    use numerics::uniform;

    fn numbers(seed: u64, len: usize) -> Vec<f32> {
        (0..len).map(|i| 2.0 * uniform(seed, 0, i as u64) - 1.0).collect()
    }

    /// Shapes (inputs, outputs, samples) that exercise every remainder of the tiling.
    const SHAPES: [(usize, usize, usize); 5] =
        [(32, 32, 64), (24, 16, 48), (32, 3, 16), (3, 5, 80), (7, 9, 16)];

    #[test]
    fn products_agree_with_f64() {
        for (inputs, outputs, n) in SHAPES {
            let (w, x, gate) =
                (numbers(1, inputs * outputs), numbers(2, inputs * n), numbers(3, outputs * n));
            let matrix = Matrix { weights: &w, inputs, outputs };
            let mut y = vec![0.0; outputs * n];
            for after in [After::Linear, After::Relu, After::Gate(&gate)] {
                multiply(matrix, &x, &mut y, n, after);
                for j in 0..outputs {
                    for s in 0..n {
                        let sum: f64 = (0..inputs)
                            .map(|i| f64::from(w[i * outputs + j]) * f64::from(x[i * n + s]))
                            .sum();
                        let expected = match after {
                            After::Linear => sum,
                            After::Relu => sum.max(0.0),
                            After::Gate(gate) => {
                                if gate[j * n + s] > 0.0 {
                                    sum
                                } else {
                                    0.0
                                }
                            }
                        };
                        assert!((f64::from(y[j * n + s]) - expected).abs() < 1e-5);
                    }
                }
            }
            let dy = numbers(4, outputs * n);
            let mut sums = vec![1.0; inputs * outputs];
            add_outer(&x, &dy, &mut sums, inputs, outputs, n);
            for i in 0..inputs {
                for j in 0..outputs {
                    let sum: f64 =
                        (0..n).map(|s| f64::from(x[i * n + s]) * f64::from(dy[j * n + s])).sum();
                    assert!((f64::from(sums[i * outputs + j]) - 1.0 - sum).abs() < 1e-5);
                }
            }
        }
    }

    fn result_bits() -> Vec<u32> {
        let mut bits = Vec::new();
        for (inputs, outputs, n) in SHAPES {
            let (w, x, dy) =
                (numbers(1, inputs * outputs), numbers(2, inputs * n), numbers(4, outputs * n));
            let mut y = vec![0.0; outputs * n];
            multiply(Matrix { weights: &w, inputs, outputs }, &x, &mut y, n, After::Relu);
            let mut sums = vec![0.0; inputs * outputs];
            add_outer(&x, &dy, &mut sums, inputs, outputs, n);
            bits.extend(y.iter().chain(&sums).map(|v| v.to_bits()));
        }
        bits
    }

    #[test]
    fn all_families_give_equal_bits() {
        let expected_bits = result_bits();
        test_every_family(|family| assert_eq!(result_bits(), expected_bits, "{family:?}"));
    }
}

//! 3×3 convolutions without padding, forward and backward, by Winograd's algorithm F(4×4, 3×3)
//! (Lavin and Gray 2016, "Fast algorithms for convolutional neural networks"): a tile of 4×4
//! outputs takes 36 multiplications per pair of channels instead of 144.
//!
//! With kernel g, inputs d (6×6) and outputs y (4×4): y = Aᵀ[(G g Gᵀ) ⊙ (Bᵀ d B)]A. The backward
//! pass is the exact adjoint. Sums have one order on any machine and at any thread count.

use numerics::kernel;
use numerics::simd::{LANES, Lanes};

/// Outputs along each side of a tile.
const TILE_OUTPUTS: usize = 4;
/// Inputs along each side of a tile.
const TILE_INPUTS: usize = 6;
/// Products per tile and pair of channels.
const POINTS: usize = TILE_INPUTS * TILE_INPUTS;
/// Number of tiles that are transformed together: their products fit in the level-2 cache; chosen
/// by hand.
const BLOCK: usize = 32;
/// Rows of a product that are in registers at once; half as many in narrow SIMD families. Divides
/// [`BLOCK`] and [`LANES`]; chosen by hand.
const ROWS: usize = 8;

/// Sixteen numbers in one cache line.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct Vector([f32; LANES]);

/// Returns a vector's numbers in registers.
#[inline(always)]
fn load<L: Lanes>(from: &Vector) -> L {
    L::load(&from.0)
}

/// Feature maps: rows of pixels, channels last. The channels are padded with zeros to whole
/// vectors.
#[derive(Clone, Debug, Default)]
pub(crate) struct Maps {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Number of vectors per pixel.
    depth: usize,
    data: Vec<Vector>,
}

impl Maps {
    /// Changes the size, with undefined values.
    fn resize(&mut self, width: usize, height: usize, depth: usize) {
        (self.width, self.height, self.depth) = (width, height, depth);
        self.data.resize(width * height * depth, Vector::default());
    }

    /// Changes the size to that of other maps; all values become 0.
    pub(crate) fn reset_like(&mut self, other: &Self) {
        self.resize(other.width, other.height, other.depth);
        self.data.fill(Vector::default());
    }

    /// Changes the size and copies samples, row by row, channels interleaved.
    pub(crate) fn fill(&mut self, width: usize, height: usize, samples: &[f32]) {
        let channels = samples.len() / (width * height);
        self.resize(width, height, channels.div_ceil(LANES));
        let pixels = self.data.chunks_exact_mut(self.depth);
        for (pixel, sample) in pixels.zip(samples.chunks_exact(channels)) {
            for (vector, values) in pixel.iter_mut().zip(sample.chunks(LANES)) {
                *vector = padded(values);
            }
        }
    }

    /// Copies the first `channels` channels, row by row, channels interleaved.
    pub(crate) fn copy_samples(&self, channels: usize, to: &mut Vec<f32>) {
        to.clear();
        for pixel in self.data.chunks_exact(self.depth) {
            for (i, vector) in pixel.iter().enumerate() {
                to.extend_from_slice(&vector.0[..LANES.min(channels - i * LANES)]);
            }
        }
    }

    /// Adds `other`, which is four pixels smaller in width and in height, to the middle of these
    /// maps.
    pub(crate) fn add_to_middle(&mut self, other: &Self) {
        for (y, row) in other.data.chunks_exact(other.width * other.depth).enumerate() {
            let start = ((y + 2) * self.width + 2) * self.depth;
            for (sum, vector) in self.data[start..start + row.len()].iter_mut().zip(row) {
                for lane in 0..LANES {
                    sum.0[lane] += vector.0[lane];
                }
            }
        }
    }

    /// Returns a vector of a pixel's channels; zeros outside the maps.
    #[inline(always)]
    fn load<L: Lanes>(&self, x: usize, y: usize, vector: usize) -> L {
        if x < self.width && y < self.height {
            load(&self.data[(y * self.width + x) * self.depth + vector])
        } else {
            L::splat(0.0)
        }
    }

    /// Stores a vector of a pixel's channels; does nothing outside the maps.
    #[inline(always)]
    fn store<L: Lanes>(&mut self, x: usize, y: usize, vector: usize, value: L) {
        if x < self.width && y < self.height {
            value.store(&mut self.data[(y * self.width + x) * self.depth + vector].0);
        }
    }
}

/// Returns a + factor · b.
#[inline(always)]
fn add_scaled<L: Lanes>(a: L, factor: f32, b: L) -> L {
    b.mul_add(L::splat(factor), a)
}

/// Layer: transformed kernels and biases.
#[derive(Debug)]
pub(crate) struct Convolution {
    /// Numbers of vectors of inputs and of outputs.
    input_vectors: usize,
    output_vectors: usize,
    /// G g Gᵀ: points × inputs × outputs.
    forward: Vec<Vector>,
    /// G g Gᵀ: points × outputs × inputs.
    backward: Vec<Vector>,
    bias: Vec<Vector>,
}

/// G: transform of kernels.
const G: [[f32; 3]; TILE_INPUTS] = [
    [0.25, 0.0, 0.0],
    [-1.0 / 6.0, -1.0 / 6.0, -1.0 / 6.0],
    [-1.0 / 6.0, 1.0 / 6.0, -1.0 / 6.0],
    [1.0 / 24.0, 1.0 / 12.0, 1.0 / 6.0],
    [1.0 / 24.0, -1.0 / 12.0, 1.0 / 6.0],
    [0.0, 0.0, 1.0],
];

impl Convolution {
    /// Transforms kernels, outputs × rows × columns × inputs, with a bias per output.
    pub(crate) fn new(kernels: &[f32], bias: &[f32]) -> Self {
        let channels = kernels.len() / (9 * bias.len());
        let (input_vectors, output_vectors) =
            (channels.div_ceil(LANES), bias.len().div_ceil(LANES));
        let size = POINTS * input_vectors * output_vectors * LANES;
        let mut layer = Self {
            input_vectors,
            output_vectors,
            forward: vec![Vector::default(); size],
            backward: vec![Vector::default(); size],
            bias: bias.chunks(LANES).map(padded).collect(),
        };
        let mut rows = vec![0.0; 3 * TILE_INPUTS * channels];
        for (output, kernel) in kernels.chunks_exact(9 * channels).enumerate() {
            transform_rows(kernel, channels, &mut rows);
            for point in 0..POINTS {
                let row = &rows[point / TILE_INPUTS * 3 * channels..][..3 * channels];
                layer.set_point(point, output, row, channels);
            }
        }
        layer
    }

    /// Transforms an output's kernels along columns, for one point, from `row`: 3 × `channels`.
    fn set_point(&mut self, point: usize, output: usize, row: &[f32], channels: usize) {
        let g = G[point % TILE_INPUTS];
        let start = (point * self.output_vectors * LANES + output) * self.input_vectors;
        for channel in 0..channels {
            let value = g[0] * row[channel]
                + g[1] * row[channels + channel]
                + g[2] * row[2 * channels + channel];
            self.backward[start + channel / LANES].0[channel % LANES] = value;
            let input = point * self.input_vectors * LANES + channel;
            self.forward[input * self.output_vectors + output / LANES].0[output % LANES] = value;
        }
    }
}

/// Returns at most sixteen numbers, padded with zeros.
fn padded(values: &[f32]) -> Vector {
    let mut vector = Vector::default();
    vector.0[..values.len()].copy_from_slice(values);
    vector
}

/// Computes G g, 6 × 3 × `inputs`, from kernels of one output, rows × columns × inputs.
fn transform_rows(kernel: &[f32], inputs: usize, to: &mut [f32]) {
    let row = 3 * inputs;
    for (i, to) in to.chunks_exact_mut(row).enumerate() {
        let g = G[i];
        for x in 0..row {
            to[x] = g[0] * kernel[x] + g[1] * kernel[row + x] + g[2] * kernel[2 * row + x];
        }
    }
}

/// Gradients of a layer's transformed kernels and biases.
#[derive(Clone, Debug, Default)]
pub(crate) struct LayerGradients {
    /// Points × inputs × outputs.
    transformed: Vec<Vector>,
    bias: Vec<Vector>,
}

impl LayerGradients {
    /// Sets all gradients to 0.
    pub(crate) fn reset(&mut self, layer: &Convolution) {
        self.transformed.clear();
        self.transformed.resize(layer.forward.len(), Vector::default());
        self.bias.clear();
        self.bias.resize(layer.output_vectors, Vector::default());
    }

    /// Adds other gradients of the same layer.
    pub(crate) fn add(&mut self, other: &Self) {
        let pairs = self.transformed.iter_mut().zip(&other.transformed);
        for (sum, vector) in pairs.chain(self.bias.iter_mut().zip(&other.bias)) {
            for lane in 0..LANES {
                sum.0[lane] += vector.0[lane];
            }
        }
    }

    /// Returns the gradients of the first `outputs` biases.
    pub(crate) fn bias(&self, outputs: usize) -> Vec<f32> {
        self.bias.iter().flat_map(|vector| vector.0).take(outputs).collect()
    }

    /// Returns the gradients of the kernels, Gᵀ u G: outputs × rows × columns × inputs, without
    /// padding.
    pub(crate) fn kernels(&self, inputs: usize, outputs: usize) -> Vec<f32> {
        let depth = self.bias.len();
        let padded_inputs = self.transformed.len() / (POINTS * depth);
        let mut kernels = vec![0.0; outputs * 9 * inputs];
        for input in 0..inputs {
            for part in 0..depth {
                let taps = self.taps(padded_inputs * depth, input * depth + part);
                for (tap, vector) in taps.iter().enumerate() {
                    for output in part * LANES..outputs.min((part + 1) * LANES) {
                        kernels[(output * 9 + tap) * inputs + input] = vector.0[output % LANES];
                    }
                }
            }
        }
        kernels
    }

    /// Returns the gradients of a kernel's nine taps for an input and sixteen outputs. Each point
    /// has `size` vectors, of which the one at index `offset` is used.
    fn taps(&self, size: usize, offset: usize) -> [Vector; 9] {
        let mut rows = [[Vector::default(); TILE_INPUTS]; 3];
        for point in 0..POINTS {
            let (i, j) = (point / TILE_INPUTS, point % TILE_INPUTS);
            let vector = &self.transformed[point * size + offset];
            for y in 0..3 {
                for lane in 0..LANES {
                    rows[y][j].0[lane] += G[i][y] * vector.0[lane];
                }
            }
        }
        let mut taps = [Vector::default(); 9];
        for (tap, sum) in taps.iter_mut().enumerate() {
            for j in 0..TILE_INPUTS {
                for lane in 0..LANES {
                    sum.0[lane] += rows[tap / 3][j].0[lane] * G[j][tap % 3];
                }
            }
        }
        taps
    }
}

/// One row for each tile and point of a block.
#[derive(Clone, Debug, Default)]
struct BlockRows {
    /// Number of vectors per row.
    depth: usize,
    data: Vec<Vector>,
}

impl BlockRows {
    fn resize(&mut self, depth: usize) {
        self.depth = depth;
        self.data.resize(POINTS * self.stride(), Vector::default());
    }

    /// Returns the number of vectors per point. An odd number: with a power of two, a tile's
    /// vectors would share few sets of the cache.
    #[inline(always)]
    fn stride(&self) -> usize {
        BLOCK * self.depth + 1
    }

    /// Returns the rows of a point.
    #[inline(always)]
    fn point(&self, point: usize) -> &[Vector] {
        &self.data[point * self.stride()..][..BLOCK * self.depth]
    }

    #[inline(always)]
    fn point_mut(&mut self, point: usize) -> &mut [Vector] {
        let start = point * self.stride();
        &mut self.data[start..][..BLOCK * self.depth]
    }

    /// Returns a tile's values of all points.
    #[inline(always)]
    fn load_tile<L: Lanes>(&self, tile: usize, vector: usize) -> [[L; TILE_INPUTS]; TILE_INPUTS] {
        let mut values = [[L::splat(0.0); TILE_INPUTS]; TILE_INPUTS];
        for i in 0..TILE_INPUTS {
            for j in 0..TILE_INPUTS {
                let start = (i * TILE_INPUTS + j) * self.stride() + tile * self.depth;
                values[i][j] = load(&self.data[start + vector]);
            }
        }
        values
    }

    #[inline(always)]
    fn store_tile<L: Lanes>(
        &mut self,
        tile: usize,
        vector: usize,
        values: &[[L; TILE_INPUTS]; TILE_INPUTS],
    ) {
        for i in 0..TILE_INPUTS {
            for j in 0..TILE_INPUTS {
                let start = (i * TILE_INPUTS + j) * self.stride() + tile * self.depth;
                values[i][j].store(&mut self.data[start + vector].0);
            }
        }
    }
}

/// Memory of one thread's convolutions.
#[derive(Clone, Debug, Default)]
pub(crate) struct Scratch {
    /// Transformed inputs of a block.
    inputs: BlockRows,
    /// Products of a block.
    products: BlockRows,
    /// Transformed gradients of a block's outputs.
    gradients: BlockRows,
}

/// Step after a convolution.
#[derive(Clone, Copy)]
pub(crate) enum After<'a> {
    /// Identity.
    Linear,
    /// max(0, ·).
    Relu,
    /// Addition of maps, whose border of two pixels is cut off.
    Add(&'a Maps),
}

/// Applies a transform of `$from` to `$to` numbers to each column of a tile, then to each row.
macro_rules! both_axes {
    ($tile:expr, $transform:ident, $from:expr, $to:expr) => {{
        let tile = $tile;
        let mut columns = [[L::splat(0.0); $from]; $to];
        for x in 0..$from {
            let mut column = [L::splat(0.0); $from];
            for y in 0..$from {
                column[y] = tile[y][x];
            }
            let column = $transform(column);
            for y in 0..$to {
                columns[y][x] = column[y];
            }
        }
        let mut all = [[L::splat(0.0); $to]; $to];
        for y in 0..$to {
            all[y] = $transform(columns[y]);
        }
        all
    }};
}

/// Returns Bᵀ d.
#[inline(always)]
fn input_transform<L: Lanes>(d: [L; TILE_INPUTS]) -> [L; TILE_INPUTS] {
    let (even, odd) = (add_scaled(d[4], -4.0, d[2]), add_scaled(d[3], -4.0, d[1]));
    let (near, far) = (add_scaled(d[4], -1.0, d[2]), add_scaled(d[3], -1.0, d[1]));
    [
        add_scaled(add_scaled(d[4], -5.0, d[2]), 4.0, d[0]),
        add_scaled(even, 1.0, odd),
        add_scaled(even, -1.0, odd),
        add_scaled(near, 2.0, far),
        add_scaled(near, -2.0, far),
        add_scaled(add_scaled(d[5], -5.0, d[3]), 4.0, d[1]),
    ]
}

/// Returns B t.
#[inline(always)]
fn input_adjoint<L: Lanes>(t: [L; TILE_INPUTS]) -> [L; TILE_INPUTS] {
    let (sum12, sum34) = (add_scaled(t[1], 1.0, t[2]), add_scaled(t[3], 1.0, t[4]));
    let (minus12, minus34) = (add_scaled(t[1], -1.0, t[2]), add_scaled(t[3], -1.0, t[4]));
    let zero = L::splat(0.0);
    [
        add_scaled(zero, 4.0, t[0]),
        add_scaled(add_scaled(add_scaled(zero, -4.0, minus12), -2.0, minus34), 4.0, t[5]),
        add_scaled(add_scaled(add_scaled(zero, -5.0, t[0]), -4.0, sum12), -1.0, sum34),
        add_scaled(add_scaled(minus12, 2.0, minus34), -5.0, t[5]),
        add_scaled(add_scaled(t[0], 1.0, sum12), 1.0, sum34),
        t[5],
    ]
}

/// Returns Aᵀ m.
#[inline(always)]
fn output_transform<L: Lanes>(m: [L; TILE_INPUTS]) -> [L; TILE_OUTPUTS] {
    let (sum12, sum34) = (add_scaled(m[1], 1.0, m[2]), add_scaled(m[3], 1.0, m[4]));
    let (minus12, minus34) = (add_scaled(m[1], -1.0, m[2]), add_scaled(m[3], -1.0, m[4]));
    [
        add_scaled(add_scaled(m[0], 1.0, sum12), 1.0, sum34),
        add_scaled(minus12, 2.0, minus34),
        add_scaled(sum12, 4.0, sum34),
        add_scaled(add_scaled(minus12, 8.0, minus34), 1.0, m[5]),
    ]
}

/// Returns A y.
#[inline(always)]
fn output_adjoint<L: Lanes>(y: [L; TILE_OUTPUTS]) -> [L; TILE_INPUTS] {
    let (even, odd) = (add_scaled(y[0], 1.0, y[2]), add_scaled(y[1], 1.0, y[3]));
    let (even4, odd4) = (add_scaled(y[0], 4.0, y[2]), add_scaled(y[1], 4.0, y[3]));
    [
        y[0],
        add_scaled(even, 1.0, odd),
        add_scaled(even, -1.0, odd),
        add_scaled(even4, 2.0, odd4),
        add_scaled(even4, -2.0, odd4),
        y[3],
    ]
}

/// Writes the transformed inputs of a block: Bᵀ d B.
#[inline(always)]
fn transform_inputs<L: Lanes>(x: &Maps, tiles: Tiles, to: &mut BlockRows) {
    for tile in 0..tiles.count {
        let (left, top) = tiles.corner(tile);
        for vector in 0..x.depth {
            let mut d = [[L::splat(0.0); TILE_INPUTS]; TILE_INPUTS];
            for i in 0..TILE_INPUTS {
                for j in 0..TILE_INPUTS {
                    d[i][j] = x.load(left + j, top + i, vector);
                }
            }
            let t = both_axes!(d, input_transform, TILE_INPUTS, TILE_INPUTS);
            to.store_tile(tile, vector, &t);
        }
    }
}

/// Block of tiles of some output maps.
#[derive(Clone, Copy)]
struct Tiles {
    /// Index of the first tile.
    first: usize,
    /// Number of tiles, at most [`BLOCK`].
    count: usize,
    /// Number of tiles along a row.
    across: usize,
}

impl Tiles {
    /// Returns the tiles of some output maps in blocks of at most [`BLOCK`].
    #[inline(always)]
    fn blocks(maps: &Maps) -> impl Iterator<Item = Self> + use<> {
        let across = maps.width.div_ceil(TILE_OUTPUTS);
        let all = across * maps.height.div_ceil(TILE_OUTPUTS);
        (0..all).step_by(BLOCK).map(move |first| Self {
            first,
            count: BLOCK.min(all - first),
            across,
        })
    }

    /// Returns column and row of a tile's first output.
    #[inline(always)]
    fn corner(self, tile: usize) -> (usize, usize) {
        let index = self.first + tile;
        (index % self.across * TILE_OUTPUTS, index / self.across * TILE_OUTPUTS)
    }
}

/// Calls a function for all `$rows` rows and all outputs of a product, in parts whose sums fit in
/// registers. `L` is the calling function's type of lanes.
macro_rules! in_register_tiles {
    ($function:ident, $product:ident, $to:ident, $rows:expr) => {
        for row in (0..$rows).step_by(ROWS) {
            let mut output = 0;
            while L::WIDE && output + 2 <= $product.outputs {
                $function::<L, ROWS, 2>($product, $to, row, output);
                output += 2;
            }
            while output < $product.outputs {
                $function::<L, { ROWS / 2 }, 1>($product, $to, row, output);
                $function::<L, { ROWS / 2 }, 1>($product, $to, row + ROWS / 2, output);
                output += 1;
            }
        }
    };
}

/// Multiplies, for each point, the rows by its matrix: `rows.depth` × `to.depth` blocks of 16 × 16
/// numbers.
#[inline(always)]
fn multiply<L: Lanes>(tiles: Tiles, rows: &BlockRows, matrix: &[Vector], to: &mut BlockRows) {
    let (inputs, outputs) = (rows.depth, to.depth);
    let size = inputs * LANES * outputs;
    for point in 0..POINTS {
        let (rows, to) = (rows.point(point), to.point_mut(point));
        let product = Product { rows, inputs, matrix: &matrix[point * size..][..size], outputs };
        // The number of tiles, rounded up to a multiple of [`ROWS`].
        in_register_tiles!(multiply_tile, product, to, tiles.count.next_multiple_of(ROWS));
    }
}

/// Product of rows and a matrix.
#[derive(Clone, Copy)]
struct Product<'a> {
    /// A row of inputs for each tile.
    rows: &'a [Vector],
    /// Number of vectors per row.
    inputs: usize,
    /// Sixteen rows of `outputs` vectors for each vector of inputs.
    matrix: &'a [Vector],
    /// Number of vectors per row of the product.
    outputs: usize,
}

/// Computes `R` tiles and `V` vectors of outputs in registers.
#[inline(always)]
fn multiply_tile<L: Lanes, const R: usize, const V: usize>(
    product: Product<'_>,
    to: &mut [Vector],
    tile: usize,
    output: usize,
) {
    let Product { rows, inputs, matrix, outputs } = product;
    let mut sums = [[L::splat(0.0); V]; R];
    for input in 0..inputs {
        let matrix = &matrix[input * LANES * outputs..][..LANES * outputs];
        let mut values = [&[0.0; LANES]; R];
        for r in 0..R {
            values[r] = &rows[(tile + r) * inputs + input].0;
        }
        for lane in 0..LANES {
            let weights = &matrix[lane * outputs + output..][..V];
            let mut columns = [L::splat(0.0); V];
            for v in 0..V {
                columns[v] = load(&weights[v]);
            }
            for r in 0..R {
                let value = L::splat(values[r][lane]);
                for v in 0..V {
                    sums[r][v] = columns[v].mul_add(value, sums[r][v]);
                }
            }
        }
    }
    for r in 0..R {
        let to = &mut to[(tile + r) * outputs + output..][..V];
        for v in 0..V {
            sums[r][v].store(&mut to[v].0);
        }
    }
}

/// Adds to `to` for each point the products of transformed inputs and gradients, summed over tiles:
/// inputs × outputs.
#[inline(always)]
fn add_outer_products<L: Lanes>(
    tiles: Tiles,
    rows: &BlockRows,
    gradients: &BlockRows,
    to: &mut [Vector],
) {
    let (inputs, outputs) = (rows.depth, gradients.depth);
    let size = inputs * LANES * outputs;
    for point in 0..POINTS {
        let rows = &rows.point(point)[..tiles.count * inputs];
        let gradients = &gradients.point(point)[..tiles.count * outputs];
        let product = OuterProduct { rows, inputs, gradients, outputs };
        let to = &mut to[point * size..][..size];
        in_register_tiles!(add_outer_tile, product, to, inputs * LANES);
    }
}

/// Sum over tiles of the products of a tile's inputs and gradients.
#[derive(Clone, Copy)]
struct OuterProduct<'a> {
    /// A row of inputs for each tile.
    rows: &'a [Vector],
    /// Number of vectors per row of inputs.
    inputs: usize,
    /// A row of gradients for each tile.
    gradients: &'a [Vector],
    /// Number of vectors per row of gradients.
    outputs: usize,
}

/// Adds the products of `R` inputs and `V` vectors of outputs in registers.
#[inline(always)]
fn add_outer_tile<L: Lanes, const R: usize, const V: usize>(
    product: OuterProduct<'_>,
    to: &mut [Vector],
    input: usize,
    output: usize,
) {
    let OuterProduct { rows, inputs, gradients, outputs } = product;
    let mut sums = [[L::splat(0.0); V]; R];
    for r in 0..R {
        for v in 0..V {
            sums[r][v] = load(&to[(input + r) * outputs + output + v]);
        }
    }
    let lanes = input % LANES..input % LANES + R;
    for (row, gradient) in rows.chunks_exact(inputs).zip(gradients.chunks_exact(outputs)) {
        let mut columns = [L::splat(0.0); V];
        for v in 0..V {
            columns[v] = load(&gradient[output + v]);
        }
        let values = &row[input / LANES].0[lanes.clone()];
        for r in 0..R {
            let value = L::splat(values[r]);
            for v in 0..V {
                sums[r][v] = columns[v].mul_add(value, sums[r][v]);
            }
        }
    }
    for r in 0..R {
        for v in 0..V {
            sums[r][v].store(&mut to[(input + r) * outputs + output + v].0);
        }
    }
}

/// Writes a block's outputs: Aᵀ m A, the biases and the step after them.
#[inline(always)]
fn transform_outputs<L: Lanes>(
    products: &BlockRows,
    tiles: Tiles,
    bias: &[Vector],
    after: After<'_>,
    y: &mut Maps,
) {
    for tile in 0..tiles.count {
        let (left, top) = tiles.corner(tile);
        for vector in 0..y.depth {
            let m = products.load_tile::<L>(tile, vector);
            let outputs = both_axes!(m, output_transform, TILE_INPUTS, TILE_OUTPUTS);
            let bias: L = load(&bias[vector]);
            for i in 0..TILE_OUTPUTS {
                for j in 0..TILE_OUTPUTS {
                    let value = add_scaled(outputs[i][j], 1.0, bias);
                    let value = match after {
                        After::Linear => value,
                        After::Relu => value.positive(),
                        After::Add(maps) => {
                            add_scaled(value, 1.0, maps.load(left + j + 2, top + i + 2, vector))
                        }
                    };
                    y.store(left + j, top + i, vector, value);
                }
            }
        }
    }
}

/// Writes A dy Aᵀ for each tile of a block, and adds dy to the gradients of the biases. With a
/// gate, gradients of outputs that aren't above 0 are 0.
#[inline(always)]
fn transform_gradients<L: Lanes>(
    dy: &Maps,
    gate: Option<&Maps>,
    tiles: Tiles,
    to: &mut BlockRows,
    bias: &mut [Vector],
) {
    for tile in 0..tiles.count {
        let (left, top) = tiles.corner(tile);
        for vector in 0..dy.depth {
            let mut y = [[L::splat(0.0); TILE_OUTPUTS]; TILE_OUTPUTS];
            let mut total: L = load(&bias[vector]);
            for i in 0..TILE_OUTPUTS {
                for j in 0..TILE_OUTPUTS {
                    let (column, row) = (left + j, top + i);
                    let mut value: L = dy.load(column, row, vector);
                    if let Some(gate) = gate {
                        value = value.where_positive(gate.load(column, row, vector));
                    }
                    total = add_scaled(total, 1.0, value);
                    y[i][j] = value;
                }
            }
            total.store(&mut bias[vector].0);
            let m = both_axes!(y, output_adjoint, TILE_OUTPUTS, TILE_INPUTS);
            to.store_tile(tile, vector, &m);
        }
    }
}

/// Adds a block's gradients of the inputs: B t Bᵀ.
#[inline(always)]
fn add_input_gradients<L: Lanes>(products: &BlockRows, tiles: Tiles, dx: &mut Maps) {
    for tile in 0..tiles.count {
        let (left, top) = tiles.corner(tile);
        for vector in 0..dx.depth {
            let t = products.load_tile::<L>(tile, vector);
            let d = both_axes!(t, input_adjoint, TILE_INPUTS, TILE_INPUTS);
            for i in 0..TILE_INPUTS {
                for j in 0..TILE_INPUTS {
                    let before: L = dx.load(left + j, top + i, vector);
                    dx.store(left + j, top + i, vector, add_scaled(before, 1.0, d[i][j]));
                }
            }
        }
    }
}

kernel! {
    /// Convolves `x` into `y`, which becomes two pixels smaller than `x` in width and in height.
    pub(crate) fn convolve<L>(layer: &Convolution, x: &Maps, after: After<'_>, y: &mut Maps,
        scratch: &mut Scratch) {
        y.resize(x.width - 2, x.height - 2, layer.output_vectors);
        let Scratch { inputs, products, .. } = scratch;
        inputs.resize(layer.input_vectors);
        products.resize(layer.output_vectors);
        for tiles in Tiles::blocks(y) {
            transform_inputs::<L>(x, tiles, inputs);
            multiply::<L>(tiles, inputs, &layer.forward, products);
            transform_outputs::<L>(products, tiles, &layer.bias, after, y);
        }
    }
}

kernel! {
    /// Adds the gradients of a layer to `gradients`, and those of its inputs to `dx`, from the
    /// gradients `dy` of its outputs. `gate` has the outputs of a layer with ReLU.
    pub(crate) fn convolve_back<L>(layer: &Convolution, x: &Maps, dy: &Maps, gate: Option<&Maps>,
        gradients: &mut LayerGradients, dx: Option<&mut Maps>, scratch: &mut Scratch) {
        let Scratch { inputs, products, gradients: transformed } = scratch;
        inputs.resize(layer.input_vectors);
        products.resize(layer.input_vectors);
        transformed.resize(layer.output_vectors);
        let mut dx = dx;
        for tiles in Tiles::blocks(dy) {
            transform_inputs::<L>(x, tiles, inputs);
            transform_gradients::<L>(dy, gate, tiles, transformed, &mut gradients.bias);
            add_outer_products::<L>(tiles, inputs, transformed, &mut gradients.transformed);
            if let Some(dx) = dx.as_deref_mut() {
                multiply::<L>(tiles, transformed, &layer.backward, products);
                add_input_gradients::<L>(products, tiles, dx);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use numerics::CounterRng;
    use numerics::simd::test_every_family;

    use super::*;

    /// Random kernels, bias and input of a layer, which the methods evaluate in f64.
    struct Case {
        inputs: usize,
        kernels: Vec<f32>,
        bias: Vec<f32>,
        x: Maps,
    }

    /// Returns random numbers between −0.5 and 0.5.
    fn numbers(count: usize, stream: u64) -> Vec<f32> {
        let mut rng = CounterRng::new(7, 1, stream);
        (0..count).map(|_| rng.uniform() - 0.5).collect()
    }

    fn sample(maps: &Maps, x: usize, y: usize, channel: usize) -> f64 {
        let vector = (y * maps.width + x) * maps.depth + channel / LANES;
        f64::from(maps.data[vector].0[channel % LANES])
    }

    fn samples(maps: &Maps, channels: usize) -> Vec<f32> {
        let mut samples = Vec::new();
        maps.copy_samples(channels, &mut samples);
        samples
    }

    fn case(inputs: usize, outputs: usize, width: usize, height: usize) -> Case {
        let mut x = Maps::default();
        x.fill(width, height, &numbers(width * height * inputs, 3));
        let kernels = numbers(outputs * 9 * inputs, 4);
        Case { inputs, kernels, bias: numbers(outputs, 5), x }
    }

    impl Case {
        /// Returns the index of a kernel's weight.
        fn weight(&self, output: usize, tap: usize, input: usize) -> usize {
            (output * 9 + tap) * self.inputs + input
        }

        fn input(&self, x: usize, y: usize, channel: usize) -> f64 {
            sample(&self.x, x, y, channel)
        }

        /// Returns an output in f64, by the definition.
        fn output(&self, x: usize, y: usize, output: usize) -> f64 {
            let mut sum = f64::from(self.bias[output]);
            for tap in 0..9 {
                for input in 0..self.inputs {
                    let weight = self.kernels[self.weight(output, tap, input)];
                    sum += f64::from(weight) * self.input(x + tap % 3, y + tap / 3, input);
                }
            }
            sum
        }
    }

    /// Inputs, outputs, width and height of each case.
    const CASES: [(usize, usize, usize, usize); 4] =
        [(16, 32, 9, 7), (5, 3, 3, 3), (32, 32, 30, 22), (44, 12, 6, 15)];

    #[test]
    fn outputs_match_the_definition() {
        for (inputs, outputs, width, height) in CASES {
            let case = case(inputs, outputs, width, height);
            let layer = Convolution::new(&case.kernels, &case.bias);
            let mut other = Maps::default();
            other.fill(width + 2, height + 2, &numbers((width + 2) * (height + 2) * outputs, 6));
            let mut first: Option<Vec<Vec<f32>>> = None;
            test_every_family(|_| {
                let (mut y, mut scratch) = (Maps::default(), Scratch::default());
                let mut results = Vec::new();
                for after in [After::Linear, After::Relu, After::Add(&other)] {
                    convolve(&layer, &case.x, after, &mut y, &mut scratch);
                    assert_eq!((y.width, y.height), (width - 2, height - 2));
                    let samples = samples(&y, outputs);
                    for (i, &found) in samples.iter().enumerate() {
                        let (pixel, channel) = (i / outputs, i % outputs);
                        let (column, row) = (pixel % y.width, pixel / y.width);
                        let sum = case.output(column, row, channel);
                        let expected = match after {
                            After::Linear => sum,
                            After::Relu => sum.max(0.0),
                            After::Add(maps) => sum + sample(maps, column + 2, row + 2, channel),
                        };
                        let error = (f64::from(found) - expected).abs();
                        assert!(error < 5e-5, "{inputs}→{outputs}: {found}, not {expected}");
                    }
                    results.push(samples);
                }
                // Every family computes equal bits.
                assert!(*first.get_or_insert_with(|| results.clone()) == results);
            });
        }
    }

    /// Gradients of Σ w·y, for random weights w, match their definition in f64.
    #[test]
    fn gradients_match_the_definition() {
        for (inputs, outputs, width, height) in CASES {
            let case = case(inputs, outputs, width, height);
            let layer = Convolution::new(&case.kernels, &case.bias);
            let (out_width, out_height) = (width - 2, height - 2);
            let weights = numbers(out_width * out_height * outputs, 8);
            let mut dy = Maps::default();
            dy.fill(out_width, out_height, &weights);
            let mut gate = Maps::default();
            gate.fill(out_width, out_height, &numbers(weights.len(), 9));
            let is_open: Vec<bool> = samples(&gate, outputs).iter().map(|g| *g > 0.0).collect();
            let weight_at = |x: usize, y: usize, output: usize| {
                let i = (y * out_width + x) * outputs + output;
                if is_open[i] { f64::from(weights[i]) } else { 0.0 }
            };
            test_every_family(|_| {
                let mut gradients = LayerGradients::default();
                gradients.reset(&layer);
                let (mut dx, mut scratch) = (Maps::default(), Scratch::default());
                dx.reset_like(&case.x);
                convolve_back(
                    &layer,
                    &case.x,
                    &dy,
                    Some(&gate),
                    &mut gradients,
                    Some(&mut dx),
                    &mut scratch,
                );
                let kernels = gradients.kernels(inputs, outputs);
                for output in 0..outputs {
                    let (mut bias, mut taps) = (0.0, vec![0.0; 9 * inputs]);
                    for (x, y) in
                        (0..out_width * out_height).map(|i| (i % out_width, i / out_width))
                    {
                        let w = weight_at(x, y, output);
                        bias += w;
                        for tap in 0..9 {
                            for input in 0..inputs {
                                taps[tap * inputs + input] +=
                                    w * case.input(x + tap % 3, y + tap / 3, input);
                            }
                        }
                    }
                    assert!((f64::from(gradients.bias(outputs)[output]) - bias).abs() < 1e-4);
                    for (i, expected) in taps.into_iter().enumerate() {
                        let found = f64::from(kernels[output * 9 * inputs + i]);
                        assert!((found - expected).abs() < 2e-4, "{found}, not {expected}");
                    }
                }
                for (i, found) in samples(&dx, inputs).into_iter().enumerate() {
                    let (pixel, input) = (i / inputs, i % inputs);
                    let (x, y) = (pixel % width, pixel / width);
                    let mut expected = 0.0;
                    for tap in 0..9 {
                        let (left, top) = (x.wrapping_sub(tap % 3), y.wrapping_sub(tap / 3));
                        if left < out_width && top < out_height {
                            for output in 0..outputs {
                                let weight = case.kernels[case.weight(output, tap, input)];
                                expected += weight_at(left, top, output) * f64::from(weight);
                            }
                        }
                    }
                    let error = (f64::from(found) - expected).abs();
                    assert!(error < 5e-5, "{found}, not {expected}");
                }
            });
        }
    }
}

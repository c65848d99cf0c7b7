use nets::{Conv, Weights, WeightsError};
use tch::{Kind, TchError, Tensor};

use crate::network::{LayerNorm, Linear, Network, count_parts, integer_root, leaky_relu};

/// SwinIR (Liang et al. 2021, "SwinIR: Image Restoration Using Swin Transformer") for
/// super-resolution, by the names of its released weights: the classical, the lightweight and the
/// real-world models. Width, depth, heads, window, scale and kind are read from the file.
pub(crate) struct SwinIr {
    first: Conv,
    embedded: Option<LayerNorm>,
    groups: Vec<Group>,
    norm: LayerNorm,
    after: Vec<Layer>,
    /// Layers from features to the enlarged image.
    head: Vec<Layer>,
    /// Side of an attention window in pixels.
    window: i64,
    scale: i64,
}

/// Mean colour of the training images, as published.
const MEAN: [f32; 3] = [0.4488, 0.4371, 0.4040];
/// Negative slope of the leaky ReLUs between three convolutions in a row, and in the real-world
/// head.
const SLOPE: f64 = 0.2;
/// Negative slope of the leaky ReLU before enlarging.
const HEAD_SLOPE: f64 = 0.01;
/// Attention bias between pixels of a shifted window that aren't neighbours in the image.
const MASKED_BIAS: f32 = -100.0;

/// Transformer blocks followed by a convolution.
struct Group {
    blocks: Vec<TransformerBlock>,
    after: Vec<Layer>,
}

/// Layer without attention.
enum Layer {
    /// Convolution and its padding.
    Conv(Conv, i64),
    /// Leaky ReLU and its negative slope.
    LeakyRelu(f64),
    /// Pixel shuffle by a factor.
    PixelShuffle(i64),
    /// Enlargement by 2 to nearest neighbours.
    Nearest,
}

/// Attention within windows, then an MLP of two layers, both with residual connections.
struct TransformerBlock {
    norms: [LayerNorm; 2],
    qkv: Linear,
    /// Relative position bias: heads × pixels × pixels of a window.
    bias: Tensor,
    projection: Linear,
    layers: [Linear; 2],
    heads: i64,
    /// Shift of the windows in pixels.
    shift: i64,
}

impl SwinIr {
    /// Reads the network.
    pub(crate) fn read(weights: &Weights) -> Result<Self, WeightsError> {
        let [width, ..] = weights.shape::<4>("conv_first.weight")?;
        let table = "layers.0.residual_group.blocks.0.attn.relative_position_bias_table";
        let window = ((integer_root(weights.shape::<2>(table)?[0]) + 1) / 2).max(1);
        let groups =
            count_parts(weights, 0, |i| format!("layers.{i}.residual_group.blocks.0.norm1.weight"));
        let (head, scale) = read_head(weights, width)?;
        let embedded = weights
            .has("patch_embed.norm.weight")
            .then(|| LayerNorm::read(weights, "patch_embed.norm", width));
        Ok(Self {
            first: Conv::read(weights, "conv_first", [width, 3, 3, 3])?,
            embedded: embedded.transpose()?,
            groups: (0..groups)
                .map(|i| Group::read(weights, i, width, window))
                .collect::<Result<_, _>>()?,
            norm: LayerNorm::read(weights, "norm", width)?,
            after: read_convs(weights, "conv_after_body", width)?,
            head,
            window,
            scale,
        })
    }
}

impl Network for SwinIr {
    fn scale(&self) -> Option<i64> {
        Some(self.scale)
    }

    fn enlarge(&self, image: &Tensor, _: [i64; 2]) -> Result<Tensor, TchError> {
        let [_, _, rows, columns] = image.size()[..] else {
            return Err(TchError::Shape("expected an image of four dimensions".to_owned()));
        };
        let mean = Tensor::f_from_slice(&MEAN)?.f_reshape([1, 3, 1, 1])?;
        let padded = self.pad_to_windows(&image.f_sub(&mean)?)?;
        let first = self.first.forward(&padded, 1, 1)?;
        let mut x = first.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        if let Some(norm) = &self.embedded {
            x = norm.forward(&x)?;
        }
        let mask = shifted_window_mask(x.size()[1], x.size()[2], self.window)?;
        for group in &self.groups {
            x = group.forward(&x, self.window, &mask)?;
        }
        let normalised = self.norm.forward(&x)?.f_permute([0, 3, 1, 2])?;
        let deep = apply(&self.after, normalised)?.f_add(&first)?;
        let hr = apply(&self.head, deep)?.f_add(&mean)?;
        hr.f_narrow(2, 0, rows * self.scale)?.f_narrow(3, 0, columns * self.scale)
    }
}

impl SwinIr {
    /// Pads an image to a multiple of the window by reflection beyond its last row and column.
    fn pad_to_windows(&self, image: &Tensor) -> Result<Tensor, TchError> {
        let mut x = image.shallow_clone();
        for axis in [2, 3] {
            let size = image.size()[axis];
            let remainder = size.rem_euclid(self.window);
            if remainder > 0 {
                // Reflects repeatedly, since an image may be smaller than a window.
                let period = (2 * (size - 1)).max(1);
                let index: Vec<i64> = (0..size + self.window - remainder)
                    .map(|i| (i % period).min(period - i % period))
                    .collect();
                x = x.f_index_select(axis as i64, &Tensor::f_from_slice(&index)?)?;
            }
        }
        Ok(x)
    }
}

impl Group {
    fn read(
        weights: &Weights,
        index: usize,
        width: i64,
        window: i64,
    ) -> Result<Self, WeightsError> {
        let name = |i: usize| format!("layers.{index}.residual_group.blocks.{i}");
        let blocks = count_parts(weights, 0, |i| format!("{}.norm1.weight", name(i)));
        let blocks = (0..blocks).map(|i| {
            // Windows of every other block are shifted by half a window.
            let shift = if i % 2 == 1 { window / 2 } else { 0 };
            TransformerBlock::read(weights, &name(i), width, window, shift)
        });
        Ok(Self {
            blocks: blocks.collect::<Result<_, _>>()?,
            after: read_convs(weights, &format!("layers.{index}.conv"), width)?,
        })
    }

    fn forward(&self, x: &Tensor, window: i64, mask: &Tensor) -> Result<Tensor, TchError> {
        let mut inner = x.shallow_clone();
        for block in &self.blocks {
            inner = block.forward(&inner, window, mask)?;
        }
        apply(&self.after, inner.f_permute([0, 3, 1, 2])?)?.f_permute([0, 2, 3, 1])?.f_add(x)
    }
}

/// Reads one convolution, or a bottleneck of three.
fn read_convs(weights: &Weights, name: &str, width: i64) -> Result<Vec<Layer>, WeightsError> {
    if weights.has(&format!("{name}.weight")) {
        return Ok(vec![Layer::Conv(Conv::read(weights, name, [width, width, 3, 3])?, 1)]);
    }
    let narrow = width / 4;
    let conv = |i: usize, shape| Conv::read(weights, &format!("{name}.{i}"), shape);
    Ok(vec![
        Layer::Conv(conv(0, [narrow, width, 3, 3])?, 1),
        Layer::LeakyRelu(SLOPE),
        Layer::Conv(conv(2, [narrow, narrow, 1, 1])?, 0),
        Layer::LeakyRelu(SLOPE),
        Layer::Conv(conv(4, [width, narrow, 3, 3])?, 1),
    ])
}

/// Reads the head of the kind that the file has, and its scale: pixel shuffle directly to colours
/// (the lightweight models), in one or several steps (the classical ones), or enlargement to
/// nearest neighbours and convolution (the real-world ones).
fn read_head(weights: &Weights, width: i64) -> Result<(Vec<Layer>, i64), WeightsError> {
    let conv = |name: &str, outputs, inputs| {
        Ok::<_, WeightsError>(Layer::Conv(Conv::read(weights, name, [outputs, inputs, 3, 3])?, 1))
    };
    if !weights.has("conv_before_upsample.0.weight") {
        let scale = integer_root(weights.shape::<4>("upsample.0.weight")?[0] / 3);
        let up = conv("upsample.0", 3 * scale * scale, width)?;
        return Ok((vec![up, Layer::PixelShuffle(scale)], scale));
    }
    let [middle, ..] = weights.shape::<4>("conv_before_upsample.0.weight")?;
    let mut scale = 1;
    let mut layers =
        vec![conv("conv_before_upsample.0", middle, width)?, Layer::LeakyRelu(HEAD_SLOPE)];
    if weights.has("conv_up1.weight") {
        for i in 1..=count_parts(weights, 1, |i| format!("conv_up{i}.weight")) {
            let up = conv(&format!("conv_up{i}"), middle, middle)?;
            layers.extend([Layer::Nearest, up, Layer::LeakyRelu(SLOPE)]);
            scale = 1 << i.min(8);
        }
        layers.extend([conv("conv_hr", middle, middle)?, Layer::LeakyRelu(SLOPE)]);
    } else {
        for i in 0..count_parts(weights, 0, |i| format!("upsample.{}.weight", 2 * i)) {
            let name = format!("upsample.{}", 2 * i);
            let outputs = weights.shape::<4>(&format!("{name}.weight"))?[0];
            let factor = integer_root(outputs / middle.max(1));
            let up = conv(&name, factor * factor * middle, middle)?;
            layers.extend([up, Layer::PixelShuffle(factor)]);
            scale *= factor;
        }
    }
    layers.push(conv("conv_last", 3, middle)?);
    Ok((layers, scale))
}

/// Applies layers in order.
fn apply(layers: &[Layer], mut x: Tensor) -> Result<Tensor, TchError> {
    for layer in layers {
        x = match layer {
            Layer::Conv(conv, padding) => conv.forward(&x, 1, *padding)?,
            Layer::LeakyRelu(slope) => leaky_relu(&x, *slope)?,
            Layer::PixelShuffle(factor) => x.f_pixel_shuffle(*factor)?,
            Layer::Nearest => x
                .f_repeat_interleave_self_int(2, 2, None)?
                .f_repeat_interleave_self_int(2, 3, None)?,
        };
    }
    Ok(x)
}

impl TransformerBlock {
    fn read(
        weights: &Weights,
        name: &str,
        width: i64,
        window: i64,
        shift: i64,
    ) -> Result<Self, WeightsError> {
        let part = |part: &str| format!("{name}.{part}");
        let table = part("attn.relative_position_bias_table");
        let heads = weights.shape::<2>(&table)?[1].max(1);
        let offsets = 2 * window - 1;
        let table = weights.tensor(&table, &[offsets * offsets, heads])?;
        let [hidden, _] = weights.shape::<2>(&part("mlp.fc1.weight"))?;
        let linear = |name: &str, shape| Linear::read(weights, &part(name), shape);
        Ok(Self {
            norms: [
                LayerNorm::read(weights, &part("norm1"), width)?,
                LayerNorm::read(weights, &part("norm2"), width)?,
            ],
            qkv: linear("attn.qkv", [3 * width, width])?,
            bias: table
                .index_select(0, &relative_position_index(window))
                .reshape([window * window, window * window, heads])
                .permute([2, 0, 1]),
            projection: linear("attn.proj", [width, width])?,
            layers: [linear("mlp.fc1", [hidden, width])?, linear("mlp.fc2", [width, hidden])?],
            heads,
            shift,
        })
    }

    /// Applies the block to features (1 × rows × columns × channels), whose rows and columns are
    /// multiples of the window.
    fn forward(&self, x: &Tensor, window: i64, mask: &Tensor) -> Result<Tensor, TchError> {
        let [_, rows, columns, width] = x.size()[..] else {
            return Err(TchError::Shape("expected features of four dimensions".to_owned()));
        };
        let shifted = self.norms[0].forward(x)?.f_roll([-self.shift, -self.shift], [1, 2])?;
        let (down, across, pixels) = (rows / window, columns / window, window * window);
        let windows =
            shifted.f_reshape([down, window, across, window, width])?.f_permute([0, 2, 1, 3, 4])?;
        let windows = windows.f_reshape([down * across, pixels, width])?;
        let parts = self.qkv.forward(&windows)?.f_reshape([
            down * across,
            pixels,
            3,
            self.heads,
            width / self.heads,
        ])?;
        let parts = parts.f_permute([2, 0, 3, 1, 4])?;
        let (query, key) = (parts.f_select(0, 0)?, parts.f_select(0, 1)?);
        let value = parts.f_select(0, 2)?;
        let scale = 1.0 / ((width / self.heads) as f64).sqrt();
        let mut attention =
            query.f_mul_scalar(scale)?.f_matmul(&key.f_transpose(-2, -1)?)?.f_add(&self.bias)?;
        if self.shift > 0 {
            attention = attention.f_add(mask)?;
        }
        let attended = attention.f_softmax(-1, Kind::Float)?.f_matmul(&value)?;
        let attended = attended.f_transpose(1, 2)?.f_reshape([down * across, pixels, width])?;
        let attended = self.projection.forward(&attended)?;
        let attended = attended
            .f_reshape([down, across, window, window, width])?
            .f_permute([0, 2, 1, 3, 4])?;
        let x = attended
            .f_reshape([1, rows, columns, width])?
            .f_roll([self.shift, self.shift], [1, 2])?
            .f_add(x)?;
        let inner = self.layers[0].forward(&self.norms[1].forward(&x)?)?.f_gelu("none")?;
        self.layers[1].forward(&inner)?.f_add(&x)
    }
}

/// Returns the index into the bias table for each pair of pixels in a window.
fn relative_position_index(window: i64) -> Tensor {
    let count = window * window;
    let mut indices = Vec::with_capacity((count * count) as usize);
    for a in 0..count {
        for b in 0..count {
            let (y, x) = (a / window - b / window, a % window - b % window);
            indices.push((y + window - 1) * (2 * window - 1) + x + window - 1);
        }
    }
    Tensor::from_slice(&indices)
}

/// Returns the attention mask of shifted windows (windows × 1 × pixels × pixels), which separates
/// pixels that were rolled around from the image's other end.
fn shifted_window_mask(rows: i64, columns: i64, window: i64) -> Result<Tensor, TchError> {
    let region =
        |i: i64, size: i64| i64::from(i >= size - window) + i64::from(i >= size - window / 2);
    let (down, across, pixels) = (rows / window, columns / window, window * window);
    let mut mask = Vec::with_capacity((down * across * pixels * pixels) as usize);
    for w in 0..down * across {
        let regions: Vec<(i64, i64)> = (0..pixels)
            .map(|p| {
                let (y, x) = (w / across * window + p / window, w % across * window + p % window);
                (region(y, rows), region(x, columns))
            })
            .collect();
        for a in &regions {
            mask.extend(regions.iter().map(|b| if a == b { 0.0 } else { MASKED_BIAS }));
        }
    }
    Tensor::f_from_slice(&mask)?.f_reshape([down * across, 1, pixels, pixels])
}

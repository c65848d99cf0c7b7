use nets::{Conv, Device, Weights, WeightsError};
use tch::{Kind, TchError, Tensor};

use crate::network::{Linear, Network, count_parts};

/// LIIF (Chen et al. 2021, "Learning Continuous Image Representation with Local Implicit Image
/// Function") with EDSR's baseline encoder, feature unfolding, local ensemble and cell decoding.
/// Layers are read under the names that the released weights use. Any scale.
pub(crate) struct Liif {
    head: Conv,
    blocks: Vec<[Conv; 2]>,
    tail: Conv,
    /// MLP from features, relative position and cell size to a colour.
    layers: Vec<Linear>,
}

/// Number of features that are unfolded into one: 3×3.
const UNFOLDED: i64 = 9;
/// Shift that breaks ties between two equally near features, as published.
const TIE_SHIFT: f64 = 1e-6;
/// Added to every area, as published, so that no weight is 0 / 0.
const MIN_AREA: f64 = 1e-9;
/// Number of pixels that are decoded together; chosen by hand.
const CHUNK_PIXELS: usize = 16_384;

impl Liif {
    /// Reads the network.
    pub(crate) fn read(weights: &Weights) -> Result<Self, WeightsError> {
        let [channels, ..] = weights.shape::<4>("encoder.head.0.weight")?;
        let count = count_parts(weights, 0, |i| format!("encoder.body.{i}.body.0.weight"));
        let shape = [channels, channels, 3, 3];
        let mut blocks = Vec::with_capacity(count);
        for i in 0..count {
            blocks.push([
                Conv::read(weights, &format!("encoder.body.{i}.body.0"), shape)?,
                Conv::read(weights, &format!("encoder.body.{i}.body.2"), shape)?,
            ]);
        }
        let tail = Conv::read(weights, &format!("encoder.body.{count}"), shape)?;
        let name = |i: usize| format!("imnet.layers.{}", 2 * i);
        let count = count_parts(weights, 0, |i| format!("{}.weight", name(i)));
        let mut inputs = UNFOLDED * channels + 4;
        let mut layers = Vec::with_capacity(count);
        for i in 0..count {
            let [outputs, _] = weights.shape::<2>(&format!("{}.weight", name(i)))?;
            let outputs = if i + 1 == count { 3 } else { outputs };
            layers.push(Linear::read(weights, &name(i), [outputs, inputs])?);
            inputs = outputs;
        }
        if layers.is_empty() {
            weights.shape::<2>(&format!("{}.weight", name(0)))?;
        }
        Ok(Self {
            head: Conv::read(weights, "encoder.head.0", [channels, 3, 3, 3])?,
            blocks,
            tail,
            layers,
        })
    }

    /// Returns the unfolded features of each pixel: pixels × channels.
    fn features(&self, image: &Tensor) -> Result<Tensor, TchError> {
        let first = self.head.forward(&image.f_sub_scalar(0.5)?.f_div_scalar(0.5)?, 1, 1)?;
        let mut x = first.shallow_clone();
        for [one, two] in &self.blocks {
            x = two.forward(&one.forward(&x, 1, 1)?.f_relu()?, 1, 1)?.f_add(&x)?;
        }
        let features = self.tail.forward(&x, 1, 1)?.f_add(&first)?;
        features
            .f_im2col([3, 3], [1, 1], [1, 1], [1, 1])?
            .f_squeeze_dim(0)?
            .f_transpose(0, 1)?
            .f_contiguous()
    }
}

/// Nearest feature of a pixel along an axis.
struct Nearest {
    /// Index of the feature.
    index: usize,
    /// Position of the pixel relative to the feature, in half the distance between features.
    offset: f64,
}

/// Finds the feature nearest to each of `pixels` pixels along an axis of `features` features, after
/// a shift by half a feature towards `side`, -1 or 1.
fn nearest_features(features: i64, pixels: i64, side: f64) -> Vec<Nearest> {
    let count = features as f64;
    let mut nearest = Vec::with_capacity(pixels as usize);
    for i in 0..pixels {
        let position = -1.0 + (2 * i + 1) as f64 / pixels as f64;
        let shifted =
            (position + side / count + TIE_SHIFT).clamp(-1.0 + TIE_SHIFT, 1.0 - TIE_SHIFT);
        let index =
            (((shifted + 1.0) * count - 1.0) / 2.0).round_ties_even().clamp(0.0, count - 1.0);
        let centre = -1.0 + (2.0 * index + 1.0) / count;
        nearest.push(Nearest { index: index as usize, offset: (position - centre) * count });
    }
    nearest
}

/// Features at the four corners around each pixel (local ensemble).
struct Corners {
    /// Features above and below each row.
    rows: [Vec<Nearest>; 2],
    /// Features left and right of each column.
    columns: [Vec<Nearest>; 2],
}

impl Corners {
    /// Returns the vertically and horizontally nearest features of a pixel at corner (v, h), 0 or 1
    /// each.
    fn nearest(&self, pixel: usize, v: usize, h: usize) -> (&Nearest, &Nearest) {
        let columns = self.columns[h].len();
        (&self.rows[v][pixel / columns], &self.columns[h][pixel % columns])
    }

    /// Returns the area between a pixel and the feature at corner (v, h).
    fn area(&self, pixel: usize, v: usize, h: usize) -> f64 {
        let (y, x) = self.nearest(pixel, v, h);
        (y.offset * x.offset).abs() + MIN_AREA
    }

    /// Returns the weight of corner (v, h) for a pixel: the area to the opposite corner as a
    /// fraction of all areas, so that nearer features weigh more.
    fn weight(&self, pixel: usize, v: usize, h: usize) -> f32 {
        let total = self.area(pixel, 0, 0)
            + self.area(pixel, 0, 1)
            + self.area(pixel, 1, 0)
            + self.area(pixel, 1, 1);
        (self.area(pixel, 1 - v, 1 - h) / total) as f32
    }
}

impl Network for Liif {
    fn scale(&self) -> Option<i64> {
        None
    }

    fn enlarge(&self, image: &Tensor, [rows, columns]: [i64; 2]) -> Result<Tensor, TchError> {
        let [_, _, lr_rows, lr_columns] = image.size()[..] else {
            return Err(TchError::Shape("expected an image of four dimensions".to_owned()));
        };
        let (first, others) = self
            .layers
            .split_first()
            .ok_or_else(|| TchError::Shape("expected at least one layer".to_owned()))?;
        let features = self.features(image)?;
        let unfolded = features.size()[1];
        // The first layer is linear, so features and cell size pass through it once per LR pixel
        // instead of four times per HR pixel (design note 028).
        let by_features = first.forward_columns(&features, 0, unfolded)?;
        let cell = [2.0 * lr_rows as f64 / rows as f64, 2.0 * lr_columns as f64 / columns as f64]
            .map(|c| c as f32);
        let cell = Tensor::f_from_slice(&cell)?.f_reshape([1, 2])?;
        let constant =
            first.forward_columns(&cell, unfolded + 2, unfolded + 4)?.f_add(first.bias())?;
        let sides = [-1.0, 1.0];
        let corners = Corners {
            rows: sides.map(|side| nearest_features(lr_rows, rows, side)),
            columns: sides.map(|side| nearest_features(lr_columns, columns, side)),
        };
        let mut chunks = Vec::new();
        for start in (0..(rows * columns) as usize).step_by(CHUNK_PIXELS) {
            let pixels = start..(start + CHUNK_PIXELS).min((rows * columns) as usize);
            let mut sum = Tensor::f_zeros([pixels.len() as i64, 3], (Kind::Float, Device::Cpu))?;
            for (v, h) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                let (mut indices, mut offsets, mut weights) = (Vec::new(), Vec::new(), Vec::new());
                for pixel in pixels.clone() {
                    let (y, x) = corners.nearest(pixel, v, h);
                    indices.push((y.index * lr_columns as usize + x.index) as i64);
                    offsets.extend([y.offset as f32, x.offset as f32]);
                    weights.push(corners.weight(pixel, v, h));
                }
                let count = indices.len() as i64;
                let offset = Tensor::f_from_slice(&offsets)?.f_reshape([count, 2])?;
                let mut x = by_features.f_index_select(0, &Tensor::f_from_slice(&indices)?)?;
                let by_offset = first.forward_columns(&offset, unfolded, unfolded + 2)?;
                x = x.f_add(&by_offset)?.f_add(&constant)?;
                for layer in others {
                    x = layer.forward(&x.f_relu()?)?;
                }
                let weights = Tensor::f_from_slice(&weights)?.f_unsqueeze(1)?;
                sum = sum.f_add(&x.f_mul(&weights)?)?;
            }
            chunks.push(sum);
        }
        let colours =
            Tensor::f_cat(&chunks, 0)?.f_transpose(0, 1)?.f_reshape([1, 3, rows, columns])?;
        colours.f_mul_scalar(0.5)?.f_add_scalar(0.5)
    }
}

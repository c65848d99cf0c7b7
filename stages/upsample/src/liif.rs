use nets::{Conv, Weights, WeightsError};
use tch::{TchError, Tensor};

use crate::layers::{Linear, count};
use crate::network::Network;

/// LIIF (Chen et al. 2021, "Learning Continuous Image Representation with Local Implicit Image
/// Function") behind EDSR's baseline encoder, by the names of its released weights: unfolded
/// features, a local ensemble, decoding by cells. Any scale.
pub(crate) struct Liif {
    head: Conv,
    blocks: Vec<[Conv; 2]>,
    tail: Conv,
    /// From features, where a place lies to them and how large its pixel is, to its colour.
    layers: Vec<Linear>,
}

/// Rows and columns of features that a feature is joined by.
const UNFOLDED: i64 = 9;
/// Shift that decides between two features equally near.
const SHIFT: f64 = 1e-6;
/// Added to an area, so that there is always some.
const LEAST_AREA: f64 = 1e-9;
/// Pixels that are decoded at a time.
const CHUNK_PIXELS: usize = 16_384;

impl Liif {
    pub(crate) fn read(weights: &Weights) -> Result<Self, WeightsError> {
        let [width, ..] = weights.shape::<4>("encoder.head.0.weight")?;
        let conv =
            |name: &str| Conv::read(weights, &format!("encoder.{name}"), [width, width, 3, 3]);
        let blocks = count(weights, 0, |i| format!("encoder.body.{i}.body.0.weight"));
        let block =
            |i: usize| Ok([conv(&format!("body.{i}.body.0"))?, conv(&format!("body.{i}.body.2"))?]);
        let name = |i: usize| format!("imnet.layers.{}", 2 * i);
        let count = count(weights, 0, |i| format!("{}.weight", name(i)));
        let mut inputs = UNFOLDED * width + 4;
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
            head: Conv::read(weights, "encoder.head.0", [width, 3, 3, 3])?,
            blocks: (0..blocks).map(block).collect::<Result<_, WeightsError>>()?,
            tail: conv(&format!("body.{blocks}"))?,
            layers,
        })
    }

    /// Features of each pixel, with those around it: places × channels.
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

/// Along an axis: which feature a pixel takes, and how far the pixel lies from it, in features'
/// half steps.
struct Nearest {
    index: usize,
    offset: f64,
}

/// What each of `to` pixels along an axis takes of `from` features, shifted by half a feature to
/// one side.
fn nearest(from: i64, to: i64, side: f64) -> Vec<Nearest> {
    let (from_f, to_f) = (from as f64, to as f64);
    let pixels = (0..to).map(|i| {
        let place = -1.0 + (2 * i + 1) as f64 / to_f;
        let shifted = (place + side / from_f + SHIFT).clamp(-1.0 + SHIFT, 1.0 - SHIFT);
        let index =
            (((shifted + 1.0) * from_f - 1.0) / 2.0).round_ties_even().clamp(0.0, from_f - 1.0);
        let centre = -1.0 + (2.0 * index + 1.0) / from_f;
        Nearest { index: index as usize, offset: (place - centre) * from_f }
    });
    pixels.collect()
}

/// What pixels take of the features at the corners around them: above and below, left and right.
struct Corners {
    down: [Vec<Nearest>; 2],
    across: [Vec<Nearest>; 2],
}

impl Corners {
    /// What pixel `p` takes down and across, at one of its corners.
    fn of(&self, p: usize, v: usize, h: usize) -> (&Nearest, &Nearest) {
        let columns = self.across[h].len();
        (&self.down[v][p / columns], &self.across[h][p % columns])
    }

    /// Area between a pixel's centre and one of its corners.
    fn area(&self, p: usize, v: usize, h: usize) -> f64 {
        let (y, x) = self.of(p, v, h);
        (y.offset * x.offset).abs() + LEAST_AREA
    }
}

impl Network for Liif {
    fn scale(&self) -> Option<i64> {
        None
    }

    fn enlarge(&self, image: &Tensor, [rows, columns]: [i64; 2]) -> Result<Tensor, TchError> {
        let [_, _, lr_rows, lr_columns] = image.size()[..] else {
            return Err(TchError::Shape("an image has four dimensions".to_owned()));
        };
        let (first, others) =
            self.layers.split_first().ok_or_else(|| TchError::Shape("no layers".to_owned()))?;
        let features = self.features(image)?;
        let width = features.size()[1];
        // The first layer is linear: what features give it is the same for all pixels that take
        // them, and so is the cell.
        let known = first.part(&features, 0, width)?;
        let cell = [2.0 * lr_rows as f64 / rows as f64, 2.0 * lr_columns as f64 / columns as f64]
            .map(|c| c as f32);
        let constant = first
            .part(&Tensor::f_from_slice(&cell)?.f_reshape([1, 2])?, width + 2, width + 4)?
            .f_add(first.bias())?;
        let sides = [-1.0, 1.0];
        let corners = Corners {
            down: sides.map(|s| nearest(lr_rows, rows, s)),
            across: sides.map(|s| nearest(lr_columns, columns, s)),
        };
        let mut chunks = Vec::new();
        for start in (0..(rows * columns) as usize).step_by(CHUNK_PIXELS) {
            let pixels = start..(start + CHUNK_PIXELS).min((rows * columns) as usize);
            let mut sum = None::<Tensor>;
            for (v, h) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                let (mut index, mut offsets, mut share) = (Vec::new(), Vec::new(), Vec::new());
                for p in pixels.clone() {
                    let (y, x) = corners.of(p, v, h);
                    index.push((y.index * lr_columns as usize + x.index) as i64);
                    offsets.extend([y.offset as f32, x.offset as f32]);
                    let area = |v: usize, h: usize| corners.area(p, v, h);
                    let all = area(0, 0) + area(0, 1) + area(1, 0) + area(1, 1);
                    // Nearer features weigh more: each gets the area on the other side.
                    share.push((area(1 - v, 1 - h) / all) as f32);
                }
                let count = index.len() as i64;
                let offset = Tensor::f_from_slice(&offsets)?.f_reshape([count, 2])?;
                let mut x = known.f_index_select(0, &Tensor::f_from_slice(&index)?)?;
                x = x.f_add(&first.part(&offset, width, width + 2)?)?.f_add(&constant)?;
                for layer in others {
                    x = layer.forward(&x.f_relu()?)?;
                }
                let shared = x.f_mul(&Tensor::f_from_slice(&share)?.f_unsqueeze(1)?)?;
                sum = Some(match sum {
                    Some(sum) => sum.f_add(&shared)?,
                    None => shared,
                });
            }
            chunks.extend(sum);
        }
        let colours =
            Tensor::f_cat(&chunks, 0)?.f_transpose(0, 1)?.f_reshape([1, 3, rows, columns])?;
        colours.f_mul_scalar(0.5)?.f_add_scalar(0.5)
    }
}

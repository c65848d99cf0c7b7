use std::path::Path;

use nets::{Conv, Weights};
use refinement::RefinementError;
use tch::{Kind, TchError, Tensor};

/// The paper's perceptual loss: mean absolute differences of VGG-19's features after the second
/// ReLU of each block, weighted 1, 0.75, 0.5, 0.5 and 1, of as many blocks as there are weights
/// for.
///
/// Two kinds of file are known by the names in them: torchvision's (`features.N.weight`), and those
/// in Caffe's scaling (`convB_N.weight`), whose features are hundreds of times as large and are
/// therefore divided by the truth's mean feature, layer by layer.
#[derive(Debug)]
pub struct PerceptualLoss {
    /// Convolutions by block; what comes after the last that is compared isn't kept.
    blocks: Vec<Vec<Conv>>,
    caffe: bool,
}

/// Outputs of each block, and how many convolutions it has.
const BLOCKS: [(i64, usize); 5] = [(64, 2), (128, 2), (256, 4), (512, 4), (512, 4)];
/// Weights of the blocks' differences.
const SHARES: [f64; 5] = [1.0, 0.75, 0.5, 0.5, 1.0];
/// Means of Caffe's training images: blue, green, red.
const CAFFE_MEAN: [f32; 3] = [103.939, 116.779, 123.68];
/// Means and deviations of ImageNet: red, green, blue.
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
/// Keeps a mean feature of 0 from dividing.
const MEAN_EPSILON: f64 = 1e-6;

impl PerceptualLoss {
    /// Reads VGG-19's weights, as far as they go; the first block must be whole.
    pub fn read(path: &Path) -> Result<Self, RefinementError> {
        Self::of(&Weights::read(path)?, BLOCKS.map(|(outputs, _)| outputs))
    }

    /// The same of blocks of other widths.
    pub(crate) fn of(weights: &Weights, widths: [i64; 5]) -> Result<Self, RefinementError> {
        let caffe = weights.has("conv1_1.weight");
        let (mut blocks, mut inputs, mut index) = (Vec::new(), 3, 0);
        for (block, (outputs, (_, count))) in widths.into_iter().zip(BLOCKS).enumerate() {
            let names: Vec<String> = if caffe {
                (1..=count).map(|i| format!("conv{}_{i}", block + 1)).collect()
            } else {
                (0..count).map(|i| format!("features.{}", index + 2 * i)).collect()
            };
            // The second one's features are compared.
            if block > 0 && !names[..2].iter().all(|name| weights.has(&format!("{name}.weight"))) {
                break;
            }
            let mut convs = Vec::with_capacity(count);
            for name in names {
                if convs.len() >= 2 && !weights.has(&format!("{name}.weight")) {
                    break;
                }
                convs.push(Conv::read(weights, &name, [outputs, inputs, 3, 3])?);
                inputs = outputs;
            }
            let whole = convs.len() == count;
            blocks.push(convs);
            if !whole {
                break;
            }
            index += 2 * count + 1;
        }
        if let Some(last) = blocks.last_mut() {
            last.truncate(2);
        }
        Ok(Self { blocks, caffe })
    }

    /// Blocks that are compared, of five.
    pub fn blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Distance of images in -1..1 (count × 3 × rows × columns) from what they should be.
    pub(crate) fn distance(&self, found: &Tensor, truth: &Tensor) -> Result<Tensor, TchError> {
        let mut sum = None::<Tensor>;
        let features = self.features(found)?;
        let expected = tch::no_grad(|| self.features(truth))?;
        for ((a, b), share) in features.iter().zip(&expected).zip(SHARES) {
            let scale = if self.caffe {
                b.f_abs()?.f_mean(Kind::Float)?.f_double_value(&[])? + MEAN_EPSILON
            } else {
                1.0
            };
            let apart = a.f_sub(b)?.f_abs()?.f_mean(Kind::Float)?.f_mul_scalar(share / scale)?;
            sum = Some(match sum {
                Some(sum) => sum.f_add(&apart)?,
                None => apart,
            });
        }
        sum.ok_or_else(|| TchError::Shape("no block to compare".to_owned()))
    }

    fn features(&self, images: &Tensor) -> Result<Vec<Tensor>, TchError> {
        let unit = images.f_add_scalar(1.0)?.f_mul_scalar(0.5)?;
        let constant = |v: [f32; 3]| Tensor::f_from_slice(&v)?.f_reshape([1, 3, 1, 1]);
        let mut x = if self.caffe {
            unit.f_flip([1])?.f_mul_scalar(255.0)?.f_sub(&constant(CAFFE_MEAN)?)?
        } else {
            unit.f_sub(&constant(MEAN)?)?.f_div(&constant(DEVIATION)?)?
        };
        let mut features = Vec::with_capacity(self.blocks.len());
        for (block, convs) in self.blocks.iter().enumerate() {
            if block > 0 {
                x = x.f_max_pool2d([2, 2], [2, 2], [0, 0], [1, 1], false)?;
            }
            for (i, conv) in convs.iter().enumerate() {
                x = conv.forward(&x, 1, 1)?.f_relu()?;
                if i == 1 {
                    features.push(x.shallow_clone());
                }
            }
        }
        Ok(features)
    }
}

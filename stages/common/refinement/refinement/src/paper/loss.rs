use std::path::Path;

use crate::RefinementError;
use nets::{Conv, Weights};
use tch::{Kind, TchError, Tensor};

/// The paper's perceptual loss: a weighted sum over VGG-19's blocks. A block's term is the mean
/// absolute difference of the features after its second ReLU. Blocks whose weights aren't in the
/// file are left out.
///
/// Two kinds of files are supported: torchvision's (`features.N.weight`), and Caffe's
/// (`convB_N.weight`). Features in Caffe's scaling are hundreds of times larger, so each layer's
/// difference is divided by the ground truth's mean feature (design note 024).
#[derive(Debug)]
pub struct PerceptualLoss {
    /// Convolutions by block, up to the last one whose features are compared.
    blocks: Vec<Vec<Conv>>,
    is_caffe: bool,
}

/// Outputs and number of convolutions of each block.
const BLOCKS: [(i64, usize); 5] = [(64, 2), (128, 2), (256, 4), (512, 4), (512, 4)];
/// Weights of the blocks' differences, as published.
const BLOCK_WEIGHTS: [f64; 5] = [1.0, 0.75, 0.5, 0.5, 1.0];
/// Channel means of Caffe's training images: blue, green, red.
const CAFFE_MEAN: [f32; 3] = [103.939, 116.779, 123.68];
/// Channel means and standard deviations of ImageNet: red, green, blue.
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
/// Added to a mean feature before dividing by it, which avoids a division by 0.
const MEAN_EPSILON: f64 = 1e-6;

impl PerceptualLoss {
    /// Reads VGG-19's weights for as many blocks as the file has; the first block must be complete.
    pub fn read(path: &Path) -> Result<Self, RefinementError> {
        Self::from_weights(&Weights::read(path)?, BLOCKS.map(|(outputs, _)| outputs))
    }

    /// Builds the loss from weights of blocks with the given widths.
    pub(crate) fn from_weights(
        weights: &Weights,
        widths: [i64; 5],
    ) -> Result<Self, RefinementError> {
        let is_caffe = weights.has("conv1_1.weight");
        let (mut blocks, mut inputs, mut index) = (Vec::new(), 3, 0);
        for (block, (_, count)) in BLOCKS.into_iter().enumerate() {
            let outputs = widths[block];
            let names: Vec<String> = if is_caffe {
                (1..=count).map(|i| format!("conv{}_{i}", block + 1)).collect()
            } else {
                (0..count).map(|i| format!("features.{}", index + 2 * i)).collect()
            };
            let available =
                names.iter().take_while(|name| weights.has(&format!("{name}.weight"))).count();
            // The second convolution's features are compared; the first block must have them.
            if block > 0 && available < 2 {
                break;
            }
            let mut convs = Vec::with_capacity(count);
            for name in &names[..available.max(2)] {
                convs.push(Conv::read(weights, name, [outputs, inputs, 3, 3])?);
                inputs = outputs;
            }
            blocks.push(convs);
            if available < count {
                break;
            }
            index += 2 * count + 1;
        }
        if let Some(last) = blocks.last_mut() {
            last.truncate(2);
        }
        Ok(Self { blocks, is_caffe })
    }

    /// Returns the number of blocks that are compared, at most five.
    pub fn blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Computes the loss of images in -1..1 (count × 3 × rows × columns).
    pub(crate) fn distance(&self, found: &Tensor, truth: &Tensor) -> Result<Tensor, TchError> {
        let mut sum = Tensor::from(0f32);
        let features = self.features(found)?;
        let expected = tch::no_grad(|| self.features(truth))?;
        for (i, (a, b)) in features.iter().zip(&expected).enumerate() {
            let scale = if self.is_caffe {
                b.f_abs()?.f_mean(Kind::Float)?.f_double_value(&[])? + MEAN_EPSILON
            } else {
                1.0
            };
            let weight = BLOCK_WEIGHTS[i] / scale;
            let difference = a.f_sub(b)?.f_abs()?.f_mean(Kind::Float)?;
            sum = sum.f_add(&difference.f_mul_scalar(weight)?)?;
        }
        Ok(sum)
    }

    /// Returns the features of images in -1..1 in every block that is compared.
    fn features(&self, images: &Tensor) -> Result<Vec<Tensor>, TchError> {
        let unit = images.f_add_scalar(1.0)?.f_mul_scalar(0.5)?;
        let mut x = if self.is_caffe {
            unit.f_flip([1])?.f_mul_scalar(255.0)?.f_sub(&channel_values(CAFFE_MEAN)?)?
        } else {
            unit.f_sub(&channel_values(MEAN)?)?.f_div(&channel_values(DEVIATION)?)?
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

/// Returns one value per channel as a tensor (1 × 3 × 1 × 1).
fn channel_values(values: [f32; 3]) -> Result<Tensor, TchError> {
    Tensor::f_from_slice(&values)?.f_reshape([1, 3, 1, 1])
}

//! A network trained on random images, [dead leaves](leaves), instead of photographs.

mod leaves;
mod stage;
mod training;

use nets::{Conv, Weights, WeightsError};
use tch::{TchError, Tensor};

use crate::network::{Network, count_parts, integer_root};

pub use stage::{PriorParams, TrainPrior};

/// Width of the network's features.
const WIDTH: i64 = 64;
/// Number of versions of an image, each a quarter turn apart, whose enlargements are averaged.
const QUARTER_TURNS: i64 = 4;
/// Grey level that the network takes as 0.
const MID_GREY: f64 = 0.5;

/// Network of residual blocks at LR (Lim et al. 2017, EDSR's baseline with fewer blocks). Its
/// output is added to the bicubic enlargement.
pub(crate) struct Prior {
    first: Conv,
    blocks: Vec<[Conv; 2]>,
    last: Conv,
    scale: i64,
}

/// Returns the contents of a weights file that is compiled into the program; `None` for others.
pub(crate) fn embedded(file: &str) -> Option<&'static [u8]> {
    match file {
        "prior_x4.safetensors" => Some(include_bytes!("prior/prior_x4.safetensors")),
        _ => None,
    }
}

impl Prior {
    /// Reads the network. Scale and number of blocks are read from the file.
    pub(crate) fn read(weights: &Weights) -> Result<Self, WeightsError> {
        let [outputs, ..] = weights.shape::<4>("last.weight")?;
        let scale = integer_root(outputs / 3);
        let conv = |name: &str, inputs, outputs| Conv::read(weights, name, [outputs, inputs, 3, 3]);
        let count = count_parts(weights, 0, |i| format!("block.{i}.0.weight"));
        let blocks = (0..count).map(|i| {
            let layer = |part| conv(&format!("block.{i}.{part}"), WIDTH, WIDTH);
            Ok([layer(0)?, layer(1)?])
        });
        Ok(Self {
            first: conv("first", 3, WIDTH)?,
            blocks: blocks.collect::<Result<_, WeightsError>>()?,
            last: conv("last", WIDTH, 3 * scale * scale)?,
            scale,
        })
    }

    /// Enlarges images (count × 3 × rows × columns) without the average over rotations.
    fn forward(&self, images: &Tensor) -> Result<Tensor, TchError> {
        let mut x = self.first.forward(&images.f_sub_scalar(MID_GREY)?, 1, 1)?;
        for [first, second] in &self.blocks {
            let inner = first.forward(&x, 1, 1)?.f_relu()?;
            x = second.forward(&inner, 1, 1)?.f_add(&x)?;
        }
        let detail = self.last.forward(&x, 1, 1)?.f_pixel_shuffle(self.scale)?;
        detail.f_add(&enlarge_bicubic(images, self.scale)?)
    }
}

impl Network for Prior {
    fn scale(&self) -> Option<i64> {
        Some(self.scale)
    }

    fn enlarge(&self, image: &Tensor, _: [i64; 2]) -> Result<Tensor, TchError> {
        let mut sum: Option<Tensor> = None;
        for turns in 0..QUARTER_TURNS {
            let turned = image.f_rot90(turns, [2, 3])?.f_contiguous()?;
            let enlarged = self.forward(&turned)?.f_rot90(-turns, [2, 3])?;
            sum = Some(match sum {
                Some(sum) => sum.f_add(&enlarged)?,
                None => enlarged,
            });
        }
        sum.map_or_else(|| Ok(image.shallow_clone()), |sum| sum.f_div_scalar(QUARTER_TURNS))
    }
}

/// Enlarges images by libtorch's bicubic filter, clamped to 0..1.
fn enlarge_bicubic(images: &Tensor, scale: i64) -> Result<Tensor, TchError> {
    let [_, _, rows, columns] = images.size()[..] else {
        return Err(TchError::Shape("images have four dimensions".to_owned()));
    };
    images
        .f_upsample_bicubic2d([rows * scale, columns * scale], false, None, None)?
        .f_clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use tch::no_grad;

    use super::*;

    fn network() -> Prior {
        nets::deterministic();
        let name = "prior_x4.safetensors";
        Prior::read(&Weights::parse(name.as_ref(), embedded(name).unwrap()).unwrap()).unwrap()
    }

    /// On images of another seed than those of its training, the network of the program has a PSNR
    /// higher by at least 1 dB than the bicubic filter.
    #[test]
    fn the_programs_network_beats_the_bicubic_filter() {
        let network = network();
        let [mut bicubic, mut enlarged] = [0.0; 2];
        for number in 0..4 {
            let hr = leaves::draw(1, number, 128);
            let lr = pixels::resize_pillow(&hr, 32, 32, pixels::Filter::Lanczos);
            let [hr, lr] = [hr, lr].map(|image| {
                nets::tensor_of(&pixels::Image::premultiplied(&image).over(0.0)).unwrap()
            });
            let psnr = |image: Tensor| {
                let squares = (image.clamp(0.0, 1.0) - &hr).square();
                pixels::psnr_of(squares.mean(tch::Kind::Double).double_value(&[])) / 4.0
            };
            bicubic += psnr(enlarge_bicubic(&lr, 4).unwrap());
            enlarged += psnr(no_grad(|| network.enlarge(&lr, [128, 128])).unwrap());
        }
        assert!(enlarged > bicubic + 1.0, "{enlarged} dB, bicubic {bicubic} dB");
    }

    #[test]
    fn other_scales_have_no_network() {
        assert_eq!(network().scale(), Some(4));
        assert!(embedded("prior_x3.safetensors").is_none());
    }
}

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::image_buffer::{Image, Rgba8};
use crate::pillow_resample::Filter;

/// Degradation kernel from HR to LR images. Pillow's kernels resample premultiplied colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Kernel {
    /// Pillow's Lanczos, as in the paper.
    Lanczos,
    /// Pillow's bicubic.
    Bicubic,
    /// Pillow's box: the unweighted mean of the pixels whose centres are in the box.
    Box,
    /// Averages as the paper's code does: colour and alpha separately, without rounding. Requires
    /// an integer scale.
    Average,
}

impl Kernel {
    /// Returns the kernel's resampling filter; for `Average` the box, which is nearly equal.
    pub fn filter(self) -> Filter {
        match self {
            Self::Lanczos => Filter::Lanczos,
            Self::Bicubic => Filter::Bicubic,
            Self::Box | Self::Average => Filter::Box,
        }
    }
}

/// Name of the file with the [`Degradation`] of the LR images next to it.
pub const DEGRADATION_FILE: &str = "degradation.json";

/// `degradation.json`: degradation from HR to LR images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Degradation {
    /// Degradation kernel.
    pub kernel: Kernel,
    /// Width and height of the HR images.
    pub hr: [u32; 2],
}

/// Computes the mean of `sx`×`sy` blocks, colour and alpha separately and without rounding, as
/// `--ds_method avg` of the paper's code does. `None` if the image size isn't a multiple of
/// (sx, sy).
///
/// Like the paper's code it pools *straight* colour, so that colours of transparent pixels bleed
/// into edges.
pub fn average_pool(image: &Rgba8, sx: usize, sy: usize) -> Option<Image> {
    if sx == 0 || sy == 0 || !image.width.is_multiple_of(sx) || !image.height.is_multiple_of(sy) {
        return None;
    }
    let (width, height) = (image.width / sx, image.height / sy);
    let mut data = Vec::with_capacity(width * height * 4);
    for y in 0..height {
        for x in 0..width {
            for c in 0..4 {
                let mut sum = 0u32;
                for row in y * sy..(y + 1) * sy {
                    for column in x * sx..(x + 1) * sx {
                        sum += u32::from(image.data[(row * image.width + column) * 4 + c]);
                    }
                }
                data.push((f64::from(sum) / (255.0 * (sx * sy) as f64)) as f32);
            }
        }
    }
    Some(Image::new(width, height, 4, data))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn average_pool_returns_block_means() {
        let mut data = vec![0; 4 * 2 * 4];
        data[..4].copy_from_slice(&[255, 0, 0, 255]);
        data[16..20].copy_from_slice(&[255, 0, 255, 0]);
        let pooled = average_pool(&Rgba8::new(4, 2, data), 2, 2).unwrap();
        assert_eq!(&pooled.data[..4], &[0.5, 0.0, 0.25, 0.25]);
        assert_eq!((pooled.width, pooled.height), (2, 1));
        assert!(average_pool(&Rgba8::new(3, 2, vec![0; 24]), 2, 2).is_none());
    }
}

use pixels::{Filter, Picture, Rgba8, average_pool, resize_pillow};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::sizes::Sizes;

/// How LR images are made from HR ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Kernel {
    /// Pillow's Lanczos, as the paper does.
    Lanczos,
    /// Pillow's bicubic.
    Bicubic,
    /// Pillow's box: the mean of whole pixels, premultiplied.
    Box,
    /// The paper code's average: colour and alpha apart, never rounded. Needs a whole scale.
    Avg,
}

impl Kernel {
    fn filter(self) -> Option<Filter> {
        match self {
            Self::Lanczos => Some(Filter::Lanczos),
            Self::Bicubic => Some(Filter::Bicubic),
            Self::Box => Some(Filter::Box),
            Self::Avg => None,
        }
    }

    /// Extension of the LR files: 8-bit PNG, or EXR where nothing is rounded.
    pub(crate) fn extension(self) -> &'static str {
        if self == Self::Avg { "exr" } else { "png" }
    }

    /// How far, in LR pixels, an LR pixel reads to each side.
    pub(crate) fn footprint(self) -> usize {
        match self {
            Self::Lanczos => 3,
            Self::Bicubic => 2,
            Self::Box | Self::Avg => 1,
        }
    }
}

/// An LR picture as its kernel gives it.
#[derive(Clone, Debug, PartialEq)]
pub enum LowResolution {
    /// Rounded to 8 bits, alpha straight.
    Bytes(Rgba8),
    /// Not rounded, alpha premultiplied.
    Floats(Picture),
}

impl LowResolution {
    /// Alpha, row by row.
    pub(crate) fn alpha(&self) -> Vec<f32> {
        match self {
            Self::Bytes(image) => image.data.iter().skip(3).step_by(4).map(|&a| f32::from(a) / 255.0).collect(),
            Self::Floats(picture) => picture.channel(3),
        }
    }
}

/// The HR picture by Lanczos from the photograph, and the LR picture from that 8-bit HR one: two steps, as the paper's code does.
///
/// # Panics
/// With [`Kernel::Avg`] when the sizes aren't whole multiples.
pub fn degrade(image: &Rgba8, sizes: &Sizes, kernel: Kernel) -> (Rgba8, LowResolution) {
    let size = |(w, h): (u32, u32)| (w as usize, h as usize);
    let (hr_size, lr_size) = (size(sizes.hr), size(sizes.lr));
    let hr = resize_pillow(image, hr_size.0, hr_size.1, Filter::Lanczos);
    let lr = match kernel.filter() {
        Some(filter) => LowResolution::Bytes(resize_pillow(&hr, lr_size.0, lr_size.1, filter)),
        None => {
            let pooled = average_pool(&hr, hr_size.0 / lr_size.0, hr_size.1 / lr_size.1);
            let mut picture = pooled.expect("avg is refused for sizes that don't divide");
            // The mean of straight colours times the mean alpha: what the paper's code composites.
            for p in picture.data.chunks_exact_mut(4) {
                (0..3).for_each(|c| p[c] *= p[3]);
            }
            LowResolution::Floats(picture)
        }
    };
    (hr, lr)
}

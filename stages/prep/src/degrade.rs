use pixels::{Filter, Image, Kernel, Resampling, Rgba8, average_pool, resize_pillow};

use crate::sizes::Sizes;

/// Returns the extension of LR files: 8-bit PNG, or EXR for the unrounded `average`.
pub(crate) fn extension(kernel: Kernel) -> &'static str {
    if kernel == Kernel::Average { "exr" } else { "png" }
}

/// Returns the distance, in LR pixels, within which all neighbours of a pixel must be unmasked for
/// the pixel to count. Less than a tenth of the kernel's weight lies beyond (docs/design/005).
pub(crate) fn mask_reach(kernel: Kernel) -> usize {
    match kernel {
        Kernel::Lanczos | Kernel::Bicubic => 1,
        Kernel::Box | Kernel::Average => 0,
    }
}

/// LR image in its kernel's precision.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum LrImage {
    /// Rounded to 8 bits, straight alpha.
    Bytes(Rgba8),
    /// Unrounded, premultiplied alpha.
    Floats(Image),
}

impl LrImage {
    /// Downscales the image once more by the same kernel.
    pub(crate) fn shrunk(&self, (width, height): (usize, usize), kernel: Kernel) -> Self {
        match self {
            Self::Bytes(image) => Self::Bytes(resize_pillow(image, width, height, kernel.filter())),
            Self::Floats(image) => {
                let shrink =
                    Resampling::new(kernel.filter(), (image.width, image.height), (width, height));
                Self::Floats(shrink.apply(image))
            }
        }
    }

    /// Returns width and height.
    pub(crate) fn size(&self) -> (usize, usize) {
        match self {
            Self::Bytes(image) => (image.width, image.height),
            Self::Floats(image) => (image.width, image.height),
        }
    }
}

/// Creates the HR image from the photograph by Lanczos, and the LR image from that 8-bit HR image:
/// two steps, as in the paper's code.
///
/// # Panics
/// With [`Kernel::Average`] if the HR size isn't an integer multiple of the LR size.
pub(crate) fn degrade(image: &Rgba8, sizes: &Sizes, kernel: Kernel) -> (Rgba8, LrImage) {
    let [hr_width, hr_height] = [sizes.hr.0, sizes.hr.1].map(|length| length as usize);
    let [lr_width, lr_height] = [sizes.lr.0, sizes.lr.1].map(|length| length as usize);
    let hr = resize_pillow(image, hr_width, hr_height, Filter::Lanczos);
    let lr = match kernel {
        Kernel::Lanczos | Kernel::Bicubic | Kernel::Box => {
            LrImage::Bytes(resize_pillow(&hr, lr_width, lr_height, kernel.filter()))
        }
        Kernel::Average => {
            let pooled = average_pool(&hr, hr_width / lr_width, hr_height / lr_height);
            let mut floats = pooled.expect("an average is refused for sizes that don't divide");
            // As the paper's code composites: mean straight colour times mean alpha.
            for [r, g, b, a] in floats.data.as_chunks_mut::<4>().0 {
                (*r, *g, *b) = (*r * *a, *g * *a, *b * *a);
            }
            LrImage::Floats(floats)
        }
    };
    (hr, lr)
}

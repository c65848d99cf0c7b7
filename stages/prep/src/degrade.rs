use pixels::{Filter, Image, Kernel, Resampling, Rgba8, average_pool, resize_pillow};

use crate::sizes::Sizes;

/// Extension of the LR files: 8-bit PNG, or EXR where nothing is rounded.
pub(crate) fn extension(kernel: Kernel) -> &'static str {
    if kernel == Kernel::Average { "exr" } else { "png" }
}

/// LR pixels beside one that its mask has to be clear of, too: beyond them lie a kernel's last lobe
/// and less than a tenth of its weight.
pub(crate) fn mask_reach(kernel: Kernel) -> usize {
    match kernel {
        Kernel::Lanczos | Kernel::Bicubic => 1,
        Kernel::Box | Kernel::Average => 0,
    }
}

/// An LR image as its kernel gives it.
#[derive(Clone, Debug, PartialEq)]
pub enum LrImage {
    /// Rounded to 8 bits, alpha straight.
    Bytes(Rgba8),
    /// Not rounded, alpha premultiplied.
    Floats(Image),
}

impl LrImage {
    /// The same shrunk once more, by the same kernel.
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

    /// Columns and rows.
    pub(crate) fn size(&self) -> (usize, usize) {
        match self {
            Self::Bytes(image) => (image.width, image.height),
            Self::Floats(image) => (image.width, image.height),
        }
    }
}

/// The HR image by Lanczos from the photograph, and the LR image from that 8-bit HR one: two steps,
/// as the paper's code does.
///
/// # Panics
/// With [`Kernel::Average`] when the sizes aren't whole multiples.
pub fn degrade(image: &Rgba8, sizes: &Sizes, kernel: Kernel) -> (Rgba8, LrImage) {
    let size = |(w, h): (u32, u32)| (w as usize, h as usize);
    let (hr_size, lr_size) = (size(sizes.hr), size(sizes.lr));
    let hr = resize_pillow(image, hr_size.0, hr_size.1, Filter::Lanczos);
    let lr = match kernel {
        Kernel::Lanczos | Kernel::Bicubic | Kernel::Box => {
            LrImage::Bytes(resize_pillow(&hr, lr_size.0, lr_size.1, kernel.filter()))
        }
        Kernel::Average => {
            let pooled = average_pool(&hr, hr_size.0 / lr_size.0, hr_size.1 / lr_size.1);
            let mut floats = pooled.expect("an average is refused for sizes that don't divide");
            // The mean of straight colours times the mean alpha: what the paper's code composites.
            for p in floats.data.chunks_exact_mut(4) {
                (0..3).for_each(|c| p[c] *= p[3]);
            }
            LrImage::Floats(floats)
        }
    };
    (hr, lr)
}

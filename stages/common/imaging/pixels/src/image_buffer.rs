use image::DynamicImage;

use crate::colour::{from_u8, to_u8};

/// 8-bit RGBA image with straight alpha, row by row from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgba8 {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `width · height · 4` bytes.
    pub data: Vec<u8>,
}

impl Rgba8 {
    /// Wraps samples.
    ///
    /// # Panics
    /// Unless there are `width · height · 4` samples.
    pub fn new(width: usize, height: usize, data: Vec<u8>) -> Self {
        assert_eq!(data.len(), width * height * 4, "an RGBA image has four samples a pixel");
        Self { width, height, data }
    }

    /// Returns the colour of a pixel.
    ///
    /// # Panics
    /// If the pixel is outside the image.
    pub fn colour(&self, x: usize, y: usize) -> [u8; 3] {
        std::array::from_fn(|c| self.data[4 * (y * self.width + x) + c])
    }
}

/// Converts a decoded image; without alpha it is opaque.
impl From<DynamicImage> for Rgba8 {
    fn from(image: DynamicImage) -> Self {
        let (width, height) = (image.width() as usize, image.height() as usize);
        // Faster than `into_rgba8`: crate `image` is compiled with little optimisation
        // (Cargo.toml).
        let data = match image {
            DynamicImage::ImageRgb8(image) => opaque_rgba::<3>(&image),
            DynamicImage::ImageLuma8(image) => opaque_rgba::<1>(&image),
            other => other.into_rgba8().into_raw(),
        };
        Self::new(width, height, data)
    }
}

/// Adds alpha to pixels of `N` samples, three for RGB and one for grey.
fn opaque_rgba<const N: usize>(samples: &[u8]) -> Vec<u8> {
    let pixels = samples.as_chunks::<N>().0;
    let mut rgba = vec![u8::MAX; 4 * pixels.len()];
    for (out, pixel) in rgba.as_chunks_mut::<4>().0.iter_mut().zip(pixels) {
        *out = [pixel[0], pixel[1 % N], pixel[2 % N], u8::MAX];
    }
    rgba
}

/// Floating-point image, row by row from the top, channels interleaved.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Samples per pixel: 1 grey, 3 RGB, 4 RGBA.
    pub channels: usize,
    /// `width · height · channels` samples.
    pub data: Vec<f32>,
}

impl Image {
    /// Wraps samples.
    ///
    /// # Panics
    /// Unless there are `width · height · channels` samples.
    pub fn new(width: usize, height: usize, channels: usize, data: Vec<f32>) -> Self {
        assert_eq!(
            data.len(),
            width * height * channels,
            "an image has `channels` samples a pixel"
        );
        Self { width, height, channels, data }
    }

    /// Converts 8-bit RGBA to premultiplied RGBA in [0, 1].
    pub fn premultiplied(image: &Rgba8) -> Self {
        let mut data = vec![0.0; image.data.len()];
        for (out, [r, g, b, a]) in
            data.as_chunks_mut::<4>().0.iter_mut().zip(image.data.as_chunks::<4>().0)
        {
            let alpha = from_u8(*a);
            *out = [from_u8(*r) * alpha, from_u8(*g) * alpha, from_u8(*b) * alpha, alpha];
        }
        Self::new(image.width, image.height, 4, data)
    }

    /// Composites premultiplied RGBA over a grey background, as the paper does:
    /// rgb + (1-a)·background.
    ///
    /// # Panics
    /// If the image has no alpha.
    #[must_use]
    pub fn over(&self, background: f32) -> Self {
        assert_eq!(self.channels, 4, "only an image with alpha can be composited");
        let pixels = self.data.as_chunks::<4>().0;
        let mut data = vec![0.0; 3 * pixels.len()];
        for (out, p) in data.as_chunks_mut::<3>().0.iter_mut().zip(pixels) {
            *out = [0, 1, 2].map(|c| p[c] + (1.0 - p[3]) * background);
        }
        Self::new(self.width, self.height, 3, data)
    }

    /// Returns the samples of one channel.
    pub fn channel(&self, channel: usize) -> Vec<f32> {
        self.data.iter().skip(channel).step_by(self.channels).copied().collect()
    }

    /// Converts to 8-bit RGBA without dividing by alpha; grey and RGB become opaque.
    pub fn to_rgba8(&self) -> Rgba8 {
        let pixels = self.data.chunks_exact(self.channels).flat_map(|p| match p {
            [r, g, b, a] => [to_u8(*r), to_u8(*g), to_u8(*b), to_u8(*a)],
            [r, g, b] => [to_u8(*r), to_u8(*g), to_u8(*b), 255],
            _ => [to_u8(p[0]), to_u8(p[0]), to_u8(p[0]), 255],
        });
        Rgba8::new(self.width, self.height, pixels.collect())
    }
}

/// Returns the peak signal-to-noise ratio in dB (peak 1) of a mean squared error, at most 100 dB,
/// which stands for equal images; NaN for NaN.
pub fn psnr_of(mean_squared_error: f64) -> f64 {
    // `min` would return 100 for NaN.
    if mean_squared_error.is_nan() {
        return f64::NAN;
    }
    (-10.0 * mean_squared_error.log10()).min(100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conversions_equal_those_of_the_image_crate() {
        let bytes = |channels: usize| (0..5 * 3 * channels).map(|i| (i * 37 % 256) as u8).collect();
        let images = [
            DynamicImage::ImageRgb8(image::RgbImage::from_raw(5, 3, bytes(3)).unwrap()),
            DynamicImage::ImageLuma8(image::GrayImage::from_raw(5, 3, bytes(1)).unwrap()),
        ];
        for image in images {
            let expected = image.clone().into_rgba8().into_raw();
            assert_eq!(Rgba8::from(image), Rgba8::new(5, 3, expected));
        }
    }
}

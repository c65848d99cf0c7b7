use image::DynamicImage;

/// An 8-bit RGBA image with straight alpha, row by row, row 0 on top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgba8 {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width · height · 4` bytes.
    pub data: Vec<u8>,
}

impl Rgba8 {
    /// Wraps samples.
    ///
    /// # Panics
    /// When there aren't `width · height · 4` of them.
    pub fn new(width: usize, height: usize, data: Vec<u8>) -> Self {
        assert_eq!(data.len(), width * height * 4, "an RGBA image has four samples a pixel");
        Self { width, height, data }
    }
}

/// Of a decoded file; one without alpha is opaque.
impl From<DynamicImage> for Rgba8 {
    fn from(image: DynamicImage) -> Self {
        let (width, height) = (image.width() as usize, image.height() as usize);
        // Most photographs are RGB. `image` compiles with little optimisation (Cargo.toml).
        let data = match image {
            DynamicImage::ImageRgb8(image) => opaque(&image),
            DynamicImage::ImageLuma8(image) => grey(&image),
            other => other.into_rgba8().into_raw(),
        };
        Self::new(width, height, data)
    }
}

/// RGB samples with alpha.
fn opaque(rgb: &[u8]) -> Vec<u8> {
    let mut rgba = vec![u8::MAX; rgb.len() / 3 * 4];
    for (to, from) in rgba.chunks_exact_mut(4).zip(rgb.chunks_exact(3)) {
        to[..3].copy_from_slice(from);
    }
    rgba
}

/// Grey samples as RGB with alpha.
fn grey(levels: &[u8]) -> Vec<u8> {
    let mut rgba = vec![u8::MAX; levels.len() * 4];
    for (to, level) in rgba.as_chunks_mut::<4>().0.iter_mut().zip(levels) {
        to[..3].fill(*level);
    }
    rgba
}

/// Floating-point samples, row by row, channels interleaved.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Samples a pixel: 1 grey, 3 RGB, 4 RGBA.
    pub channels: usize,
    /// `width · height · channels` samples.
    pub data: Vec<f32>,
}

impl Image {
    /// Wraps samples.
    ///
    /// # Panics
    /// When there aren't `width · height · channels` of them.
    pub fn new(width: usize, height: usize, channels: usize, data: Vec<f32>) -> Self {
        assert_eq!(
            data.len(),
            width * height * channels,
            "an image has `channels` samples a pixel"
        );
        Self { width, height, channels, data }
    }

    /// 8-bit RGBA in [0, 1] with premultiplied alpha.
    pub fn premultiplied(image: &Rgba8) -> Self {
        let level = |v: u8| f32::from(v) / 255.0;
        let mut data = vec![0.0; image.data.len()];
        for (out, [r, g, b, a]) in
            data.as_chunks_mut::<4>().0.iter_mut().zip(image.data.as_chunks::<4>().0)
        {
            let alpha = level(*a);
            *out = [level(*r) * alpha, level(*g) * alpha, level(*b) * alpha, alpha];
        }
        Self::new(image.width, image.height, 4, data)
    }

    /// RGBA with premultiplied alpha over a grey level, in floating point as the paper does: rgb +
    /// (1-a)·background.
    ///
    /// # Panics
    /// On an image without alpha.
    #[must_use]
    pub fn over(&self, background: f32) -> Self {
        assert_eq!(self.channels, 4, "only an image with alpha can lie over something");
        let mut data = vec![0.0; self.data.len() / 4 * 3];
        for (out, p) in data.as_chunks_mut::<3>().0.iter_mut().zip(self.data.as_chunks::<4>().0) {
            *out = [0, 1, 2].map(|c| p[c] + (1.0 - p[3]) * background);
        }
        Self::new(self.width, self.height, 3, data)
    }

    /// One channel, alone.
    pub fn channel(&self, channel: usize) -> Vec<f32> {
        self.data.iter().skip(channel).step_by(self.channels).copied().collect()
    }

    /// Grey or RGB as opaque 8-bit RGBA.
    pub fn to_rgba8(&self) -> Rgba8 {
        let pixels = self.data.chunks_exact(self.channels).flat_map(|p| match p {
            [r, g, b, a] => [to_u8(*r), to_u8(*g), to_u8(*b), to_u8(*a)],
            [r, g, b] => [to_u8(*r), to_u8(*g), to_u8(*b), 255],
            _ => [to_u8(p[0]), to_u8(p[0]), to_u8(p[0]), 255],
        });
        Rgba8::new(self.width, self.height, pixels.collect())
    }
}

/// The nearest of 256 levels; what lies outside [0, 1] is clamped.
pub fn to_u8(value: f32) -> u8 {
    // `as` saturates and sends NaN to 0.
    (value * 255.0 + 0.5) as u8
}

/// Peak signal-to-noise ratio in dB, peak 1, of a mean squared error. No error at all has none; 100
/// dB stands for it.
pub fn psnr_of(mean_squared_error: f64) -> f64 {
    (-10.0 * mean_squared_error.log10()).min(100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_become_what_the_library_makes_of_them() {
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

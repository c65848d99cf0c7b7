//! Pillow's 8-bit resampling (Pillow 12.3, `Resample.c`), to the last bit.
//!
//! Bit-exactness requires that RGBA is premultiplied in 8 bits first, that the horizontal pass is
//! clipped to 8 bits before the vertical one, and that weights are computed in f64, normalised, and
//! rounded to 22 bits.

use std::borrow::Cow;

use crate::image_buffer::Rgba8;

/// Resampling kernel, widened by the scale when downscaling, which makes it an anti-aliasing
/// filter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// Box: half a pixel to either side.
    Box,
    /// Cubic convolution with a = -1/2: two pixels to either side.
    Bicubic,
    /// Windowed sinc: three pixels to either side.
    Lanczos,
}

impl Filter {
    /// All filters.
    pub const ALL: [Self; 3] = [Self::Box, Self::Bicubic, Self::Lanczos];

    /// Maximum distance from an output pixel's centre to an input pixel that counts, in pixels of
    /// the smaller image.
    pub fn support(self) -> f64 {
        match self {
            Self::Box => 0.5,
            Self::Bicubic => 2.0,
            Self::Lanczos => 3.0,
        }
    }

    fn weight(self, x: f64) -> f64 {
        match self {
            // Half-open, so that a sample on the edge counts on one side only.
            Self::Box => f64::from(u8::from(x > -0.5 && x <= 0.5)),
            Self::Bicubic => {
                const A: f64 = -0.5;
                let x = x.abs();
                if x < 1.0 {
                    ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0
                } else if x < 2.0 {
                    (((x - 5.0) * x + 8.0) * x - 4.0) * A
                } else {
                    0.0
                }
            }
            Self::Lanczos => {
                if (-3.0..3.0).contains(&x) {
                    sinc(x) * sinc(x / 3.0)
                } else {
                    0.0
                }
            }
        }
    }
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 {
        return 1.0;
    }
    let x = x * std::f64::consts::PI;
    libm::sin(x) / x
}

/// Fractional bits of the integer weights, as in Pillow.
const PRECISION_BITS: u32 = 32 - 8 - 2;

/// One half, for rounding.
const HALF: i32 = 1 << (PRECISION_BITS - 1);

/// Returns, for each output, its first input, and the normalised weights of the inputs from there.
pub(crate) fn coefficients(input: usize, output: usize, filter: Filter) -> Vec<(usize, Vec<f64>)> {
    let scale = input as f64 / output as f64;
    let stretch = scale.max(1.0);
    let support = filter.support() * stretch;
    let mut runs = Vec::with_capacity(output);
    for i in 0..output {
        let centre = (i as f64 + 0.5) * scale;
        // `as` truncates towards zero and saturates at 0, like the C code's cast and clamp.
        let first = (centre - support + 0.5) as usize;
        let end = ((centre + support + 0.5) as usize).min(input);
        let mut weights: Vec<f64> = (first..end)
            .map(|x| filter.weight((x as f64 - centre + 0.5) * (1.0 / stretch)))
            .collect();
        let sum: f64 = weights.iter().sum();
        if sum != 0.0 {
            for weight in &mut weights {
                *weight /= sum;
            }
        }
        runs.push((first, weights));
    }
    runs
}

/// Returns [`coefficients`] as integers.
fn integer_coefficients(input: usize, output: usize, filter: Filter) -> Vec<(usize, Vec<i32>)> {
    let runs = coefficients(input, output, filter).into_iter();
    runs.map(|(first, weights)| (first, weights.into_iter().map(fixed_point).collect())).collect()
}

fn fixed_point(weight: f64) -> i32 {
    let w = weight * f64::from(1 << PRECISION_BITS);
    (if w < 0.0 { w - 0.5 } else { w + 0.5 }) as i32
}

fn clip(accumulated: i32) -> u8 {
    (accumulated >> PRECISION_BITS).clamp(0, 255) as u8
}

/// Resizes an image to the same bits as Pillow's `Image.resize((width, height), filter)` on RGBA.
///
/// # Panics
/// If a side is 0.
pub fn resize_pillow(image: &Rgba8, width: usize, height: usize, filter: Filter) -> Rgba8 {
    assert!(
        width > 0 && height > 0 && image.width > 0 && image.height > 0,
        "a side of 0 pixels can't be resized"
    );
    if (width, height) == (image.width, image.height) {
        return image.clone();
    }
    let mut current = premultiplied(image);
    if width != image.width {
        let runs = integer_coefficients(image.width, width, filter);
        let mut data = Vec::with_capacity(width * image.height * 4);
        for row in current.data.chunks_exact(image.width * 4) {
            for (first, weights) in &runs {
                let mut sum = [HALF; 4];
                for (pixel, &w) in row.as_chunks::<4>().0[*first..].iter().zip(weights) {
                    for c in 0..4 {
                        sum[c] += i32::from(pixel[c]) * w;
                    }
                }
                data.extend(sum.map(clip));
            }
        }
        current = Cow::Owned(Rgba8::new(width, image.height, data));
    }
    if height != image.height {
        let runs = integer_coefficients(image.height, height, filter);
        let row_len = width * 4;
        let mut data = Vec::with_capacity(height * row_len);
        let mut sums = vec![0i32; row_len];
        for (first, weights) in &runs {
            sums.fill(HALF);
            for (k, &w) in weights.iter().enumerate() {
                let row = &current.data[(first + k) * row_len..][..row_len];
                for (sum, &v) in sums.iter_mut().zip(row) {
                    *sum += i32::from(v) * w;
                }
            }
            data.extend(sums.iter().map(|&s| clip(s)));
        }
        current = Cow::Owned(Rgba8::new(width, height, data));
    }
    straightened(current.into_owned())
}

/// Premultiplies like Pillow's RGBA → RGBa: c·a/255, rounded, in 8 bits. An opaque image isn't
/// copied, since it may be large.
fn premultiplied(image: &Rgba8) -> Cow<'_, Rgba8> {
    if image.data.as_chunks::<4>().0.iter().all(|p| p[3] == u8::MAX) {
        return Cow::Borrowed(image);
    }
    let mut out = image.clone();
    for p in out.data.chunks_exact_mut(4) {
        let alpha = u32::from(p[3]);
        for c in &mut p[..3] {
            let product = u32::from(*c) * alpha + 128;
            *c = (((product >> 8) + product) >> 8) as u8;
        }
    }
    Cow::Owned(out)
}

/// Undoes premultiplication like Pillow's RGBa → RGBA: 255·c/a, truncated and clipped.
fn straightened(mut image: Rgba8) -> Rgba8 {
    for p in image.data.chunks_exact_mut(4) {
        let alpha = u32::from(p[3]);
        if alpha != 0 && alpha != 255 {
            for c in &mut p[..3] {
                *c = (255 * u32::from(*c) / alpha).min(255) as u8;
            }
        }
    }
    image
}

//! Pillow's 8-bit resampling (Pillow 12.3, `Resample.c`), to the last bit.
//!
//! What makes it bit-exact: RGBA is premultiplied in 8 bits first; the horizontal pass comes first
//! and is clipped to 8 bits before the vertical one; weights are computed in f64, normalised, and
//! rounded to 22 bits.

use std::borrow::Cow;

use crate::image_buffer::Rgba8;

/// A resampling kernel, widened by the scale when shrinking (so it is an anti-aliasing filter).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// Box, half a pixel to either side.
    Box,
    /// Cubic convolution with a = -1/2, two pixels to either side.
    Bicubic,
    /// sinc windowed by a wider sinc, three pixels to either side.
    Lanczos,
}

impl Filter {
    fn support(self) -> f64 {
        match self {
            Self::Box => 0.5,
            Self::Bicubic => 2.0,
            Self::Lanczos => 3.0,
        }
    }

    fn weight(self, x: f64) -> f64 {
        match self {
            // Half-open, so that a tie belongs to one side only.
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

const PRECISION_BITS: u32 = 32 - 8 - 2;

/// The weights of one output sample: they apply to input samples `first..first + weights.len()`.
struct Taps {
    first: usize,
    weights: Vec<i32>,
}

/// First input sample and normalised weights of each output sample.
pub(crate) fn coefficients(input: usize, output: usize, filter: Filter) -> Vec<(usize, Vec<f64>)> {
    let scale = input as f64 / output as f64;
    let stretch = scale.max(1.0);
    let support = filter.support() * stretch;
    (0..output)
        .map(|i| {
            let centre = (i as f64 + 0.5) * scale;
            // `as` truncates towards zero and saturates at 0, as the C code's cast and clamp do.
            let first = (centre - support + 0.5) as usize;
            let end = ((centre + support + 0.5) as usize).min(input);
            let mut weights: Vec<f64> = (first..end)
                .map(|x| filter.weight((x as f64 - centre + 0.5) * (1.0 / stretch)))
                .collect();
            let sum: f64 = weights.iter().sum();
            if sum != 0.0 {
                weights.iter_mut().for_each(|w| *w /= sum);
            }
            (first, weights)
        })
        .collect()
}

fn taps(input: usize, output: usize, filter: Filter) -> Vec<Taps> {
    let runs = coefficients(input, output, filter).into_iter();
    runs.map(|(first, weights)| Taps { first, weights: weights.into_iter().map(fixed).collect() })
        .collect()
}

fn fixed(weight: f64) -> i32 {
    let w = weight * f64::from(1 << PRECISION_BITS);
    (if w < 0.0 { w - 0.5 } else { w + 0.5 }) as i32
}

fn clip(accumulated: i32) -> u8 {
    (accumulated >> PRECISION_BITS).clamp(0, 255) as u8
}

/// Resizes as `PIL.Image.resize((width, height), filter)` does on an RGBA image.
///
/// # Panics
/// When a side is 0.
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
        let taps = taps(image.width, width, filter);
        let mut data = Vec::with_capacity(width * image.height * 4);
        for row in current.data.chunks_exact(image.width * 4) {
            for tap in &taps {
                let mut sum = [1 << (PRECISION_BITS - 1); 4];
                for (pixel, &w) in row[tap.first * 4..].chunks_exact(4).zip(&tap.weights) {
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
        let taps = taps(image.height, height, filter);
        let row_len = width * 4;
        let mut data = Vec::with_capacity(height * row_len);
        let mut sums = vec![0i32; row_len];
        for tap in &taps {
            sums.fill(1 << (PRECISION_BITS - 1));
            for (row, &w) in
                current.data[tap.first * row_len..].chunks_exact(row_len).zip(&tap.weights)
            {
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

/// Pillow's RGBA → RGBa: c·a/255, rounded, in 8 bits. An opaque image, which may be large, stays
/// as it is.
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

/// Pillow's RGBa → RGBA: 255·c/a, truncated and clipped.
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

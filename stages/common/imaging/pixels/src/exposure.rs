use crate::image_buffer::Image;

/// Affine colour change between two exposures, per channel: v ↦ gain · v + offset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Gains of red, green and blue.
    pub gain: [f32; 3],
    /// Offsets of red, green and blue.
    pub offset: [f32; 3],
}

/// Samples outside this range are treated as clipped and ignored; chosen by hand.
const UNCLIPPED_RANGE: [f32; 2] = [0.02, 0.98];
/// Minimum number of blocks for a fit; chosen by hand.
const MIN_BLOCKS: f64 = 12.0;
/// Minimum variance of the reference's block means for a fit; chosen by hand.
const MIN_VARIANCE: f64 = 1e-5;
/// Range of plausible gains: images with a gain outside it show different content. Chosen by hand.
const GAIN_RANGE: [f32; 2] = [0.1, 10.0];
/// Maximum deviation of a gain from 1, and of an offset from 0, that a field's errors explain:
/// views of fern deviate by 1 %, of lego by 6 %.
const NEGLIGIBLE_CHANGE: [f32; 2] = [0.1, 0.05];

impl Exposure {
    /// Fits the exposure of `image` relative to `reference`, an image of the same size. The fit is
    /// by least squares per channel over means of square blocks; pixels that are clipped in either
    /// image are ignored. `None` if too few blocks remain, the reference is nearly uniform, or the
    /// gain is implausible.
    ///
    /// # Panics
    /// With fewer than three channels, different sizes, or a block of 0 pixels.
    pub fn fit(reference: &Image, image: &Image, block: usize) -> Option<Self> {
        assert_eq!(
            (reference.width, reference.height),
            (image.width, image.height),
            "images of one size"
        );
        let mut exposure = Self { gain: [1.0; 3], offset: [0.0; 3] };
        for c in 0..3 {
            let (mut n, mut x, mut y, mut xx, mut xy) = (0.0f64, 0.0, 0.0, 0.0, 0.0);
            for [expected, found] in block_means(reference, image, c, block) {
                n += 1.0;
                x += expected;
                y += found;
                xx += expected * expected;
                xy += expected * found;
            }
            let (variance, covariance) = (n * xx - x * x, n * xy - x * y);
            if n < MIN_BLOCKS || variance <= MIN_VARIANCE * n * n {
                return None;
            }
            let gain = covariance / variance;
            if !(GAIN_RANGE[0]..=GAIN_RANGE[1]).contains(&(gain as f32)) {
                return None;
            }
            exposure.gain[c] = gain as f32;
            exposure.offset[c] = ((y - gain * x) / n) as f32;
        }
        Some(exposure)
    }

    /// True if a field's errors explain the change: gains within 10 % of 1, offsets within 0.05.
    pub fn is_negligible(&self) -> bool {
        let [max_gain_change, max_offset] = NEGLIGIBLE_CHANGE;
        self.gain.iter().all(|g| (g - 1.0).abs() <= max_gain_change)
            && self.offset.iter().all(|o| o.abs() <= max_offset)
    }

    /// Undoes the exposure in an image; colours are clamped to [0, 1], premultiplied ones to
    /// [0, alpha].
    pub fn undo(&self, image: &mut Image) {
        for pixel in image.data.chunks_exact_mut(image.channels) {
            let alpha = if let [_, _, _, alpha] = pixel { *alpha } else { 1.0 };
            for (c, value) in pixel.iter_mut().take(3).enumerate() {
                *value =
                    ((*value - self.offset[c] * alpha) / self.gain[c]).clamp(0.0, alpha.max(0.0));
            }
        }
    }
}

/// Returns, for each block, the means of both images over pixels that are clipped in neither image.
/// Blocks with less than half of such pixels are omitted.
fn block_means(reference: &Image, image: &Image, channel: usize, block: usize) -> Vec<[f64; 2]> {
    let mut means = Vec::new();
    for y in (0..image.height).step_by(block) {
        for x in (0..image.width).step_by(block) {
            means.extend(block_mean([reference, image], channel, block, [x, y]));
        }
    }
    means
}

/// Returns both images' means over the block with top left corner [x, y].
fn block_mean(
    images: [&Image; 2],
    channel: usize,
    block: usize,
    [x, y]: [usize; 2],
) -> Option<[f64; 2]> {
    let (width, height) = (images[1].width, images[1].height);
    let (mut n, mut sum) = (0usize, [0.0f64; 2]);
    for row in y..(y + block).min(height) {
        for column in x..(x + block).min(width) {
            let pair =
                images.map(|image| image.data[(row * width + column) * image.channels + channel]);
            if pair.iter().all(|v| (UNCLIPPED_RANGE[0]..=UNCLIPPED_RANGE[1]).contains(v)) {
                n += 1;
                sum[0] += f64::from(pair[0]);
                sum[1] += f64::from(pair[1]);
            }
        }
    }
    (2 * n >= block * block).then(|| sum.map(|s| s / n as f64))
}

use crate::image_buffer::Image;

/// How another exposure made an image from what it should be, channel by channel: v ↦ gain · v +
/// offset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Factors of red, green and blue.
    pub gain: [f32; 3],
    /// What is added to each.
    pub offset: [f32; 3],
}

/// Samples beyond these are clipped, and say nothing of an exposure.
const UNCLIPPED_RANGE: [f32; 2] = [0.02, 0.98];
/// Fewer blocks say too little.
const LEAST_BLOCKS: f64 = 12.0;
/// Factors beyond these are no exposure: the images show different things.
const POSSIBLE_FACTORS: [f32; 2] = [0.1, 10.0];

impl Exposure {
    /// The exposure of an image against another of its size that has the right one: the line
    /// through both by least squares, a channel at a time. Means of square blocks of pixels are
    /// compared, of what is clipped in neither. None where too little is left, or no line fits.
    ///
    /// # Panics
    /// With fewer than three channels, other sizes, or no pixels in a block.
    pub fn between(right: &Image, seen: &Image, block: usize) -> Option<Self> {
        assert_eq!((right.width, right.height), (seen.width, seen.height), "images of one size");
        let mut exposure = Self { gain: [1.0; 3], offset: [0.0; 3] };
        for c in 0..3 {
            let (mut n, mut x, mut y, mut xx, mut xy) = (0.0f64, 0.0, 0.0, 0.0, 0.0);
            for [r, t] in block_means(right, seen, c, block) {
                (n, x, y, xx, xy) = (n + 1.0, x + r, y + t, xx + r * r, xy + r * t);
            }
            let (spread, together) = (n * xx - x * x, n * xy - x * y);
            if n < LEAST_BLOCKS || spread <= 1e-5 * n * n {
                return None;
            }
            let gain = together / spread;
            if !(POSSIBLE_FACTORS[0]..=POSSIBLE_FACTORS[1]).contains(&(gain as f32)) {
                return None;
            }
            (exposure.gain[c], exposure.offset[c]) = (gain as f32, ((y - gain * x) / n) as f32);
        }
        Some(exposure)
    }

    /// No more than what a field gets wrong: factors within 10 % and offsets within 0.05 are none.
    /// (Views of fern come to 1 %, of lego to 6 %.)
    pub fn is_none(&self) -> bool {
        self.gain.iter().all(|g| (g - 1.0).abs() <= 0.1)
            && self.offset.iter().all(|o| o.abs() <= 0.05)
    }

    /// Gives an image the right exposure: colours in 0..1, or from 0 to alpha where they are
    /// premultiplied.
    pub fn take_back(&self, image: &mut Image) {
        for pixel in image.data.chunks_exact_mut(image.channels) {
            let alpha = if let [_, _, _, alpha] = pixel { *alpha } else { 1.0 };
            for (c, value) in pixel.iter_mut().take(3).enumerate() {
                *value =
                    ((*value - self.offset[c] * alpha) / self.gain[c]).clamp(0.0, alpha.max(0.0));
            }
        }
    }
}

/// Means of both images' channel over blocks, of those blocks of which at least half is clipped in
/// neither.
fn block_means(right: &Image, seen: &Image, channel: usize, block: usize) -> Vec<[f64; 2]> {
    let mut means = Vec::new();
    for y in (0..seen.height).step_by(block) {
        for x in (0..seen.width).step_by(block) {
            means.extend(block_mean([right, seen], channel, block, [x, y]));
        }
    }
    means
}

/// Both images' means over the block whose top left corner is at a column and row.
fn block_mean(
    images: [&Image; 2],
    channel: usize,
    block: usize,
    [x, y]: [usize; 2],
) -> Option<[f64; 2]> {
    let (width, height) = (images[1].width, images[1].height);
    let is_known = |v: f32| (UNCLIPPED_RANGE[0]..=UNCLIPPED_RANGE[1]).contains(&v);
    let (mut n, mut sum) = (0usize, [0.0f64; 2]);
    for row in y..(y + block).min(height) {
        for column in x..(x + block).min(width) {
            let pair =
                images.map(|image| image.data[(row * width + column) * image.channels + channel]);
            if pair.into_iter().all(is_known) {
                n += 1;
                (0..2).for_each(|i| sum[i] += f64::from(pair[i]));
            }
        }
    }
    (2 * n >= block * block).then(|| sum.map(|s| s / n as f64))
}

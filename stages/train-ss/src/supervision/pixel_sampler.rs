use numerics::CounterRng;
use pixels::Image;
use rayon::prelude::*;

use crate::photographs::PixelSet;

/// Sampler of the pixel that a bundle trains on. Pixels are indexed over all views in order; a
/// pixel of an HR reference has several indices, so that it is drawn more often.
pub(crate) struct PixelSampler {
    pub(crate) views: Vec<ViewPixels>,
    /// Total number of pixel indices.
    pub(crate) index_count: u64,
    pub(crate) importance: Importance,
    /// True if each pixel index is drawn once per epoch.
    pub(crate) in_epochs: bool,
    /// Number of bundles at the start that come from the middle half of each image's width and
    /// height.
    pub(crate) precrop_bundles: u64,
    pub(crate) seed: u64,
}

/// Size and first pixel index of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ViewPixels {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Number of pixel indices of the previous views.
    pub(crate) start: u64,
}

/// RNG stream of pixel draws.
const PIXEL_STREAM: u64 = 100;

/// First of the four RNG streams of an epoch's permutation.
const EPOCH_STREAM: u64 = 110;

/// Maximum number of draws until a pixel is valid, chosen by hand. The last draw is used unchecked;
/// an invalid pixel has no residual.
const MAX_DRAWS: usize = 64;

impl PixelSampler {
    /// Returns the view and pixel that a bundle trains on. Epochs ignore `is_valid(view, pixel)`,
    /// since they contain all pixels.
    pub(crate) fn draw(
        &self,
        bundle: u64,
        is_valid: impl Fn(usize, usize) -> bool,
    ) -> (usize, usize) {
        let mut rng = CounterRng::new(self.seed, PIXEL_STREAM, bundle);
        let is_precrop = bundle < self.precrop_bundles;
        if self.in_epochs && !is_precrop {
            let bundle = bundle - self.precrop_bundles;
            let (epoch, index) = (bundle / self.index_count, bundle % self.index_count);
            return self.pixel(permuted(self.seed, epoch, index, self.index_count));
        }
        let mut drawn = self.draw_once(is_precrop, &mut rng);
        for _ in 1..MAX_DRAWS {
            if is_valid(drawn.0, drawn.1) {
                break;
            }
            drawn = self.draw_once(is_precrop, &mut rng);
        }
        drawn
    }

    /// Draws a view and a pixel. With `is_precrop`, importance chooses only the view, and the pixel
    /// is uniform in the middle half of the view's width and height.
    fn draw_once(&self, is_precrop: bool, rng: &mut CounterRng) -> (usize, usize) {
        let (view, pixel) = self.pixel(self.importance.draw(self.index_count, rng));
        if !is_precrop {
            return (view, pixel);
        }
        let ViewPixels { width, height, .. } = self.views[view];
        let [x, y] = [width, height]
            .map(|length| length / 4 + rng.below((length as u64 / 2).max(1)) as usize);
        (view, y * width + x)
    }

    /// Returns the view and pixel of a pixel index.
    fn pixel(&self, index: u64) -> (usize, usize) {
        let view = self.views.partition_point(|view| view.start <= index) - 1;
        let ViewPixels { width, height, start } = self.views[view];
        (view, (index - start) as usize % (width * height))
    }

    /// Returns the weight of the loss of a bundle that trains on a pixel of a view.
    pub(crate) fn weight(&self, bundle: u64, (view, pixel): (usize, usize)) -> f32 {
        if bundle < self.precrop_bundles {
            1.0
        } else {
            self.importance.weight(self.views[view].start + pixel as u64)
        }
    }
}

/// Importance sampling: pixels with detail around them are drawn more often than flat ones, and
/// each pixel's loss is multiplied by the ratio of the uniform to the actual draw rate, so that the
/// expected loss and gradient are those of uniform draws (design note 010).
pub(crate) struct Importance {
    /// Indices of the pixels with detail.
    detailed: PixelSet,
    /// Fraction of the draws that are uniform over all pixels; the others are uniform over detailed
    /// pixels, which are valid.
    uniform_share: f32,
    flat_weight: f32,
    detailed_weight: f32,
}

impl Importance {
    /// Creates a sampler that draws detailed pixels `ratio` times as often as flat ones.
    /// `valid_count` of the `index_count` indices are of valid pixels.
    pub(crate) fn new(
        ratio: f64,
        (index_count, valid_count): (u64, u64),
        detailed: PixelSet,
    ) -> Self {
        let detailed_share = detailed.len() as f64 / valid_count.max(1) as f64;
        if ratio <= 1.0 || detailed_share <= 0.0 {
            return Self { detailed, uniform_share: 1.0, flat_weight: 1.0, detailed_weight: 1.0 };
        }
        let uniform_share = 1.0 / (ratio - 1.0).mul_add(detailed_share, 1.0);
        // Uniform draws of invalid pixels are repeated, so there must be more uniform draws.
        let invalid_share = 1.0 - valid_count as f64 / index_count as f64;
        let drawn_share = uniform_share / (1.0 - invalid_share * (1.0 - uniform_share));
        Self {
            detailed,
            uniform_share: drawn_share as f32,
            flat_weight: (1.0 / uniform_share) as f32,
            detailed_weight: (1.0 / (uniform_share * ratio)) as f32,
        }
    }

    /// True if all draws are uniform, even if a few pixels have detail: a share just below 1 is
    /// rounded to 1.
    fn is_uniform(&self) -> bool {
        self.uniform_share >= 1.0
    }

    /// Draws a pixel index below `index_count`.
    pub(crate) fn draw(&self, index_count: u64, rng: &mut CounterRng) -> u64 {
        if self.is_uniform() || rng.uniform() < self.uniform_share {
            return rng.below(index_count);
        }
        let n = rng.below(self.detailed.len());
        self.detailed.nth(n).expect("n is below the number of detailed pixels")
    }

    /// Returns the weight of a pixel's loss.
    pub(crate) fn weight(&self, index: u64) -> f32 {
        if !self.is_uniform() && self.detailed.contains(index) {
            self.detailed_weight
        } else {
            self.flat_weight
        }
    }
}

/// Maximum range of a channel over the 3×3 pixels around a flat pixel (design note 010).
const MAX_FLAT_RANGE: f32 = 8.0 / 255.0;

/// Returns for every pixel whether a channel varies around it.
pub(crate) fn detailed_pixels(image: &Image) -> Vec<bool> {
    let (width, channels) = (image.width, image.channels);
    let row = width * channels;
    let mut detailed = vec![false; width * image.height];
    detailed.par_chunks_mut(width.max(1)).enumerate().for_each_init(
        // Minimum and maximum over three rows.
        || (vec![0.0f32; row], vec![0.0f32; row]),
        |(low, high), (y, detailed)| {
            low.fill(f32::MAX);
            high.fill(f32::MIN);
            for j in adjacent(y, image.height) {
                for (i, &v) in image.data[j * row..(j + 1) * row].iter().enumerate() {
                    low[i] = low[i].min(v);
                    high[i] = high[i].max(v);
                }
            }
            for (x, detailed) in detailed.iter_mut().enumerate() {
                *detailed = (0..channels).any(|c| {
                    let samples = adjacent(x, width).map(|i| i * channels + c);
                    let (min, max) = samples.fold((f32::MAX, f32::MIN), |(min, max), i| {
                        (min.min(low[i]), max.max(high[i]))
                    });
                    max - min > MAX_FLAT_RANGE
                });
            }
        },
    );
    detailed
}

/// Returns an index and its neighbours.
fn adjacent(index: usize, length: usize) -> std::ops::Range<usize> {
    index.saturating_sub(1)..(index + 2).min(length)
}

/// Returns the index-th of `count` numbers in an epoch's random order: a Feistel cipher over the
/// next power of four, repeated while its result is not below `count`. The permutation needs no
/// memory and can be evaluated anywhere by any thread.
pub(crate) fn permuted(seed: u64, epoch: u64, index: u64, count: u64) -> u64 {
    let bits = (64 - (count - 1).leading_zeros()).div_ceil(2).max(1);
    let mask = (1u64 << bits) - 1;
    let mut number = index;
    loop {
        let (mut left, mut right) = (number >> bits, number & mask);
        for round in 0..4 {
            let stream = EPOCH_STREAM + round;
            let mixed = CounterRng::new(seed, stream, (epoch << 32) ^ right).below(mask + 1);
            (left, right) = (right, left ^ mixed);
        }
        number = left << bits | right;
        if number < count {
            return number;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pixels with detail are drawn at the given ratio, and the expected weighted loss is that of
    /// uniform draws.
    #[test]
    fn importance_sampling_keeps_the_expectation() {
        let mut flat = Image::new(20, 10, 3, vec![0.5; 600]);
        flat.data[3 * (3 * 20 + 4)] = 0.9;
        let is_near_dot =
            |pixel: usize| (2..5).contains(&(pixel / 20)) && (3..6).contains(&(pixel % 20));
        assert!(detailed_pixels(&flat).into_iter().eq((0..200).map(is_near_dot)));
        let detailed = detailed_pixels(&flat).into_iter().collect();
        let importance = Importance::new(7.0, (200, 200), detailed);
        let (mut counts, draws) = ([0u32; 200], 400_000);
        (0..draws).for_each(|k| {
            counts[importance.draw(200, &mut CounterRng::new(1, 2, k)) as usize] += 1;
        });
        for (pixel, &count) in (0..200).zip(&counts) {
            let mean =
                f64::from(count) * 200.0 / draws as f64 * f64::from(importance.weight(pixel));
            assert!((mean - 1.0).abs() < 0.12, "{pixel}: {mean}");
        }
        let (dot, elsewhere) = (counts[3 * 20 + 4], counts[6 * 20..].iter().sum::<u32>());
        let ratio = f64::from(dot) / (f64::from(elsewhere) / 80.0);
        assert!((ratio - 7.0).abs() < 0.6, "{ratio}");
        let one_pixel = [false, false, false, true].into_iter().collect();
        let no_pixel = PixelSet::default();
        for uniform in [(1.0, one_pixel), (5.0, no_pixel)]
            .map(|(ratio, detailed)| Importance::new(ratio, (200, 200), detailed))
        {
            assert!(uniform.weight(3) == 1.0 && uniform.uniform_share == 1.0);
        }
    }

    /// Returns a sampler of a view of 8 × 8 pixels.
    fn sampler(importance: Importance, in_epochs: bool, precrop_bundles: u64) -> PixelSampler {
        let views = vec![ViewPixels { width: 8, height: 8, start: 0 }];
        PixelSampler { views, index_count: 64, importance, in_epochs, precrop_bundles, seed: 3 }
    }

    /// Masked pixels are never drawn, and the mean weight of the others is 1.
    #[test]
    fn importance_sampling_under_a_mask_keeps_the_expectation() {
        let detailed = (0..64).map(|pixel| pixel % 8 == 1).collect();
        let importance = Importance::new(10.0, (64, 32), detailed);
        let sampler = sampler(importance, false, 0);
        let (mut counts, draws) = ([0u32; 64], 400_000);
        for bundle in 0..draws {
            counts[sampler.draw(bundle, |_, pixel| pixel % 8 < 4).1] += 1;
        }
        for (pixel, &count) in counts.iter().enumerate() {
            let weight = f64::from(sampler.weight(0, (0, pixel)));
            let mean = f64::from(count) * 32.0 / draws as f64 * weight;
            let expected = if pixel % 8 < 4 { 1.0 } else { 0.0 };
            assert!((mean - expected).abs() < 0.12, "{pixel}: {mean}");
        }
    }

    /// Bundles of the precrop are drawn from the middle half, and never from masked pixels there.
    #[test]
    fn precrop_draws_unmasked_pixels_of_the_middle() {
        let importance = Importance::new(1.0, (64, 64), PixelSet::default());
        let sampler = sampler(importance, true, 1000);
        for bundle in 0..1000 {
            let (_, pixel) = sampler.draw(bundle, |_, pixel| pixel % 8 < 4);
            let (x, y) = (pixel % 8, pixel / 8);
            assert!((2..4).contains(&x) && (2..6).contains(&y), "{bundle}: {x}, {y}");
        }
    }

    #[test]
    fn an_epoch_contains_every_number_once() {
        for n in [1, 2, 3, 17, 1000] {
            let mut order: Vec<u64> = (0..n).map(|i| permuted(7, 3, i, n)).collect();
            order.sort_unstable();
            assert!(order.iter().copied().eq(0..n));
        }
    }
}

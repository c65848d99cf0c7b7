use counter_rng::CounterRng;
use pixels::Image;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::pixel_set::PixelSet;

/// Orders in which pixels are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Order {
    /// Each time any pixel, independently.
    Random,
    /// Each pixel once in random order, then again in another order.
    Epochs,
}

/// Draws the pixel that a bundle trains on. Pixels of all views have numbers, one view after the
/// other.
pub(crate) struct PixelSampler {
    views: Vec<Numbered>,
    /// Numbers of all pixels.
    numbers: u64,
    focus: Focus,
    pub(crate) order: Order,
    /// Bundles at the start that come from the middle half of each image's width and height alone.
    pub(crate) precrop_bundles: u64,
    seed: u64,
}

/// A view's size, and how many numbers the pixels of the views before it have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Numbered {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) before: u64,
}

/// Purpose of a draw.
const PIXEL: u64 = 100;

/// Draws until one is of a pixel that counts; after so many the last is taken, and has no residual.
const MOST_DRAWS: usize = 64;

impl PixelSampler {
    /// Of views whose pixels have so many numbers together.
    pub(crate) fn new(
        views: Vec<Numbered>,
        numbers: u64,
        focus: Focus,
        (order, precrop_bundles): (Order, u64),
        seed: u64,
    ) -> Self {
        Self { views, numbers, focus, order, precrop_bundles, seed }
    }

    /// The view and pixel that a bundle trains on. `counts` says of one whether anything is known
    /// of it.
    pub(crate) fn draw(
        &self,
        bundle: u64,
        counts: impl Fn(usize, usize) -> bool,
    ) -> (usize, usize) {
        let mut rng = CounterRng::new(self.seed, PIXEL, bundle);
        let (view, pixel) = match self.order {
            Order::Epochs if bundle >= self.precrop_bundles => {
                let bundle = bundle - self.precrop_bundles;
                self.place(shuffled(
                    self.seed,
                    bundle / self.numbers,
                    bundle % self.numbers,
                    self.numbers,
                ))
            }
            _ => {
                let mut place = self.place(self.focus.draw(self.numbers, &mut rng));
                for _ in 1..MOST_DRAWS {
                    if counts(place.0, place.1) {
                        break;
                    }
                    place = self.place(self.focus.draw(self.numbers, &mut rng));
                }
                place
            }
        };
        if bundle < self.precrop_bundles {
            let Numbered { width, height, .. } = self.views[view];
            let mut middle =
                |length: usize| length / 4 + rng.below((length as u64 / 2).max(1)) as usize;
            let (x, y) = (middle(width), middle(height));
            return (view, y * width + x);
        }
        (view, pixel)
    }

    /// The view and its pixel that have a number.
    fn place(&self, number: u64) -> (usize, usize) {
        let view = self.views.partition_point(|v| v.before <= number) - 1;
        let Numbered { width, height, before } = self.views[view];
        (view, (number - before) as usize % (width * height))
    }

    /// Weight of the loss of a bundle that trains on a pixel of a view.
    pub(crate) fn weight(&self, bundle: u64, (view, pixel): (usize, usize)) -> f32 {
        if bundle < self.precrop_bundles {
            1.0
        } else {
            self.focus.weight(self.views[view].before + pixel as u64)
        }
    }

    /// Numbers of all pixels.
    #[cfg(test)]
    pub(crate) fn numbers(&self) -> u64 {
        self.numbers
    }
}

/// Draws pixels that have detail around them more often than flat ones, and weighs each pixel's
/// loss by how much more rarely than evenly it is drawn: the expectation of the loss and of its
/// gradient is that of even draws.
pub(crate) struct Focus {
    /// Numbers of the pixels with detail, among those of all views.
    detailed: PixelSet,
    /// Share of the draws that are even, over all pixels; the others are among the detailed ones.
    even: f32,
    /// Weights of a flat and of a detailed pixel's loss.
    weights: [f32; 2],
}

/// Range of a channel over 3×3 pixels below which they are flat.
const FLAT_RANGE: f32 = 8.0 / 255.0;

impl Focus {
    /// Detailed pixels are drawn `importance` times as often as flat ones.
    pub(crate) fn new(importance: f64, pixels: u64, detailed: PixelSet) -> Self {
        let share = detailed.len() as f64 / pixels.max(1) as f64;
        let even = if importance > 1.0 && share > 0.0 {
            1.0 / (importance - 1.0).mul_add(share, 1.0)
        } else {
            1.0
        };
        let weights = [1.0 / even, 1.0 / (even * importance)]
            .map(|w| if even < 1.0 { w as f32 } else { 1.0 });
        Self { detailed, even: even as f32, weights }
    }

    /// Draws the number of a pixel.
    pub(crate) fn draw(&self, pixels: u64, rng: &mut CounterRng) -> u64 {
        if self.even == 1.0 || rng.uniform() < self.even {
            return rng.below(pixels);
        }
        self.detailed.nth(rng.below(self.detailed.len())).unwrap_or_default()
    }

    /// Weight of a pixel's loss.
    pub(crate) fn weight(&self, pixel: u64) -> f32 {
        self.weights[usize::from(self.even < 1.0 && self.detailed.contains(pixel))]
    }
}

/// Of every pixel whether it isn't flat.
pub(crate) fn detailed(image: &Image) -> Vec<bool> {
    let (width, channels) = (image.width, image.channels);
    let row = width * channels;
    let near = |at: usize, end: usize| at.saturating_sub(1)..(at + 2).min(end);
    let mut detailed = vec![false; width * image.height];
    // Ranges over three rows, and then of three such columns.
    let buffers = || (vec![0.0f32; row], vec![0.0f32; row]);
    detailed.par_chunks_mut(width.max(1)).enumerate().for_each_init(
        buffers,
        |(low, high), (y, detailed)| {
            low.fill(f32::MAX);
            high.fill(f32::MIN);
            for line in near(y, image.height).map(|j| &image.data[j * row..(j + 1) * row]) {
                low.iter_mut().zip(line).for_each(|(low, v)| *low = low.min(*v));
                high.iter_mut().zip(line).for_each(|(high, v)| *high = high.max(*v));
            }
            for (x, detailed) in detailed.iter_mut().enumerate() {
                *detailed = (0..channels).any(|c| {
                    let columns = near(x, width).map(|i| i * channels + c);
                    let (low, high) = columns
                        .fold((f32::MAX, f32::MIN), |(l, h), at| (l.min(low[at]), h.max(high[at])));
                    high - low > FLAT_RANGE
                });
            }
        },
    );
    detailed
}

/// Purpose of an epoch's draws; the first of four.
const ORDER: u64 = 110;

/// Where the i-th of n numbers comes in an epoch's random order: a Feistel cipher over the next
/// power of four, which is gone through again from what lies beyond n. So the order needs no
/// memory, and any thread may ask for any place.
pub(crate) fn shuffled(seed: u64, epoch: u64, i: u64, n: u64) -> u64 {
    let bits = (64 - (n - 1).leading_zeros()).div_ceil(2).max(1);
    let mask = (1u64 << bits) - 1;
    let mut at = i;
    loop {
        let (mut left, mut right) = (at >> bits, at & mask);
        for round in 0..4 {
            let mixed = CounterRng::new(seed, ORDER + round, (epoch << 32) ^ right).below(mask + 1);
            (left, right) = (right, left ^ mixed);
        }
        at = left << bits | right;
        if at < n {
            return at;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pixels with detail are drawn as often as asked for, and the weighted loss expects what even
    /// draws do.
    #[test]
    fn focus_keeps_the_expectation() {
        let mut flat = Image::new(20, 10, 3, vec![0.5; 600]);
        flat.data[3 * (3 * 20 + 4)] = 0.9;
        let around_dot =
            |pixel: usize| (2..5).contains(&(pixel / 20)) && (3..6).contains(&(pixel % 20));
        assert!(detailed(&flat).into_iter().eq((0..200).map(around_dot)));
        let focus = Focus::new(7.0, 200, detailed(&flat).into_iter().collect());
        let (mut counts, draws) = ([0u32; 200], 400_000);
        (0..draws)
            .for_each(|k| counts[focus.draw(200, &mut CounterRng::new(1, 2, k)) as usize] += 1);
        for (pixel, &count) in (0..200).zip(&counts) {
            let mean = f64::from(count) * 200.0 / draws as f64 * f64::from(focus.weight(pixel));
            assert!((mean - 1.0).abs() < 0.12, "{pixel}: {mean}");
        }
        let (dot, elsewhere) = (counts[3 * 20 + 4], counts[6 * 20..].iter().sum::<u32>());
        let often = f64::from(dot) / (f64::from(elsewhere) / 80.0);
        assert!((often - 7.0).abs() < 0.6, "{often}");
        let third = [false, false, false, true].into_iter().collect();
        for even in [Focus::new(1.0, 200, third), Focus::new(5.0, 200, PixelSet::default())] {
            assert!(even.weight(3) == 1.0 && even.even == 1.0);
        }
    }

    #[test]
    fn an_epoch_has_every_number_once() {
        for n in [1, 2, 3, 17, 1000] {
            let mut order: Vec<u64> = (0..n).map(|i| shuffled(7, 3, i, n)).collect();
            order.sort_unstable();
            assert!(order.iter().copied().eq(0..n));
        }
    }
}

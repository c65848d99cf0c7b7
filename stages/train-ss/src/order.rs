use counter_rng::CounterRng;
use pixels::Image;

/// Draws pixels that have detail around them more often than flat ones, and weighs each pixel's loss by how much more rarely than
/// evenly it is drawn: the expectation of the loss and of its gradient is that of even draws.
pub(crate) struct Focus {
    /// Numbers of the pixels with detail, among those of all views.
    detailed: Vec<u64>,
    /// Share of the draws that are even, over all pixels; the others are among the detailed ones.
    even: f32,
    /// Weights of a flat and of a detailed pixel's loss.
    weights: [f32; 2],
}

/// Range of a channel over 3×3 pixels below which they are flat.
const FLAT: f32 = 8.0 / 255.0;

impl Focus {
    /// Detailed pixels are drawn `importance` times as often as flat ones.
    pub(crate) fn new(importance: f64, pixels: u64, detailed: Vec<u64>) -> Self {
        let share = detailed.len() as f64 / pixels.max(1) as f64;
        let even = if importance > 1.0 && share > 0.0 { 1.0 / (importance - 1.0).mul_add(share, 1.0) } else { 1.0 };
        let weights = [1.0 / even, 1.0 / (even * importance)].map(|w| if even < 1.0 { w as f32 } else { 1.0 });
        Self { detailed, even: even as f32, weights }
    }

    /// Draws the number of a pixel.
    pub(crate) fn draw(&self, pixels: u64, rng: &mut CounterRng) -> u64 {
        if self.even == 1.0 || rng.uniform() < self.even {
            rng.below(pixels)
        } else {
            self.detailed[rng.below(self.detailed.len() as u64) as usize]
        }
    }

    /// Weight of a pixel's loss.
    pub(crate) fn weight(&self, pixel: u64) -> f32 {
        self.weights[usize::from(self.even < 1.0 && self.detailed.binary_search(&pixel).is_ok())]
    }
}

/// Which pixels aren't flat, in order.
pub(crate) fn detailed(image: &Image) -> impl Iterator<Item = usize> + '_ {
    let near = |at: usize, end: usize| at.saturating_sub(1)..(at + 2).min(end);
    (0..image.width * image.height).filter(move |&pixel| {
        let (x, y) = (pixel % image.width, pixel / image.width);
        (0..image.channels).any(|c| {
            let around = near(y, image.height).flat_map(|j| near(x, image.width).map(move |i| (i, j)));
            let value = |(i, j): (usize, usize)| image.data[(j * image.width + i) * image.channels + c];
            let (low, high) = around.map(value).fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(v), high.max(v)));
            high - low > FLAT
        })
    })
}

/// Purpose of an epoch's draws; the first of four.
const ORDER: u64 = 110;

/// Where the i-th of n numbers comes in an epoch's random order: a Feistel cipher over the next power of four, which is gone
/// through again from what lies beyond n. So the order needs no memory, and any thread may ask for any place.
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

    /// Pixels with detail are drawn as often as asked for, and the weighted loss expects what even draws do.
    #[test]
    fn focus_keeps_the_expectation() {
        let mut flat = Image::new(20, 10, 3, vec![0.5; 600]);
        flat.data[3 * (3 * 20 + 4)] = 0.9;
        assert!(detailed(&flat).eq((2..5).flat_map(|y| (3..6).map(move |x| 20 * y + x))), "what is around a dot");
        let focus = Focus::new(7.0, 200, detailed(&flat).map(|p| p as u64).collect());
        let (mut counts, draws) = ([0u32; 200], 400_000);
        (0..draws).for_each(|k| counts[focus.draw(200, &mut CounterRng::new(1, 2, k)) as usize] += 1);
        for (pixel, &count) in (0..200).zip(&counts) {
            let mean = f64::from(count) * 200.0 / draws as f64 * f64::from(focus.weight(pixel));
            assert!((mean - 1.0).abs() < 0.12, "{pixel}: {mean}");
        }
        let (dot, elsewhere) = (counts[3 * 20 + 4], counts[6 * 20..].iter().sum::<u32>());
        let often = f64::from(dot) / (f64::from(elsewhere) / 80.0);
        assert!((often - 7.0).abs() < 0.6, "{often}");
        for even in [Focus::new(1.0, 200, vec![3]), Focus::new(5.0, 200, Vec::new())] {
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

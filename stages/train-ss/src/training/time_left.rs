use std::time::Instant;

use radiance::StepReport;
use scene::Background;

use crate::params::{Resolved, ResolvedField};

/// Exponents by which a ray's cost falls with the step: the occupancy grid finds the empty space,
/// and larger steps share their fixed costs among more rays. Silhouettes tell the empty space at
/// once; rays of opaque scenes start with most samples. Measured on lego 100×2 with and without
/// silhouettes, fern 252×2 and the demo scene with and without a backdrop (design note 048).
const SILHOUETTES_EXPONENT: f64 = 0.15;
const OBJECT_EXPONENT: f64 = 0.25;
const OPAQUE_EXPONENT: f64 = 0.45;
/// Cost of a ray while each LR pixel has one ray, relative to a ray of several: neighbouring rays
/// read the same cells. Measured on the same scenes.
const SINGLE_RAY_COST: f64 = 1.2;
/// Minimum number of steps over which the current pace is averaged; chosen by hand.
const MIN_WINDOW_STEPS: f64 = 32.0;
/// Number of steps taken, divided by the number of steps in the averaging window; chosen by hand.
const STEPS_PER_WINDOW_STEP: f64 = 8.0;
/// Number of parts of growing size in which the remaining rays are predicted; chosen by hand.
const PARTS: u32 = 64;

/// Numbers of rays that the remaining time depends on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrainingRays {
    /// Rays of this training.
    pub(crate) total: u64,
    /// Rays that this training has still to cast.
    pub(crate) remaining: u64,
    /// Rays of the trainings that follow.
    pub(crate) further: u64,
}

/// Estimate of the remaining time of a training, from its current pace and the usual change of a
/// ray's cost.
#[derive(Clone, Debug)]
pub(crate) struct TimeLeft {
    /// Exponent by which a ray's cost falls with the step.
    exponent: f64,
    /// Number of rays, at first, that cost [`SINGLE_RAY_COST`].
    single_rays: f64,
    /// End of the last step.
    last: Instant,
    /// Number of steps that this process has taken.
    steps: f64,
    /// Decayed sums of recent seconds and rays.
    seconds: f64,
    rays: f64,
}

impl TimeLeft {
    /// Starts measuring. A training that is initialised from a field has a known occupancy grid.
    pub(crate) fn new(
        params: &Resolved,
        is_initialised: bool,
        has_silhouettes: bool,
        background: Background,
    ) -> Self {
        let is_grid = matches!(params.field, ResolvedField::Grid { .. });
        let exponent = match background {
            _ if is_initialised || !is_grid => 0.0,
            Background::Opaque => OPAQUE_EXPONENT,
            _ if has_silhouettes => SILHOUETTES_EXPONENT,
            _ => OBJECT_EXPONENT,
        };
        Self {
            exponent,
            single_rays: params.single_rays(),
            last: Instant::now(),
            steps: 0.0,
            seconds: 0.0,
            rays: 0.0,
        }
    }

    /// Records a step that has just ended.
    pub(crate) fn add(&mut self, report: &StepReport) {
        let seconds = self.last.elapsed().as_secs_f64();
        self.last = Instant::now();
        self.add_seconds(report.rays, seconds);
    }

    fn add_seconds(&mut self, rays: usize, seconds: f64) {
        self.steps += 1.0;
        let kept = 1.0 - 1.0 / self.window();
        self.seconds = kept * self.seconds + seconds;
        self.rays = kept * self.rays + rays as f64;
    }

    /// Returns the remaining seconds after `step` steps: those of the `remaining` rays of this
    /// training, and of `further` rays of other trainings, each as long as this one.
    pub(crate) fn seconds(&self, step: u64, rays: TrainingRays) -> f64 {
        if self.rays == 0.0 {
            return 0.0;
        }
        // The recent steps' average is the pace of half a window ago, which matters at first.
        let before = (step as f64 - MIN_WINDOW_STEPS / 2.0).max(0.0);
        let (total, remaining) = (rays.total as f64, rays.remaining as f64);
        let done = total - remaining;
        let cost = self.cost(before, done - self.rays / 2.0);
        let step_cost = cost * self.rays / self.window().min(self.steps);
        let own = self.total_cost(step as f64, done, remaining, step_cost);
        let each = self.total_cost(0.0, 0.0, total, step_cost);
        let others = rays.further as f64 / total.max(1.0) * each;
        self.seconds / self.rays / cost * (own + others)
    }

    /// Returns the cost of `rays` rays from a step on, after `done` rays. Steps have about equal
    /// costs.
    fn total_cost(&self, mut step: f64, mut done: f64, rays: f64, step_cost: f64) -> f64 {
        let mut sum = 0.0;
        for part in 1..=PARTS {
            // Later parts are larger, since costs change early.
            let part = rays * f64::from(part) / f64::from(PARTS * (PARTS + 1) / 2);
            let cost = part * self.cost(step, done);
            sum += cost;
            done += part;
            step += cost / step_cost;
        }
        sum
    }

    /// Returns the number of steps in the averaging window, even if fewer were taken.
    fn window(&self) -> f64 {
        (self.steps / STEPS_PER_WINDOW_STEP).max(MIN_WINDOW_STEPS)
    }

    /// Returns the cost of a ray at a step, after `done` rays, relative to one of several rays of a
    /// pixel in the first step.
    fn cost(&self, step: f64, done: f64) -> f64 {
        let factor = if done < self.single_rays { SINGLE_RAY_COST } else { 1.0 };
        factor * (step + 1.0).powf(-self.exponent)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps, rays and seconds of `balanced` on two threads, up to its end: lego 100×2, fern 252×2,
    /// and 60 photographs of 1600×1200 of the demo scene with a backdrop.
    const LEGO: &[(u64, u64, f64)] = &[
        (48, 29_643, 0.6),
        (96, 64_771, 1.3),
        (144, 109_938, 1.8),
        (240, 192_824, 2.8),
        (480, 403_508, 4.9),
        (720, 631_533, 7.0),
        (960, 874_766, 9.2),
        (1_440, 1_398_494, 13.5),
        (1_920, 1_972_495, 18.3),
        (2_400, 2_591_013, 23.2),
        (3_360, 4_092_734, 35.0),
        (4_320, 6_116_874, 48.7),
        (5_784, 10_471_654, 76.9),
    ];
    const FERN: &[(u64, u64, f64)] = &[
        (48, 16_299, 2.2),
        (96, 33_283, 3.4),
        (144, 51_657, 4.6),
        (240, 86_478, 6.5),
        (480, 181_688, 10.9),
        (720, 295_084, 14.4),
        (960, 424_644, 17.8),
        (1_440, 742_895, 25.4),
        (1_920, 1_142_276, 34.3),
        (2_400, 1_650_714, 42.1),
        (3_360, 3_044_514, 60.3),
        (3_816, 3_988_398, 72.4),
    ];
    const BACKDROP: &[(u64, u64, f64)] = &[
        (48, 12_288, 3.3),
        (96, 24_576, 4.8),
        (144, 39_661, 5.8),
        (240, 69_080, 7.7),
        (480, 143_637, 12.4),
        (720, 238_022, 16.1),
        (960, 346_782, 19.7),
        (1_440, 598_090, 26.8),
        (1_920, 892_613, 33.5),
        (3_360, 1_939_616, 53.9),
        (4_800, 3_201_252, 75.3),
        (7_200, 5_743_157, 109.8),
        (9_600, 8_872_335, 147.0),
        (12_000, 12_657_687, 185.1),
        (14_400, 17_372_895, 226.4),
        (17_304, 24_977_251, 290.7),
    ];

    /// Returns an estimate before the first step.
    fn unmeasured(exponent: f64, single_rays: f64) -> TimeLeft {
        let zero = TimeLeft {
            exponent,
            single_rays,
            last: Instant::now(),
            steps: 0.0,
            seconds: 0.0,
            rays: 0.0,
        };
        assert_eq!(zero.seconds(0, rays(100, 0)), 0.0);
        zero
    }

    fn rays(total: u64, done: u64) -> TrainingRays {
        TrainingRays { total, remaining: total - done, further: 0 }
    }

    /// Returns the elapsed and the estimated remaining seconds at each point of a measured training.
    fn estimates(points: &[(u64, u64, f64)], exponent: f64) -> Vec<(f64, f64)> {
        let total = points.last().unwrap().1;
        let mut time_left = unmeasured(exponent, 0.3 * total as f64);
        let mut previous = (0, 0, 0.0);
        let mut estimates = Vec::new();
        for &(step, done, seconds) in points {
            let steps = step - previous.0;
            for _ in 0..steps {
                let rays = (done - previous.1) / steps;
                time_left.add_seconds(rays as usize, (seconds - previous.2) / steps as f64);
            }
            previous = (step, done, seconds);
            estimates.push((seconds, time_left.seconds(step, rays(total, done))));
        }
        estimates
    }

    /// From a tenth of the time on, or from ten seconds on, the estimate is within 30 % of the true
    /// time.
    #[test]
    fn remaining_time_is_predicted() {
        for (points, exponent) in
            [(LEGO, SILHOUETTES_EXPONENT), (FERN, OPAQUE_EXPONENT), (BACKDROP, OPAQUE_EXPONENT)]
        {
            let end = points.last().unwrap().2;
            let estimates = estimates(points, exponent);
            println!("{end} s: {estimates:.1?}");
            let from = |&(seconds, _): &(f64, f64)| seconds > 10.0_f64.min(0.1 * end);
            for (seconds, left) in estimates.into_iter().filter(from) {
                let rest = end - seconds;
                assert!(
                    (rest / 1.3..=rest * 1.3).contains(&left),
                    "{left} s left after {seconds} of {end} s"
                );
            }
        }
    }

    /// With a known grid, rays have equal costs, also in further trainings.
    #[test]
    fn a_known_grid_has_an_even_pace() {
        let mut time_left = unmeasured(0.0, 0.0);
        for _ in 0..500 {
            time_left.add_seconds(100, 0.5);
        }
        let further = TrainingRays { total: 60_000, remaining: 10_000, further: 120_000 };
        assert!((time_left.seconds(500, further) - 650.0).abs() < 1e-6);
        assert_eq!(time_left.seconds(600, rays(60_000, 60_000)), 0.0);
    }

    /// Single rays are slower than the bundles that follow.
    #[test]
    fn time_left_falls_when_pixels_get_several_rays() {
        let mut time_left = unmeasured(0.0, 30_000.0);
        for _ in 0..100 {
            time_left.add_seconds(100, 0.5 * SINGLE_RAY_COST);
        }
        let seconds = time_left.seconds(5000, rays(100_000, 10_000));
        // 200 steps of single rays, and 700 of others; parts are counted whole.
        let expected = 200.0 * 0.5 * SINGLE_RAY_COST + 700.0 * 0.5;
        assert!((seconds / expected - 1.0).abs() < 0.01, "{seconds} s for {expected} s");
    }
}

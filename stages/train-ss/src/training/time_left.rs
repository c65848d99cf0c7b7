use std::time::Instant;

use radiance::StepReport;

use crate::params::{Resolved, ResolvedField};

/// Relative cost of a ray of a grid field at each step; a late ray, at the end of the training,
/// costs 1. Until the occupancy grid has found the empty space, rays have many samples, and small
/// steps share their fixed costs among few rays. Processor time per ray of lego 100×2 and fern
/// 252×2 (design note 048).
const COURSE: [(f64, f64); 9] = [
    (0.0, 14.0),
    (48.0, 9.0),
    (96.0, 6.0),
    (144.0, 4.2),
    (240.0, 3.2),
    (480.0, 1.7),
    (1000.0, 1.3),
    (2000.0, 1.1),
    (4000.0, 1.0),
];
/// Cost of a ray while each LR pixel has one ray, relative to the cost of a late ray of several:
/// neighbouring rays read the same cells. Lego 100×2 and fern 252×2.
const SINGLE_RAY_COST: f64 = 1.25;
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

/// Estimate of the remaining time of a training, from its current pace and the usual course of a
/// ray's cost.
#[derive(Clone, Debug)]
pub(crate) struct TimeLeft {
    /// True if a ray's cost follows [`COURSE`].
    has_course: bool,
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
    pub(crate) fn new(params: &Resolved, is_initialised: bool) -> Self {
        let is_grid = matches!(params.field, ResolvedField::Grid { .. });
        Self {
            has_course: is_grid && !is_initialised,
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
        let late_rays_per_step = (cost * self.rays / self.window().min(self.steps)).max(1.0);
        let own = self.late_rays(step as f64, done, remaining, late_rays_per_step);
        let each = self.late_rays(0.0, 0.0, total, late_rays_per_step);
        let others = rays.further as f64 / total.max(1.0) * each;
        self.seconds / self.rays / cost * (own + others)
    }

    /// Returns the number of late rays that cost as much as `rays`, from a step on, after `done`
    /// rays.
    fn late_rays(&self, mut step: f64, mut done: f64, rays: f64, late_rays_per_step: f64) -> f64 {
        let mut sum = 0.0;
        for part in 1..=PARTS {
            // Later parts are larger, since costs change early.
            let part = rays * f64::from(part) / f64::from(PARTS * (PARTS + 1) / 2);
            let late_rays = part * self.cost(step, done);
            sum += late_rays;
            done += part;
            // Steps have about equal costs.
            step += late_rays / late_rays_per_step;
        }
        sum
    }

    /// Returns the number of steps in the averaging window, even if fewer were taken.
    fn window(&self) -> f64 {
        (self.steps / STEPS_PER_WINDOW_STEP).max(MIN_WINDOW_STEPS)
    }

    /// Returns the cost of a ray at a step, after `done` rays, relative to a late ray.
    fn cost(&self, step: f64, done: f64) -> f64 {
        if !self.has_course {
            return 1.0;
        }
        let factor = if done < self.single_rays { SINGLE_RAY_COST } else { 1.0 };
        factor * Self::course(step)
    }

    /// Returns the value of [`COURSE`] at a step.
    fn course(step: f64) -> f64 {
        let after = COURSE.iter().position(|(end, _)| *end > step).unwrap_or(COURSE.len());
        let Some(&(end, end_cost)) = COURSE.get(after) else { return 1.0 };
        let (start, start_cost) = COURSE[after - 1];
        start_cost + (end_cost - start_cost) * (step - start) / (end - start)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps, rays and processor seconds of lego 100×2 with 500,000 rays, every 48 steps.
    const LEGO: [(u64, u64, f64); 10] = [
        (48, 12_288, 2.73),
        (96, 24_614, 4.48),
        (144, 47_098, 6.14),
        (192, 82_598, 7.61),
        (240, 125_695, 9.28),
        (288, 173_521, 10.93),
        (336, 228_105, 12.66),
        (384, 292_825, 14.46),
        (432, 368_197, 16.85),
        (480, 459_609, 19.14),
    ];
    /// Steps, rays and processor seconds of fern 252×2, every 48 steps.
    const FERN: [(u64, u64, f64); 7] = [
        (48, 16_715, 3.94),
        (96, 35_011, 6.67),
        (144, 55_883, 9.86),
        (192, 77_446, 12.43),
        (240, 100_614, 15.06),
        (288, 125_750, 17.26),
        (336, 154_062, 19.85),
    ];

    /// Returns an estimate before the first step.
    fn unmeasured() -> TimeLeft {
        let zero = TimeLeft {
            has_course: true,
            single_rays: 0.0,
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

    /// Returns the elapsed and the estimated remaining seconds at each point of a measured course.
    fn estimates(course: &[(u64, u64, f64)], total: u64) -> Vec<(f64, f64)> {
        let mut time_left = TimeLeft { single_rays: 0.3 * total as f64, ..unmeasured() };
        let mut previous = (0, 0, 0.0);
        let mut estimates = Vec::new();
        for &(step, done, seconds) in course {
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

    /// From a tenth of the time on, the estimate is within a factor of 1.5 of the measured time.
    #[test]
    fn remaining_time_is_predicted() {
        for (course, total, expected) in [
            // The end of this training; then published times of the protocols (docs/results).
            (&LEGO[..], 500_000, 20.0),
            (&LEGO[..], 32_000_000, 408.0),
            (&FERN[..], 15_000_000, 420.0),
        ] {
            let estimates = estimates(course, total);
            println!("{total} rays in {expected} s: {estimates:.1?}");
            for (seconds, left) in estimates.into_iter().filter(|(seconds, _)| *seconds > 6.0) {
                let ratio = (seconds + left) / expected;
                assert!(
                    (1.0 / 1.5..1.5).contains(&ratio),
                    "{seconds} s + {left} s of {expected} s"
                );
            }
        }
    }

    /// With a known grid, rays have equal costs, also in further trainings.
    #[test]
    fn a_known_grid_has_an_even_pace() {
        let mut time_left = TimeLeft { has_course: false, ..unmeasured() };
        for _ in 0..500 {
            time_left.add_seconds(100, 0.5);
        }
        let further = TrainingRays { total: 60_000, remaining: 10_000, further: 120_000 };
        assert!((time_left.seconds(500, further) - 650.0).abs() < 1e-6);
        assert_eq!(time_left.seconds(600, rays(60_000, 60_000)), 0.0);
    }

    #[test]
    fn costs_fall_to_one() {
        let time_left = unmeasured();
        let costs: Vec<f64> = (0..100).map(|i| time_left.cost(f64::from(i * 50), 0.0)).collect();
        assert!(costs.is_sorted_by(|a, b| a >= b));
        assert_eq!((costs[0], costs[99]), (COURSE[0].1, 1.0));
    }

    /// Single rays are slower than the bundles that follow.
    #[test]
    fn time_left_falls_when_pixels_get_several_rays() {
        let mut time_left = TimeLeft { single_rays: 30_000.0, ..unmeasured() };
        for _ in 0..100 {
            time_left.add_seconds(100, 0.5 * SINGLE_RAY_COST);
        }
        let seconds = time_left.seconds(5000, rays(100_000, 10_000));
        // 200 steps of single rays, and 700 of others; parts are counted whole.
        let expected = 200.0 * 0.5 * SINGLE_RAY_COST + 700.0 * 0.5;
        assert!((seconds / expected - 1.0).abs() < 0.01, "{seconds} s for {expected} s");
    }
}

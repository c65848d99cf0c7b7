use crate::trainer::Step;

/// Progress of a training run, and its response to non-finite steps. Such a step is skipped and
/// halves the learning rates; another one within 100 steps ends the run (docs/design/006).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainingState {
    /// Number of steps taken.
    pub steps: u64,
    /// Number of ray bundles cast.
    pub bundles: u64,
    /// Number of rays cast.
    pub rays: u64,
    /// Factor of all learning rates, halved by each skipped step.
    pub learning_rate_scale: f64,
    /// Mean number of samples per ray of the last step; before the first, an estimate.
    pub samples_per_ray: f64,
    last_nonfinite_step: Option<u64>,
}

/// Minimum number of steps between two non-finite ones; otherwise the run ends (docs/design/006).
const MIN_STEPS_BETWEEN_FAULTS: u64 = 100;

impl TrainingState {
    /// Creates the state before the first step, whose rays have about `samples_per_ray` samples.
    pub fn new(samples_per_ray: f64) -> Self {
        Self::from_counters([0, 0, 0, 1f64.to_bits(), samples_per_ray.to_bits(), u64::MAX])
    }

    /// Returns the fraction of `rays` that were cast.
    pub fn progress(&self, rays: u64) -> f64 {
        (self.rays as f64 / rays.max(1) as f64).min(1.0)
    }

    /// Adds a step's bundles and rays to the counters, and sets the mean number of samples per ray.
    pub fn count(&mut self, step: Step, samples: usize) {
        self.bundles += step.bundles as u64;
        self.rays += step.rays() as u64;
        self.samples_per_ray = samples as f64 / step.rays() as f64;
    }

    /// Records a non-finite step and halves the learning rates. Returns whether training may
    /// continue.
    pub fn record_nonfinite_step(&mut self) -> bool {
        let is_repeated = self
            .last_nonfinite_step
            .is_some_and(|before| self.steps - before < MIN_STEPS_BETWEEN_FAULTS);
        self.last_nonfinite_step = Some(self.steps);
        self.learning_rate_scale *= 0.5;
        !is_repeated
    }

    /// Returns the state as numbers for a checkpoint.
    pub fn counters(&self) -> [u64; 6] {
        [
            self.steps,
            self.bundles,
            self.rays,
            self.learning_rate_scale.to_bits(),
            self.samples_per_ray.to_bits(),
            self.last_nonfinite_step.unwrap_or(u64::MAX),
        ]
    }

    /// Creates a state from the numbers of [`TrainingState::counters`].
    pub fn from_counters([steps, bundles, rays, scale, samples, fault]: [u64; 6]) -> Self {
        let [learning_rate_scale, samples_per_ray] = [scale, samples].map(f64::from_bits);
        let last_nonfinite_step = (fault != u64::MAX).then_some(fault);
        Self { steps, bundles, rays, learning_rate_scale, samples_per_ray, last_nonfinite_step }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Ray, Supervisor};

    /// Supervisor of bundles of nine rays.
    struct Nine;

    impl Supervisor for Nine {
        fn rays_per_bundle(&self) -> usize {
            9
        }
        fn sample_rays(&self, _: u64, _: &mut [Ray]) {}
        fn loss_and_gradient(&self, _: u64, _: &[[f32; 3]], _: &mut [[f32; 3]]) -> f64 {
            0.0
        }
    }

    #[test]
    fn a_step_has_the_target_or_the_remaining_rays() {
        let mut state = TrainingState::new(7.0);
        let start = |state: &TrainingState, target| Step::start(state, &mut Nine, 100, target);
        assert_eq!(start(&state, 40).unwrap().bundles, 4);
        let small = start(&state, 4).unwrap();
        assert_eq!(small.bundles, 1);
        state.count(Step { bundles: 10, ..small }, 180);
        assert_eq!((state.progress(100), state.samples_per_ray), (0.9, 2.0));
        let last = start(&state, 40).unwrap();
        assert_eq!((last.first_bundle, last.first_ray, last.bundles), (10, 90, 1));
        state.count(last, 9);
        assert!(start(&state, 40).is_none());
    }

    #[test]
    fn a_second_nonfinite_step_within_100_steps_ends_the_run() {
        let mut state = TrainingState { steps: 7, ..TrainingState::new(7.0) };
        assert!(state.record_nonfinite_step() && state.learning_rate_scale == 0.5);
        let restored = TrainingState::from_counters(state.counters());
        assert_eq!(restored, state);
        let may_continue = |steps: u64| TrainingState { steps, ..restored }.record_nonfinite_step();
        assert!(!may_continue(7) && !may_continue(106) && may_continue(107));
    }
}

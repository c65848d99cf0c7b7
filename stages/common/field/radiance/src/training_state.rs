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
    last_nonfinite_step: Option<u64>,
}

/// Minimum number of steps between two non-finite ones; otherwise the run ends (docs/design/006).
const MIN_STEPS_BETWEEN_FAULTS: u64 = 100;

impl Default for TrainingState {
    fn default() -> Self {
        Self { steps: 0, bundles: 0, rays: 0, learning_rate_scale: 1.0, last_nonfinite_step: None }
    }
}

impl TrainingState {
    /// Returns the fraction of `rays` that were cast.
    pub fn progress(&self, rays: u64) -> f64 {
        (self.rays as f64 / rays.max(1) as f64).min(1.0)
    }

    /// Returns the number of bundles of the next step; `None` after the last step. `rays` is the
    /// number of rays of the training run, `target_rays` that of the step.
    pub fn bundles_of_step(
        &self,
        rays: u64,
        target_rays: usize,
        rays_per_bundle: usize,
    ) -> Option<usize> {
        let remaining = rays.saturating_sub(self.rays) as usize / rays_per_bundle;
        (remaining > 0).then(|| (target_rays / rays_per_bundle).clamp(1, remaining))
    }

    /// Adds bundles to the counters.
    pub fn count(&mut self, bundles: usize, rays_per_bundle: usize) {
        self.bundles += bundles as u64;
        self.rays += (bundles * rays_per_bundle) as u64;
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
    pub fn counters(&self) -> [u64; 5] {
        [
            self.steps,
            self.bundles,
            self.rays,
            self.learning_rate_scale.to_bits(),
            self.last_nonfinite_step.unwrap_or(u64::MAX),
        ]
    }

    /// Creates a state from the numbers of [`TrainingState::counters`].
    pub fn from_counters([steps, bundles, rays, learning_rate_scale, fault]: [u64; 5]) -> Self {
        let last_nonfinite_step = (fault != u64::MAX).then_some(fault);
        Self {
            steps,
            bundles,
            rays,
            learning_rate_scale: f64::from_bits(learning_rate_scale),
            last_nonfinite_step,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_has_the_target_or_the_remaining_rays() {
        let mut state = TrainingState::default();
        assert_eq!(state.bundles_of_step(100, 40, 9), Some(4));
        assert_eq!(state.bundles_of_step(100, 4, 9), Some(1));
        state.count(10, 9);
        assert_eq!((state.bundles_of_step(100, 40, 9), state.progress(100)), (Some(1), 0.9));
        state.count(1, 9);
        assert_eq!(state.bundles_of_step(100, 40, 9), None);
    }

    #[test]
    fn a_second_nonfinite_step_within_100_steps_ends_the_run() {
        let mut state = TrainingState { steps: 7, ..TrainingState::default() };
        assert!(state.record_nonfinite_step() && state.learning_rate_scale == 0.5);
        let restored = TrainingState::from_counters(state.counters());
        assert_eq!(restored, state);
        let may_continue = |steps: u64| TrainingState { steps, ..restored }.record_nonfinite_step();
        assert!(!may_continue(7) && !may_continue(106) && may_continue(107));
    }
}

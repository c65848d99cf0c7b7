/// How far a training has come, whichever field it trains, and how it takes numbers that aren't
/// finite: the first time it goes on without that step, at half the rate; when it happens again
/// within a hundred steps, it gives up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tally {
    /// Steps taken.
    pub steps: u64,
    /// Bundles of rays cast: those that were judged together.
    pub bundles: u64,
    /// Rays cast.
    pub rays: u64,
    /// What learning rates are multiplied with.
    pub rate_scale: f64,
    last_fault: Option<u64>,
}

/// Steps that must lie between two faults.
const LEAST_STEPS_APART: u64 = 100;

impl Default for Tally {
    fn default() -> Self {
        Self { steps: 0, bundles: 0, rays: 0, rate_scale: 1.0, last_fault: None }
    }
}

impl Tally {
    /// Share of so many rays that were cast.
    pub fn done(&self, rays: u64) -> f64 {
        (self.rays as f64 / rays.max(1) as f64).min(1.0)
    }

    /// Bundles of the next step, which would like to have so many rays; `None` once all are spent.
    pub fn bundles_of_step(&self, rays: u64, wanted: usize, bundle: usize) -> Option<usize> {
        let left = rays.saturating_sub(self.rays) as usize / bundle;
        (left > 0).then(|| (wanted / bundle).clamp(1, left))
    }

    /// Counts bundles of so many rays each.
    pub fn count(&mut self, bundles: usize, bundle: usize) {
        self.bundles += bundles as u64;
        self.rays += (bundles * bundle) as u64;
    }

    /// Takes note of a step that wasn't finite; whether the training may go on.
    pub fn forgives(&mut self) -> bool {
        let again = self.last_fault.is_some_and(|before| self.steps - before < LEAST_STEPS_APART);
        self.last_fault = Some(self.steps);
        self.rate_scale *= 0.5;
        !again
    }

    /// For a checkpoint.
    pub fn counters(&self) -> [u64; 5] {
        [
            self.steps,
            self.bundles,
            self.rays,
            self.rate_scale.to_bits(),
            self.last_fault.unwrap_or(u64::MAX),
        ]
    }

    /// From a checkpoint.
    pub fn from_counters([steps, bundles, rays, rate_scale, fault]: [u64; 5]) -> Self {
        let last_fault = (fault != u64::MAX).then_some(fault);
        Self { steps, bundles, rays, rate_scale: f64::from_bits(rate_scale), last_fault }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_has_what_is_wanted_or_what_is_left() {
        let mut tally = Tally::default();
        assert_eq!(tally.bundles_of_step(100, 40, 9), Some(4));
        assert_eq!(tally.bundles_of_step(100, 4, 9), Some(1));
        tally.count(10, 9);
        assert_eq!((tally.bundles_of_step(100, 40, 9), tally.done(100)), (Some(1), 0.9));
        tally.count(1, 9);
        assert_eq!(tally.bundles_of_step(100, 40, 9), None);
    }

    #[test]
    fn one_fault_is_forgiven_and_a_second_only_later() {
        let mut tally = Tally { steps: 7, ..Tally::default() };
        assert!(tally.forgives() && tally.rate_scale == 0.5);
        let kept = Tally::from_counters(tally.counters());
        assert_eq!(kept, tally);
        let later = |steps: u64| Tally { steps, ..kept }.forgives();
        assert!(!later(7) && !later(106) && later(107));
    }
}

use std::time::Duration;

/// Maximum share of the processor time that looks may use (docs/design/044).
const MAX_TIME_SHARE: f64 = 0.02;
/// Estimated seconds to start the programs of the first look (docs/design/044).
const START_SECONDS: f64 = 0.3;
/// Estimated seconds to render and score one pixel of the first look (docs/design/044).
const PIXEL_SECONDS: f64 = 8e-6;

/// Budget of the looks at one training run, in processor time.
pub(super) struct LookBudget {
    /// Number of threads of the training, and so its processor seconds per second.
    threads: f64,
    /// Processor seconds that looks have used.
    spent: f64,
    /// Expected processor seconds of the next look.
    expected: f64,
}

impl LookBudget {
    /// Creates the budget of a run with the given number of threads and a view of the given
    /// number of pixels.
    pub(super) fn new(threads: usize, pixels: u64) -> Self {
        Self {
            threads: threads as f64,
            spent: 0.0,
            expected: START_SECONDS + PIXEL_SECONDS * pixels as f64,
        }
    }

    /// Returns the time from the training's start to the next look: by then all looks, including
    /// this one, fit into their share.
    pub(super) fn next_due(&self) -> Duration {
        Duration::from_secs_f64((self.spent + self.expected) / (MAX_TIME_SHARE * self.threads))
    }

    /// Returns the expected processor time of the next look.
    pub(super) fn expected(&self) -> Duration {
        Duration::from_secs_f64(self.expected)
    }

    /// Records a look's processor time, which is also the estimate for the next look.
    pub(super) fn record_look(&mut self, processor: Duration) {
        self.expected = processor.as_secs_f64();
        self.spent += self.expected;
    }

    /// Records the processor time of a look that found no checkpoint.
    pub(super) fn record_miss(&mut self, processor: Duration) {
        self.spent += processor.as_secs_f64();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn looks_use_their_share_and_no_more() {
        for (threads, pixels, cost) in [(1, 1 << 12, 0.2), (2, 640_000, 3.0), (16, 640_000, 9.0)] {
            let mut budget = LookBudget::new(threads, pixels);
            budget.record_miss(Duration::from_secs_f64(0.1));
            let (mut spent, mut looks) = (0.1, 0);
            while budget.next_due().as_secs_f64() < 3600.0 {
                budget.record_look(Duration::from_secs_f64(cost));
                (spent, looks) = (spent + cost, looks + 1);
            }
            let limit = MAX_TIME_SHARE * 3600.0 * threads as f64;
            assert!(spent <= limit && spent > limit - 2.0 * cost, "{looks} looks took {spent} s");
        }
    }

    #[test]
    fn a_look_without_a_checkpoint_keeps_the_estimate() {
        let mut budget = LookBudget::new(2, 640_000);
        let expected = budget.expected();
        budget.record_miss(Duration::from_millis(50));
        assert_eq!(budget.expected(), expected);
    }
}

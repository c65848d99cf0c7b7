use std::time::Duration;

/// Share of the processor time that looks may take.
const MOST_TIME_SHARE: f64 = 0.02;
/// Estimate before the first look, in seconds: starting the programs.
const START_SECONDS: f64 = 0.3;
/// Likewise: rendering and scoring one pixel.
const PIXEL_SECONDS: f64 = 8e-6;

/// Processor time for looks.
pub(super) struct LookBudget {
    /// The training's threads: processor seconds that go by in a second.
    threads: f64,
    /// Processor seconds that looks have taken.
    spent: f64,
    /// Expected processor seconds of the next look.
    expected: f64,
}

impl LookBudget {
    /// Of a training with so many threads and a view with so many pixels.
    pub(super) fn new(threads: usize, pixels: u64) -> Self {
        Self {
            threads: threads as f64,
            spent: 0.0,
            expected: START_SECONDS + PIXEL_SECONDS * pixels as f64,
        }
    }

    /// When the next look is due, from the training's start. By then all looks, this one included,
    /// fit into the share.
    pub(super) fn next(&self) -> Duration {
        Duration::from_secs_f64((self.spent + self.expected) / (MOST_TIME_SHARE * self.threads))
    }

    /// Expected processor time of the next look.
    pub(super) fn expected(&self) -> Duration {
        Duration::from_secs_f64(self.expected)
    }

    /// Records a look's processor time. The next look is expected to take as long.
    pub(super) fn took(&mut self, processor: Duration) {
        self.expected = processor.as_secs_f64();
        self.spent += self.expected;
    }

    /// Records the processor time of a look that found no checkpoint.
    pub(super) fn wasted(&mut self, processor: Duration) {
        self.spent += processor.as_secs_f64();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn looks_take_their_share_and_no_more() {
        for (threads, pixels, cost) in [(1, 1 << 12, 0.2), (2, 640_000, 3.0), (16, 640_000, 9.0)] {
            let mut budget = LookBudget::new(threads, pixels);
            budget.wasted(Duration::from_secs_f64(0.1));
            let (mut spent, mut looks) = (0.1, 0);
            while budget.next().as_secs_f64() < 3600.0 {
                budget.took(Duration::from_secs_f64(cost));
                (spent, looks) = (spent + cost, looks + 1);
            }
            let most = MOST_TIME_SHARE * 3600.0 * threads as f64;
            assert!(spent <= most && spent > most - 2.0 * cost, "{looks} looks took {spent} s");
        }
    }

    #[test]
    fn a_look_without_a_checkpoint_says_nothing_of_the_next() {
        let mut budget = LookBudget::new(2, 640_000);
        let expected = budget.expected();
        budget.wasted(Duration::from_millis(50));
        assert_eq!(budget.expected(), expected);
    }
}

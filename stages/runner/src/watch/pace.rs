use std::time::Duration;

/// The part of the processor time that looks may take.
const SHARE: f64 = 0.02;
/// Before the first look: what starting the programs takes, and each pixel, in seconds.
const START: f64 = 0.3;
const PIXEL: f64 = 8e-6;

/// When there is time for a look.
pub(super) struct Pace {
    /// Threads of the training: the processor time that goes by in a second.
    threads: f64,
    /// Seconds of processor time that looks have taken.
    spent: f64,
    /// What the next one is expected to take.
    expected: f64,
}

impl Pace {
    /// Of a training with so many threads and a view with so many pixels.
    pub(super) fn new(threads: usize, pixels: u64) -> Self {
        Self { threads: threads as f64, spent: 0.0, expected: START + PIXEL * pixels as f64 }
    }

    /// When the next look is due, counted from the training's beginning: with it, looks will have
    /// taken their share.
    pub(super) fn next(&self) -> Duration {
        Duration::from_secs_f64((self.spent + self.expected) / (SHARE * self.threads))
    }

    /// What the next look is expected to take.
    pub(super) fn expected(&self) -> Duration {
        Duration::from_secs_f64(self.expected)
    }

    /// A look has taken so long.
    pub(super) fn took(&mut self, processor: Duration) {
        self.expected = processor.as_secs_f64();
        self.spent += self.expected;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn looks_take_their_share_and_no_more() {
        for (threads, pixels, cost) in [(1, 1 << 12, 0.2), (2, 640_000, 3.0), (16, 640_000, 9.0)] {
            let mut pace = Pace::new(threads, pixels);
            let (mut spent, mut looks) = (0.0, 0);
            while pace.next().as_secs_f64() < 3600.0 {
                pace.took(Duration::from_secs_f64(cost));
                (spent, looks) = (spent + cost, looks + 1);
            }
            let most = SHARE * 3600.0 * threads as f64;
            assert!(spent <= most && spent > most - 2.0 * cost, "{looks} looks took {spent} s");
        }
    }
}

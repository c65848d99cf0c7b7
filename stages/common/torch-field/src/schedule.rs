/// How the learning rate falls.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Schedule {
    /// Exponentially with every step, as the paper's text has it.
    Exponential,
    /// As the reference's code does it: by epochs, flat until the last ten, of which each takes an
    /// eleventh of the way on a logarithmic scale, so that the end is never quite reached. A
    /// training of fewer than twenty goes through the same twenty in less time.
    Epochs {
        /// Epochs in all.
        epochs: u64,
    },
}

impl Schedule {
    /// Epochs during which the code's schedule falls.
    const FALLING_EPOCHS: u64 = 10;

    /// The rate when a share of the training is done.
    pub fn rate(self, highest: f64, decay: f64, done: f64) -> f64 {
        let progress = match self {
            Self::Exponential => done,
            Self::Epochs { epochs } => {
                let epochs = epochs.max(2 * Self::FALLING_EPOCHS);
                let epoch = ((done * epochs as f64) as u64).min(epochs - 1);
                (epoch + 1 + Self::FALLING_EPOCHS).saturating_sub(epochs) as f64
                    / (Self::FALLING_EPOCHS + 1) as f64
            }
        };
        highest * decay.powf(progress)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The rates that the reference's log shows for 20 epochs.
    #[test]
    fn epochs_are_the_references() {
        let schedule = Schedule::Epochs { epochs: 20 };
        let rate = |epoch: u64| schedule.rate(5e-4, 1e-2, (epoch as f64 + 0.5) / 20.0);
        assert!((0..10).all(|e| rate(e) == 5e-4));
        let falling = [
            3.29e-4, 2.16e-4, 1.42e-4, 9.37e-5, 6.16e-5, 4.06e-5, 2.67e-5, 1.76e-5, 1.16e-5,
            7.60e-6,
        ];
        for (e, expected) in (10..).zip(falling) {
            assert!((rate(e) / expected - 1.0).abs() < 5e-3, "{e}: {}", rate(e));
        }
        assert_eq!(schedule.rate(5e-4, 1e-2, 1.0), rate(19));
        let short = Schedule::Epochs { epochs: 3 };
        assert!(
            (0u32..20)
                .all(|e| short.rate(5e-4, 1e-2, (f64::from(e) + 0.5) / 20.0) == rate(u64::from(e)))
        );
        let text = Schedule::Exponential;
        assert!(
            (text.rate(5e-4, 1e-2, 0.5) - 5e-5).abs() < 1e-9
                && (text.rate(5e-4, 1e-2, 1.0) - 5e-6).abs() < 1e-12
        );
    }
}

/// Above this (254.5 in 8 bits) an LR sample may have been clipped, and below its counterpart.
const SATURATED: f32 = 254.5 / 255.0;

/// Whether the true value of an LR sample may lie beyond it.
pub(crate) fn is_clipped(sample: f32) -> bool {
    sample >= SATURATED || sample <= 1.0 - SATURATED
}

/// Prediction less target; nothing where the target isn't known.
fn residual(prediction: f32, target: f32) -> f32 {
    if target.is_nan() { 0.0 } else { prediction - target }
}

/// What a bundle's colours are compared with, besides a photograph's samples, and how much that
/// counts. Losses are means over the three channels.
pub(crate) struct Target {
    /// Takes the photograph's exposure back.
    pub(crate) back: [f32; 3],
    /// What lies behind the bundle's rays.
    pub(crate) behind: [f32; 3],
    /// Weight of the bundle's loss.
    pub(crate) weight: f32,
    /// Whether samples were clipped to black and white after a kernel or an exposure made them.
    pub(crate) is_clipped: bool,
}

impl Target {
    /// The colour that a photograph's sample asks for: premultiplied RGBA over what lies behind.
    fn colour(&self, sample: [f32; 4]) -> [f32; 3] {
        [0, 1, 2].map(|c| self.back[c] * (sample[c] + (1.0 - sample[3]) * self.behind[c]))
    }

    /// Prediction less sample, and nothing where the sample was clipped and the prediction lies
    /// beyond it.
    pub(crate) fn unclipped_residual(&self, channel: usize, prediction: f32, sample: f32) -> f32 {
        let residual = residual(prediction, self.back[channel] * sample);
        let is_beyond = (sample >= SATURATED && residual > 0.0)
            || (sample <= 1.0 - SATURATED && residual < 0.0);
        if is_beyond { 0.0 } else { residual }
    }

    /// The loss of a pixel's residual, and its gradient of what residuals ask of each colour.
    pub(crate) fn of_back_projected(&self, residual: [f32; 3], gradients: &mut [[f32; 3]]) -> f64 {
        gradients.as_flattened_mut().iter_mut().for_each(|g| *g *= self.weight * (2.0 / 3.0));
        residual.iter().map(|&r| f64::from(self.weight) * f64::from(r) * f64::from(r) / 3.0).sum()
    }

    /// The loss of colours that each have a sample of their own, and its gradient.
    pub(crate) fn of_each(
        &self,
        colours: &[[f32; 3]],
        samples: impl Iterator<Item = [f32; 4]>,
        gradients: &mut [[f32; 3]],
    ) -> f64 {
        let share = 1.0 / colours.len() as f32;
        let mut loss = 0.0;
        for ((colour, sample), gradient) in colours.iter().zip(samples).zip(gradients) {
            let target = self.colour(sample);
            for c in 0..3 {
                let residual = residual(colour[c], target[c]);
                loss += f64::from(self.weight * share) * f64::from(residual) * f64::from(residual)
                    / 3.0;
                gradient[c] = self.weight * residual * share * (2.0 / 3.0);
            }
        }
        loss
    }

    /// The loss of the mean of colours (the paper's eq. 4), and its gradient.
    pub(crate) fn of_mean(
        &self,
        colours: &[[f32; 3]],
        sample: [f32; 4],
        gradients: &mut [[f32; 3]],
    ) -> f64 {
        let share = 1.0 / colours.len() as f32;
        let target = self.colour(sample);
        let mut loss = 0.0;
        for c in 0..3 {
            let mean = colours.iter().map(|colour| colour[c]).sum::<f32>() * share;
            let residual = if self.is_clipped {
                self.unclipped_residual(c, mean, sample[c])
            } else {
                residual(mean, target[c])
            };
            loss += f64::from(self.weight) * f64::from(residual) * f64::from(residual) / 3.0;
            for gradient in gradients.iter_mut() {
                gradient[c] = self.weight * residual * share * (2.0 / 3.0);
            }
        }
        loss
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAIN: Target =
        Target { back: [1.0; 3], behind: [0.0; 3], weight: 1.0, is_clipped: false };

    /// A clipped sample says no more than that the true value lies beyond.
    #[test]
    fn what_was_clipped_is_no_residual() {
        let cases = [
            (1.1, 1.0, 0.0),
            (0.9, 1.0, -0.1),
            (-0.1, 0.0, 0.0),
            (0.1, 0.0, 0.1),
            (1.1, 0.99, 0.11),
            (-0.1, 0.01, -0.11),
        ];
        for (prediction, sample, expected) in cases {
            assert!(
                (PLAIN.unclipped_residual(1, prediction, sample) - expected).abs() < 1e-6,
                "{prediction} {sample}"
            );
        }
        assert!(is_clipped(1.0) && is_clipped(0.0) && !is_clipped(0.99));
        // A photograph half as bright as the scene says of its white that the scene is no darker.
        let bright = Target { back: [0.5; 3], is_clipped: true, ..PLAIN };
        let mut gradients = [[9.0; 3]; 2];
        assert_eq!(bright.of_mean(&[[0.9; 3]; 2], [1.0; 4], &mut gradients), 0.0);
        assert_eq!(gradients, [[0.0; 3]; 2]);
        let plain = Target { is_clipped: false, ..bright };
        assert!(plain.of_mean(&[[0.9; 3]; 2], [1.0; 4], &mut gradients) > 0.1);
    }

    /// What isn't known asks for nothing.
    #[test]
    fn the_unknown_is_no_residual() {
        let unknown = [f32::NAN; 4];
        assert_eq!(PLAIN.unclipped_residual(0, 0.2, f32::NAN), 0.0);
        let mut gradients = [[9.0; 3]; 2];
        assert_eq!(PLAIN.of_mean(&[[0.2; 3]; 2], unknown, &mut gradients), 0.0);
        assert_eq!(gradients, [[0.0; 3]; 2]);
        gradients = [[9.0; 3]; 2];
        assert_eq!(PLAIN.of_each(&[[0.2; 3]; 2], [unknown; 2].into_iter(), &mut gradients), 0.0);
        assert_eq!(gradients, [[0.0; 3]; 2]);
    }

    /// Exposure is taken back, and what is transparent shows what lies behind.
    #[test]
    fn samples_ask_for_colours() {
        let target = Target { back: [2.0, 1.0, 0.5], behind: [0.4, 0.8, 1.0], ..PLAIN };
        let colour = target.colour([0.1, 0.2, 0.3, 0.75]);
        assert!(
            colour.iter().zip([0.4, 0.4, 0.275]).all(|(a, b): (&f32, f32)| (a - b).abs() < 1e-6),
            "{colour:?}"
        );
    }
}

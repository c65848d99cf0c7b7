/// Minimum level of an LR sample that may have been clipped to white (254.5 in 8 bits); its
/// complement is the maximum level of one that may have been clipped to black.
const SATURATION: f32 = 254.5 / 255.0;

/// Returns whether an LR sample is at the limit, so that the value before clipping may lie beyond.
pub(crate) fn may_be_clipped(sample: f32) -> bool {
    sample >= SATURATION || sample <= 1.0 - SATURATION
}

/// Returns prediction − target, or 0 if the target is NaN.
fn residual(prediction: f32, target: f32) -> f32 {
    if target.is_nan() { 0.0 } else { prediction - target }
}

/// Context of a bundle's loss, besides the photograph's samples. A bundle is the sub-pixel rays of
/// one LR pixel. Losses are means over the three channels.
pub(crate) struct LossContext {
    /// Factors from the photograph's colours to the field's: reciprocals of the photograph's gains.
    pub(crate) inverse_gains: [f32; 3],
    /// Background colour of the bundle's rays.
    pub(crate) background: [f32; 3],
    /// Weight of the bundle's loss.
    pub(crate) weight: f32,
    /// True if `loss_of_mean` treats a sample at 0 or 1, which may have been clipped, as an upper
    /// or lower bound. Photographs must then be composited on the background.
    pub(crate) allows_clipping: bool,
}

impl LossContext {
    /// Returns the target colour of a photograph's sample: premultiplied RGBA over the background.
    fn target_colour(&self, sample: [f32; 4]) -> [f32; 3] {
        [0, 1, 2]
            .map(|c| self.inverse_gains[c] * (sample[c] + (1.0 - sample[3]) * self.background[c]))
    }

    /// Returns the residual of a prediction; 0 if the sample may have been clipped and the
    /// prediction lies beyond it.
    pub(crate) fn unclipped_residual(&self, channel: usize, prediction: f32, sample: f32) -> f32 {
        let residual = residual(prediction, self.inverse_gains[channel] * sample);
        let is_beyond = (sample >= SATURATION && residual > 0.0)
            || (sample <= 1.0 - SATURATION && residual < 0.0);
        if is_beyond { 0.0 } else { residual }
    }

    /// Returns the loss of an LR pixel's residual. `gradients` contains back-projected residuals,
    /// which are multiplied in place to become the loss's gradient.
    pub(crate) fn back_projected_loss(
        &self,
        residual: [f32; 3],
        gradients: &mut [[f32; 3]],
    ) -> f64 {
        for gradient in gradients.as_flattened_mut() {
            *gradient *= self.weight * (2.0 / 3.0);
        }
        residual.iter().map(|&r| f64::from(self.weight) * f64::from(r) * f64::from(r) / 3.0).sum()
    }

    /// Returns the mean of the colours' losses, each against its own sample, and writes the mean's
    /// gradient.
    pub(crate) fn mean_of_losses(
        &self,
        colours: &[[f32; 3]],
        sample_of: impl Fn(usize) -> [f32; 4],
        gradients: &mut [[f32; 3]],
    ) -> f64 {
        let share = 1.0 / colours.len() as f32;
        let mut loss = 0.0;
        for (k, colour) in colours.iter().enumerate() {
            let target = self.target_colour(sample_of(k));
            for c in 0..3 {
                let residual = residual(colour[c], target[c]);
                loss += f64::from(self.weight * share) * f64::from(residual) * f64::from(residual)
                    / 3.0;
                gradients[k][c] = self.weight * residual * share * (2.0 / 3.0);
            }
        }
        loss
    }

    /// Returns the loss of the colours' mean (the paper's eq. 4), and writes its gradient.
    pub(crate) fn loss_of_mean(
        &self,
        colours: &[[f32; 3]],
        sample: [f32; 4],
        gradients: &mut [[f32; 3]],
    ) -> f64 {
        let share = 1.0 / colours.len() as f32;
        let target = self.target_colour(sample);
        let mut loss = 0.0;
        for c in 0..3 {
            let mean = colours.iter().map(|colour| colour[c]).sum::<f32>() * share;
            let residual = if self.allows_clipping {
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

    const PLAIN: LossContext = LossContext {
        inverse_gains: [1.0; 3],
        background: [0.0; 3],
        weight: 1.0,
        allows_clipping: false,
    };

    /// A clipped sample bounds the true value from one side only.
    #[test]
    fn predictions_beyond_a_clipped_sample_have_no_residual() {
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
        assert!(may_be_clipped(1.0) && may_be_clipped(0.0) && !may_be_clipped(0.99));
        // White in a photograph twice as bright as the scene is a lower bound of the true colour.
        let bright = LossContext { inverse_gains: [0.5; 3], allows_clipping: true, ..PLAIN };
        let mut gradients = [[9.0; 3]; 2];
        assert_eq!(bright.loss_of_mean(&[[0.9; 3]; 2], [1.0; 4], &mut gradients), 0.0);
        assert_eq!(gradients, [[0.0; 3]; 2]);
        let plain = LossContext { allows_clipping: false, ..bright };
        assert!(plain.loss_of_mean(&[[0.9; 3]; 2], [1.0; 4], &mut gradients) > 0.1);
    }

    #[test]
    fn unknown_samples_have_no_residual() {
        let unknown = [f32::NAN; 4];
        assert_eq!(PLAIN.unclipped_residual(0, 0.2, f32::NAN), 0.0);
        let mut gradients = [[9.0; 3]; 2];
        assert_eq!(PLAIN.loss_of_mean(&[[0.2; 3]; 2], unknown, &mut gradients), 0.0);
        assert_eq!(gradients, [[0.0; 3]; 2]);
        gradients = [[9.0; 3]; 2];
        assert_eq!(PLAIN.mean_of_losses(&[[0.2; 3]; 2], |_| unknown, &mut gradients), 0.0);
        assert_eq!(gradients, [[0.0; 3]; 2]);
    }

    /// Exposure is corrected, and transparent samples are composited over the background.
    #[test]
    fn samples_become_target_colours() {
        let context =
            LossContext { inverse_gains: [2.0, 1.0, 0.5], background: [0.4, 0.8, 1.0], ..PLAIN };
        let colour = context.target_colour([0.1, 0.2, 0.3, 0.75]);
        assert!(
            colour.iter().zip([0.4, 0.4, 0.275]).all(|(a, b): (&f32, f32)| (a - b).abs() < 1e-6),
            "{colour:?}"
        );
    }
}

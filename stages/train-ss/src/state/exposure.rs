/// Factor by which a view's sums decay with every drawn pixel; chosen by hand.
const DECAY: f64 = 0.998;
/// Weight of the prior that gains are 1, in white pixels; chosen by hand.
const PRIOR: f64 = 1.0;
/// Training progress before which all gains are 1, because the field is still too rough. Much later
/// the field has already explained exposures by floaters: from 0.1, gains are half of the true
/// ones; from 0.3, they stay 1 (design note 026).
const FIRST_PROGRESS: f64 = 0.02;

/// Per-channel gain of each photograph relative to the field's render, by least squares over the
/// drawn pixels with exponential decay. The geometric mean of the gains is 1, since a gain that all
/// photographs share belongs to the field.
///
/// Gains apply to display-encoded colours: exposure scales linear light, and the sRGB encoding is
/// almost a power function.
#[derive(Clone, Debug)]
pub(crate) struct Exposures {
    /// Sums of photographed · rendered and of rendered², for every view and channel.
    sums: Vec<[[f64; 2]; 3]>,
    gains: Vec<[f32; 3]>,
}

impl Exposures {
    pub(crate) fn new(views: usize) -> Self {
        Self { sums: vec![[[0.0; 2]; 3]; views], gains: vec![[1.0; 3]; views] }
    }

    /// Returns the gain of every view.
    pub(crate) fn gains(&self) -> &[[f32; 3]] {
        &self.gains
    }

    /// Adds a pixel of a view to the sums. NaN marks channels without information.
    pub(crate) fn add_pixel(&mut self, view: usize, photographed: [f32; 3], rendered: [f32; 3]) {
        for (c, sums) in self.sums[view].iter_mut().enumerate() {
            let [y, x] = [photographed[c], rendered[c]].map(f64::from);
            if y.is_finite() && x.is_finite() {
                *sums = [DECAY.mul_add(sums[0], y * x), DECAY.mul_add(sums[1], x * x)];
            }
        }
    }

    /// Recomputes the gains at a training progress in 0..1.
    pub(crate) fn update_gains(&mut self, progress: f64) {
        if progress < FIRST_PROGRESS {
            return;
        }
        for c in 0..3 {
            let logarithms: Vec<f64> = (self.sums.iter())
                .map(|sums| ((sums[c][0] + PRIOR) / (sums[c][1] + PRIOR)).ln())
                .collect();
            let mean = logarithms.iter().sum::<f64>() / logarithms.len().max(1) as f64;
            for (view, logarithm) in logarithms.iter().enumerate() {
                self.gains[view][c] = (logarithm - mean).exp() as f32;
            }
        }
    }

    /// Serialises the sums, from which the gains follow.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        self.sums.iter().flatten().flatten().flat_map(|v| v.to_le_bytes()).collect()
    }

    /// Restores the result of [`Exposures::to_bytes`].
    pub(crate) fn restore(&mut self, bytes: &[u8]) {
        let numbers = bytes.as_chunks::<8>().0;
        for (sum, number) in self.sums.iter_mut().flatten().flatten().zip(numbers) {
            *sum = f64::from_le_bytes(*number);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gains are estimated up to a common factor, and restored from a checkpoint.
    #[test]
    fn gains_are_estimated() {
        let true_gains = [[0.5f32, 0.8, 1.0], [1.0, 1.0, 1.0], [2.0, 1.25, 1.0]];
        let mut exposures = Exposures::new(3);
        for i in 0..3000 {
            let rendered = [0.1 + 0.3 * (i % 7) as f32 / 7.0, 0.4, 0.2 + 0.2 * (i % 3) as f32];
            // The field itself may be a quarter too dark.
            let photographed = std::array::from_fn(|c| true_gains[i % 3][c] * rendered[c] / 0.75);
            exposures.add_pixel(i % 3, photographed, rendered);
            exposures.add_pixel(i % 3, [f32::NAN; 3], rendered);
        }
        exposures.update_gains(0.01);
        assert_eq!(exposures.gains(), [[1.0; 3]; 3]);
        exposures.update_gains(0.5);
        for (found, expected) in exposures.gains().iter().zip(true_gains) {
            assert!(
                found.iter().zip(expected).all(|(f, e)| (f / e - 1.0).abs() < 0.06),
                "{found:?} {expected:?}"
            );
        }
        let mut other = Exposures::new(3);
        assert_eq!(exposures.to_bytes().len(), other.to_bytes().len());
        other.restore(&exposures.to_bytes());
        other.update_gains(0.5);
        assert_eq!(other.gains(), exposures.gains());
    }
}

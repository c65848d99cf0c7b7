/// How bright each photograph is against what the field renders for it: a factor a channel, by
/// least squares over the pixels drawn, what is old fading. A factor that all photographs share
/// belongs to the field: the factors' geometric mean is 1.
///
/// Factors of display-encoded colours: a change of exposure multiplies linear light, and sRGB's
/// encoding is nearly a power.
#[derive(Clone, Debug)]
pub(crate) struct Exposures {
    /// For every view and channel, sums of photographed times rendered and of rendered times
    /// rendered.
    sums: Vec<[[f64; 2]; 3]>,
    factors: Vec<[f32; 3]>,
}

/// What a view's sums keep at each of its pixels.
const KEPT_SHARE: f64 = 0.998;
/// Photographs are as bright as rendered, says so many white pixels.
const PRIOR: f64 = 1.0;
/// Share of the training before which the field knows too little to say anything of exposures. Much
/// later it has made up floaters before the cameras that explain them: with 0.1, 0.3 factors are
/// found half, not at all.
const BEGIN_SHARE: f64 = 0.02;
/// Bytes of a view's sums.
const BYTES_PER_VIEW: usize = 6 * 8;

impl Exposures {
    pub(crate) fn new(views: usize) -> Self {
        Self { sums: vec![[[0.0; 2]; 3]; views], factors: vec![[1.0; 3]; views] }
    }

    /// What a view's photograph is so many times as bright as.
    pub(crate) fn of(&self, view: usize) -> [f32; 3] {
        self.factors[view]
    }

    /// Every view's.
    pub(crate) fn factors(&self) -> &[[f32; 3]] {
        &self.factors
    }

    /// Takes what was rendered for a photograph's pixel; a channel where that says nothing is NaN.
    pub(crate) fn learn(&mut self, view: usize, photographed: [f32; 3], rendered: [f32; 3]) {
        for ((sums, y), c) in self.sums[view].iter_mut().zip(photographed).zip(rendered) {
            if y.is_finite() && c.is_finite() {
                let (y, c) = (f64::from(y), f64::from(c));
                *sums = [KEPT_SHARE.mul_add(sums[0], y * c), KEPT_SHARE.mul_add(sums[1], c * c)];
            }
        }
    }

    /// Finds the factors anew, with such a share of the training done.
    pub(crate) fn settle(&mut self, done: f64) {
        if done < BEGIN_SHARE {
            return;
        }
        for c in 0..3 {
            let logarithm =
                |sums: &[[f64; 2]; 3]| ((sums[c][0] + PRIOR) / (sums[c][1] + PRIOR)).ln();
            let mean = self.sums.iter().map(logarithm).sum::<f64>() / self.sums.len().max(1) as f64;
            for (factor, sums) in self.factors.iter_mut().zip(&self.sums) {
                factor[c] = (logarithm(sums) - mean).exp() as f32;
            }
        }
    }

    /// All that a resumed training needs; the factors follow from it.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        self.sums.iter().flatten().flatten().flat_map(|v| v.to_le_bytes()).collect()
    }

    /// Length of that.
    pub(crate) fn len(&self) -> usize {
        self.sums.len() * BYTES_PER_VIEW
    }

    /// Restores what [`Exposures::bytes`] gave.
    pub(crate) fn restore(&mut self, bytes: &[u8]) {
        let numbers = bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b));
        self.sums.iter_mut().flatten().flatten().zip(numbers).for_each(|(sum, v)| *sum = v);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Factors are found but for what all have in common, and come back from a checkpoint.
    #[test]
    fn factors_are_found() {
        let true_factors = [[0.5f32, 0.8, 1.0], [1.0, 1.0, 1.0], [2.0, 1.25, 1.0]];
        let mut exposures = Exposures::new(3);
        for i in 0..3000 {
            let rendered = [0.1 + 0.3 * (i % 7) as f32 / 7.0, 0.4, 0.2 + 0.2 * (i % 3) as f32];
            // The field itself may be a quarter too dark.
            let photographed = std::array::from_fn(|c| true_factors[i % 3][c] * rendered[c] / 0.75);
            exposures.learn(i % 3, photographed, rendered);
            exposures.learn(i % 3, [f32::NAN; 3], rendered);
        }
        exposures.settle(0.01);
        assert_eq!(exposures.factors(), [[1.0; 3]; 3]);
        exposures.settle(0.5);
        for (found, expected) in exposures.factors().iter().zip(true_factors) {
            assert!(
                found.iter().zip(expected).all(|(f, e)| (f / e - 1.0).abs() < 0.06),
                "{found:?} {expected:?}"
            );
        }
        let mut other = Exposures::new(3);
        assert_eq!(exposures.bytes().len(), other.len());
        other.restore(&exposures.bytes());
        other.settle(0.5);
        assert_eq!(other.factors(), exposures.factors());
    }
}

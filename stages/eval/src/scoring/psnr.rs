use metrics::{Figure, Score, Scores};
use pixels::{Image, psnr_of};

use crate::metric::{Measured, Metric, value};
use crate::scored_view::{ScoredScene, ScoredView};

/// Peak signal-to-noise ratio in dB, peak 1, of the mean squared error over all samples.
/// Predictions lie in [0, 1]; equal images, which have no PSNR, count as 100 dB.
pub fn psnr(found: &Image, expected: &Image) -> f64 {
    let pairs = found.data.iter().zip(&expected.data);
    let sum: f64 = pairs.map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum();
    psnr_of(sum / found.data.len() as f64)
}

/// [`psnr`] of the pixels that count, where these are so much of all pixels and the others are
/// equal.
pub(super) fn masked_psnr(found: &Image, expected: &Image, counted_share: f64) -> f64 {
    psnr(found, expected) + 10.0 * counted_share.log10()
}

/// [`psnr`], of the pixels that count.
pub(crate) struct PsnrMetric;

impl Metric for PsnrMetric {
    fn name(&self) -> &'static str {
        "psnr"
    }

    fn figures(&self) -> Vec<Figure> {
        vec![Figure::new("psnr", "PSNR ↑ dB", 2, true)]
    }

    fn convention(&self, scene: &ScoredScene<'_>) -> String {
        let is_masked = scene.truth.views.iter().any(|view| view.mask.is_some());
        let masked = if is_masked { "; of the pixels that masks leave" } else { "" };
        format!(
            "-10 log10 of the mean squared error over pixels and channels in [0, 1]; prediction in \
            half precision, clamped; mean of per-view values{masked}"
        )
    }

    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measured> {
        let Some(expected) = &view.expected else { return Ok(Measured::default()) };
        let decibels = masked_psnr(&view.found, expected, view.counted_share);
        Ok(Measured::one("psnr", Score::One(decibels)))
    }

    fn in_words(&self, mean: &Scores) -> Option<String> {
        Some(format!("PSNR {:.2} dB", value(mean, "psnr")?))
    }
}

use metrics::{Figure, Score, Scores};

use crate::metric::{Measured, Metric, value};
use crate::scored_view::{ScoredScene, ScoredView};

use super::psnr::masked_psnr;
use super::ssim::ssim;

/// PSNR and SSIM of a render shrunk to LR, by the kernel that made the LR images or is taken to
/// have made them, against the view's LR image.
pub(crate) struct LowResolutionMetric;

impl Metric for LowResolutionMetric {
    fn name(&self) -> &'static str {
        "low_resolution"
    }

    fn figures(&self) -> Vec<Figure> {
        vec![
            Figure::new("low_resolution/psnr", "PSNR at LR ↑ dB", 2, true),
            Figure::new("low_resolution/ssim", "SSIM at LR ↑", 4, true),
        ]
    }

    fn convention(&self, scene: &ScoredScene<'_>) -> String {
        let kernel = scene.made.map_or_else(
            || "a box, for want of a better guess".to_owned(),
            |made| format!("{:?}", made.kernel).to_lowercase(),
        );
        format!("the render shrunk by {kernel}, against the view's LR picture")
    }

    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measured> {
        let Some(lr) = &view.lr else { return Ok(Measured::default()) };
        let score = Score::several([
            ("psnr", masked_psnr(&lr.shrunk, &lr.expected, lr.counted_share)),
            ("ssim", ssim(&lr.shrunk, &lr.expected).reflected),
        ]);
        Ok(Measured::one(self.name(), score))
    }

    fn in_words(&self, mean: &Scores) -> Option<String> {
        // Where there is HR truth, its figures say more.
        if value(mean, "psnr").is_some() {
            return None;
        }
        let [psnr, ssim] =
            ["psnr", "ssim"].map(|part| value(mean, &format!("low_resolution/{part}")));
        Some(format!("at LR: PSNR {:.2} dB · SSIM {:.4}", psnr?, ssim?))
    }
}

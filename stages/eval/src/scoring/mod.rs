//! All metrics. A new one is a type in this file and a line in [`all_metrics`]. Long formulas have
//! files of their own; only LPIPS, which has networks, implements [`Metric`] elsewhere.

mod depth;
#[cfg(feature = "torch")]
mod lpips;
mod lpips_network;
mod perceptual;
mod ssim;
mod warp;

use std::path::Path;

use anyhow::Context as _;
use artifact::FailureExt as _;
use metrics::{Score, ScoreFormat, Scores};
use pixels::{DEPTH_CHANNELS, DepthMap, ExrImage, Image, psnr_of, read_exr};
use scene::format_length;

use crate::metric::{Measurement, Metric, value};
use crate::scored_view::{ScoredScene, ScoredView};

pub use depth::{DepthError, depth_error};
#[cfg(feature = "torch")]
pub use lpips::Lpips;
pub use lpips_network::LpipsNetwork;
pub(crate) use perceptual::{Perceptual, weights_rule};
pub use ssim::{Ssim, ssim};
pub use warp::WarpScore;

/// Returns all metrics in order of display. The page ranks results by the first figure, and its
/// summary has the first four figures with a value.
pub(crate) fn all_metrics(perceptual: Perceptual) -> Vec<Box<dyn Metric>> {
    vec![
        Box::new(PsnrMetric),
        Box::new(SsimMetric),
        Box::new(perceptual),
        Box::new(LowResolutionMetric),
        Box::new(WarpMetric),
        Box::new(DepthMetric),
    ]
}

/// Returns the peak signal-to-noise ratio in dB, peak 1, of the mean squared error over all
/// samples. Samples must lie in 0..1; equal images, whose PSNR is infinite, count as 100 dB.
pub fn psnr(render: &Image, truth: &Image) -> f64 {
    let pairs = render.data.iter().zip(&truth.data);
    let sum: f64 = pairs.map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum();
    psnr_of(sum / render.data.len() as f64)
}

/// Returns the [`psnr`] of the pixels that count; all other pixels must be equal. `counted_share`
/// is the fraction that counts. Below 1, images that are equal everywhere have less than 100 dB.
fn masked_psnr(render: &Image, truth: &Image, counted_share: f64) -> f64 {
    psnr(render, truth) + 10.0 * counted_share.log10()
}

/// Returns the last words of the convention of a score that ignores masked pixels; empty if no view
/// has a mask.
fn masked_note(scene: &ScoredScene<'_>) -> &'static str {
    let is_masked = scene.truth.views.iter().any(|view| view.mask.is_some());
    if is_masked { "; only pixels that no mask excludes" } else { "" }
}

/// [`psnr`] of the pixels that count.
struct PsnrMetric;

impl Metric for PsnrMetric {
    fn name(&self) -> &'static str {
        "psnr"
    }

    fn figures(&self) -> Vec<ScoreFormat> {
        vec![ScoreFormat::new("psnr", "PSNR ↑ dB", 2, true)]
    }

    fn convention(&self, scene: &ScoredScene<'_>) -> String {
        format!(
            "-10 log10 of the mean squared error over pixels and channels in [0, 1]; prediction in \
            half precision, clamped; mean of per-view values{}",
            masked_note(scene)
        )
    }

    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measurement> {
        let Some(truth) = &view.truth else { return Ok(Measurement::default()) };
        let psnr = masked_psnr(&view.render, truth, view.counted_share);
        Ok(Measurement::one("psnr", Score::One(psnr)))
    }

    fn summary(&self, mean: &Scores) -> Option<String> {
        Some(format!("PSNR {:.2} dB", value(mean, "psnr")?))
    }
}

/// [`ssim`] with both treatments of the border.
struct SsimMetric;

impl Metric for SsimMetric {
    fn name(&self) -> &'static str {
        "ssim"
    }

    fn figures(&self) -> Vec<ScoreFormat> {
        vec![
            ScoreFormat::new("ssim", "SSIM ↑", 4, true),
            ScoreFormat::new("ssim_valid", "SSIM ↑ whole windows", 4, true),
        ]
    }

    fn convention(&self, _: &ScoredScene<'_>) -> String {
        "Gaussian 11×11, σ 1.5, data range 1, K1 0.01, K2 0.03, f64; mean over channels and \
        pixels; borders reflected (ssim), or pixels whose window is whole (ssim_valid)"
            .to_owned()
    }

    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measurement> {
        let Some(truth) = &view.truth else { return Ok(Measurement::default()) };
        let Ssim { reflected, valid } = ssim(&view.render, truth);
        let mut measurement = Measurement::one("ssim", Score::One(reflected));
        measurement.scores.insert("ssim_valid".to_owned(), Score::One(valid));
        Ok(measurement)
    }

    fn summary(&self, mean: &Scores) -> Option<String> {
        Some(format!("SSIM {:.4}", value(mean, "ssim")?))
    }
}

/// PSNR and SSIM between the view's LR image and the render, shrunk by the known or assumed kernel
/// of the LR images.
struct LowResolutionMetric;

impl Metric for LowResolutionMetric {
    fn name(&self) -> &'static str {
        "low_resolution"
    }

    fn figures(&self) -> Vec<ScoreFormat> {
        vec![
            ScoreFormat::new("low_resolution/psnr", "PSNR at LR ↑ dB", 2, true),
            ScoreFormat::new("low_resolution/ssim", "SSIM at LR ↑", 4, true),
        ]
    }

    fn convention(&self, scene: &ScoredScene<'_>) -> String {
        let kernel = scene.degradation.map_or_else(
            || "box (assumed: the degradation kernel is unknown)".to_owned(),
            |degradation| format!("{:?}", degradation.kernel).to_lowercase(),
        );
        format!("render shrunk by {kernel}, compared with the view's LR image")
    }

    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measurement> {
        let Some(lr) = &view.lr else { return Ok(Measurement::default()) };
        let score = Score::several([
            ("psnr", masked_psnr(&lr.render, &lr.truth, lr.counted_share)),
            ("ssim", ssim(&lr.render, &lr.truth).reflected),
        ]);
        Ok(Measurement::one(self.name(), score))
    }

    fn summary(&self, mean: &Scores) -> Option<String> {
        // HR figures are more informative.
        if value(mean, "psnr").is_some() {
            return None;
        }
        let [psnr, ssim] =
            ["psnr", "ssim"].map(|part| value(mean, &format!("low_resolution/{part}")));
        Some(format!("at LR: PSNR {:.2} dB · SSIM {:.4}", psnr?, ssim?))
    }
}

/// [`WarpScore`], if there is HR truth and rendered depth.
struct WarpMetric;

impl Metric for WarpMetric {
    fn name(&self) -> &'static str {
        "warp"
    }

    fn figures(&self) -> Vec<ScoreFormat> {
        vec![
            ScoreFormat::new("warp/psnr", "PSNR of warped neighbour ↑ dB", 2, true),
            ScoreFormat::new("warp/seen", "share of pixels visible in the neighbour ↑", 4, true),
        ]
    }

    fn convention(&self, _: &ScoredScene<'_>) -> String {
        "the nearest view's ground truth, warped by both rendered depths, is compared with the \
        view's own over pixels whose surface both views observe (depths within 2 %, or \
        reprojection error of at most half a pixel; opacity at least one half); left out where the \
        views are more than 20° apart"
            .to_owned()
    }

    fn picture_title(&self) -> Option<&'static str> {
        Some("Warped neighbour (red: not visible there)")
    }

    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measurement> {
        let Some((score, picture)) = warp::score_view(view)? else {
            return Ok(Measurement::default());
        };
        let score = Score::several([("psnr", score.psnr), ("seen", score.seen)]);
        Ok(Measurement { picture: Some(picture), ..Measurement::one(self.name(), score) })
    }
}

/// [`depth_error`], if there is true depth and a surface.
struct DepthMetric;

impl Metric for DepthMetric {
    fn name(&self) -> &'static str {
        "depth"
    }

    fn figures(&self) -> Vec<ScoreFormat> {
        vec![
            ScoreFormat::new("depth/mean_absolute", "depth error, mean of pixels ↓", 4, false),
            ScoreFormat::new("depth/median_absolute", "depth error, median of pixels ↓", 4, false),
            ScoreFormat::new("depth/missed", "share of surface missed ↓", 4, false),
        ]
    }

    fn convention(&self, scene: &ScoredScene<'_>) -> String {
        format!(
            "error of z-depth in scene units, over pixels with a surface in the ground truth; \
            missed: fraction of these pixels where the render's opacity is below one half{}",
            masked_note(scene)
        )
    }

    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measurement> {
        let (scene, name) = (view.scene, &view.view.camera.name);
        let (Some(rendered), Some(truth)) = (&view.view.depth, &view.true_view.depth) else {
            return Ok(Measurement::default());
        };
        let rendered = read_depth(&scene.views_input.path(rendered), name)?;
        let truth = read_depth(&scene.truth_input.path(truth), name)?;
        let size = (truth.width, truth.height);
        let maps = DepthMap::of(&rendered).zip(DepthMap::of(&truth));
        let (rendered_map, true_map) = maps
            .filter(|_| (rendered.width, rendered.height) == size)
            .context("expected depth channels Z and A of the same size")
            .bad_input(format!("view {name}"))?;
        let mask = view.mask.as_ref().map(|mask| mask.resized(size, 0));
        let Some(error) = depth_error(rendered_map, true_map, mask.as_ref()) else {
            return Ok(Measurement::default());
        };
        let score = Score::several([
            ("mean_absolute", error.mean_absolute),
            ("median_absolute", error.median_absolute),
            ("missed", error.missed),
        ]);
        Ok(Measurement::one(self.name(), score))
    }

    fn summary(&self, mean: &Scores) -> Option<String> {
        let [mean, median] = ["mean_absolute", "median_absolute"]
            .map(|part| Some(format_length(value(mean, &format!("depth/{part}"))?, 4)));
        Some(format!("depth error {} mean, {} median", mean?, median?))
    }
}

/// Reads the depth channels of a view.
fn read_depth(path: &Path, view: &str) -> Result<ExrImage, artifact::Failure> {
    read_exr(path)
        .and_then(|image| image.with_finite(&DEPTH_CHANNELS, path))
        .bad_input(format!("view {view}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_have_distinct_paths_and_labels() {
        let all = all_metrics(Perceptual::new(None, usize::MAX).unwrap());
        let figures: Vec<ScoreFormat> = all.iter().flat_map(|metric| metric.figures()).collect();
        for (i, figure) in figures.iter().enumerate() {
            assert!(figures[..i].iter().all(|f| f.path != figure.path && f.label != figure.label));
        }
        assert_eq!(figures[0].path, "psnr");
    }
}

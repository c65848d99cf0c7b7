//! `eval`: scores views against ground truth, and says by which conventions.
//!
//! * [`psnr`]: of the mean squared error over all samples; predictions clamped to [0, 1].
//! * [`ssim`]: Gaussian window, reflected at the border and valid pixels only.
//! * `lpips`: by SqueezeNet, AlexNet and VGG-16, each where its weights are given and the build has
//!   libtorch.
//! * [`depth_error`]: where the truth has depth.
//! * [`WarpScore`]: a view's neighbour, brought over by the rendered depths, against the view.
//! * [`LrScores`]: the same of the render shrunk to LR, by the kernel that made the LR images or is
//!   taken to have made them. Where photographs are all there is, no HR truth exists, and this
//!   alone can be known.
//!
//! Means over views are means of per-view values. Open backgrounds are scored on white. Where a
//! view has a mask, what doesn't count is taken as right, and PSNR is that of the rest.

mod depth;
mod derived;
#[cfg(feature = "torch")]
mod lpips;
mod perceptual;
mod ssim;
mod warp;

use std::path::Path;

use anyhow::Context as _;
use artifact::{Context, Failure, FailureExt as _, GivenInput, Input, Output, Stage};
use derived::{least_gain, near_references};
use perceptual::{MISSING, Perceptual};
use pixels::{
    DEGRADATION_FILE, Degradation, Filter, Image, Mask, Palette, Resampling, Rgba8, heat, psnr_of,
    read_exr, read_premultiplied, write_png,
};
use rayon::prelude::*;
use scene::{Background, View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use depth::{DepthError, depth_error};
pub use derived::NearReferences;
#[cfg(feature = "torch")]
pub use lpips::Lpips;
pub use perceptual::LpipsNetwork;
pub use ssim::{Ssim, ssim};
pub use warp::WarpScore;

/// Parameters of `eval`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Absolute error that error maps show in their brightest colour.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub error_range: f64,
}

impl Default for Params {
    fn default() -> Self {
        Self { error_range: 0.25 }
    }
}

/// `metrics.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Metrics {
    /// How the figures were made, in words.
    pub conventions: MetricConventions,
    /// Means of the per-view values.
    pub mean: Scores,
    /// Gain in dB of the view that fares worst over input `baseline`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least_gain: Option<f64>,
    /// Scores of the views near an HR reference, where input `references` is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub near_references: Option<NearReferences>,
    /// Every view.
    pub views: Vec<ViewScores>,
}

/// The conventions behind the figures.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MetricConventions {
    /// What was behind the scene.
    pub background: String,
    /// How PSNR was made.
    pub psnr: String,
    /// How SSIM was made.
    pub ssim: String,
    /// How LPIPS was made, or why it is missing.
    pub lpips: String,
    /// How depth was scored.
    pub depth: String,
    /// How a view's neighbour was brought over.
    pub warp: String,
    /// How the view's LR image was compared with.
    pub low_resolution: String,
    /// What the error maps show.
    pub error_maps: String,
}

/// Scores of a view, or their means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Scores {
    /// Peak signal-to-noise ratio in dB, where there is HR truth; higher is better.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr: Option<f64>,
    /// Structural similarity, where there is HR truth; higher is better. Images are reflected at
    /// their borders, as PyTorch pads.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ssim: Option<f64>,
    /// The same over pixels whose window is whole, as scikit-image has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ssim_valid: Option<f64>,
    /// Learned perceptual distance by SqueezeNet 1.1, where its weights are given; lower is better.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    /// The same by AlexNet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lpips_alex: Option<f64>,
    /// The same by VGG-16.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lpips_vgg: Option<f64>,
    /// Depth errors, where there is true depth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<DepthError>,
    /// The neighbour's true image brought over by depth, where there is HR truth and rendered
    /// depth.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub warp: Option<WarpScore>,
    /// The shrunk render against the view's LR image, where there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub low_resolution: Option<LrScores>,
}

/// A render shrunk to LR against the view's LR image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LrScores {
    /// Peak signal-to-noise ratio in dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
}

/// One view's scores.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ViewScores {
    /// The view.
    pub name: String,
    /// Its scores.
    pub scores: Scores,
    /// Its error map.
    pub error_map: String,
    /// Its neighbour's image, brought over by depth.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub warp: Option<String>,
}

/// The stage.
pub struct Eval;

impl Stage for Eval {
    type Params = Params;
    const NAME: &'static str = "eval";
    const SUMMARY: &'static str = "Scores views against ground truth and draws error maps.";

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            ("truth", Input::required(&["scene/truth"], "ground truth, views of the same names")),
            (
                "baseline",
                Input::optional(
                    &["metrics"],
                    "scores of the same views to compare with, for the least gain of a view",
                ),
            ),
            (
                "references",
                Input::optional(
                    &["scene/references"],
                    "HR references, for scores of the views near one",
                ),
            ),
            (
                "weights",
                Input::optional(
                    &["weights"],
                    "folder with networks and their heads, for LPIPS: squeezenet1_1.safetensors \
                    and lpips_linear_squeeze_v0.1.safetensors, likewise alexnet and vgg16",
                ),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("metrics")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let (views_in, truth_in) = (context.input("views")?, context.input("truth")?);
        let (views, truth) = (Views::read(views_in)?, Views::read(truth_in)?);
        let perceptual = Perceptual::new(context.optional_input("weights"))?;
        let is_known = truth_in.path(DEGRADATION_FILE).exists();
        let made: Option<Degradation> =
            if is_known { Some(truth_in.read_json(DEGRADATION_FILE)?) } else { None };
        let filter = made.map_or(Filter::Box, |d| d.kernel.filter());
        let job = ScoringJob {
            context,
            params,
            perceptual: &perceptual,
            filter,
            views: (views_in, &views),
            truth: (truth_in, &truth),
        };
        let progress = context.progress("scoring", truth.views.len() as u64);
        let score = |view: &View| -> anyhow::Result<ViewScores> {
            context.check_interrupt()?;
            let scores = job.score(view)?;
            progress.add(1);
            Ok(scores)
        };
        let scored = truth.views.par_iter().map(score).collect::<anyhow::Result<Vec<_>>>()?;
        let baseline = context.optional_input("baseline");
        let references = context.optional_input("references").map(Views::read).transpose()?;
        let metrics = Metrics {
            conventions: conventions(params, &truth, &perceptual, made),
            mean: mean_of(&scored),
            least_gain: baseline
                .map(|baseline| least_gain(&scored, baseline))
                .transpose()?
                .flatten(),
            near_references: references
                .and_then(|references| near_references(&scored, &truth, &references)),
            views: scored,
        };
        context.write_json("metrics.json", &metrics)?;
        context.write_summary(&summary(&metrics))
    }
}

/// What scoring a view needs.
struct ScoringJob<'a> {
    context: &'a Context,
    params: &'a Params,
    perceptual: &'a Perceptual,
    /// What made the LR images, as far as is known.
    filter: Filter,
    views: (&'a GivenInput, &'a Views),
    truth: (&'a GivenInput, &'a Views),
}

impl ScoringJob<'_> {
    fn score(&self, true_view: &View) -> anyhow::Result<ViewScores> {
        let ((views_in, views), (truth_in, truth)) = (self.views, self.truth);
        let name = &true_view.camera.name;
        let view = views.views.iter().find(|v| v.camera.name == *name);
        let view = view.ok_or_else(|| {
            Failure::BadInput(format!("views: none is named {name}, which the truth has"))
        })?;
        let image = view
            .image
            .as_ref()
            .with_context(|| format!("view {name}: it has no image"))
            .bad_input("views")?;
        let found = read_view(views_in, view, image, views.background)?;
        let read_true = |file: &Option<String>| -> anyhow::Result<Option<Image>> {
            file.as_ref().map(|f| read_view(truth_in, true_view, f, truth.background)).transpose()
        };
        let (mut expected, mut lr) =
            (read_true(&true_view.image)?, read_true(&true_view.low_resolution)?);
        let wanted = (
            true_view.camera.intrinsics.width as usize,
            true_view.camera.intrinsics.height as usize,
        );
        if wanted != (found.width, found.height) {
            let message = format!(
                "view {name}: rendered at {}×{} where the truth has {}×{}; set size in \
                render-depth",
                found.width, found.height, wanted.0, wanted.1
            );
            return Err(Failure::BadInput(message).into());
        }
        let size = |p: &Image| (p.width, p.height);
        if let Some(expected) = expected.as_ref().filter(|e| size(e) != wanted) {
            let message = format!(
                "view {name}: its image has {}×{} pixels, its camera others",
                expected.width, expected.height
            );
            return Err(Failure::BadInput(message).into());
        }
        let shrunk = lr.as_ref().map(|lr| {
            let mut shrunk = Resampling::new(self.filter, size(&found), size(lr)).apply(&found);
            // As 8 bits would: a kernel with negative lobes overshoots.
            shrunk.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
            shrunk
        });
        // What doesn't count can't differ; PSNR is that of the rest: so many dB more or less.
        let of_mask = |image: &Image| -> anyhow::Result<Option<Mask>> {
            true_view.read_mask(truth_in, size(image)).bad_input(format!("view {name}"))
        };
        let mask = expected.as_ref().or(lr.as_ref()).map(of_mask).transpose()?.flatten();
        let mut counted = [0.0; 2];
        if let Some(mask) = &mask {
            let pairs = [(expected.as_mut(), Some(&found)), (lr.as_mut(), shrunk.as_ref())];
            for (decibels, (truth, found)) in counted.iter_mut().zip(pairs) {
                if let (Some(truth), Some(found)) = (truth, found) {
                    let mask = mask.resized(size(truth), 0);
                    mask.fill(truth, found);
                    if mask.share() == 0.0 {
                        let message = format!(
                            "view {name}: its mask leaves no pixel to score; remove the view or \
                            its mask"
                        );
                        return Err(Failure::BadInput(message).into());
                    }
                    *decibels = 10.0 * mask.share().log10();
                }
            }
        }
        let (shown, against) = match (&expected, &shrunk, &lr) {
            (Some(expected), ..) => (&found, expected),
            (None, Some(shrunk), Some(lr)) => (shrunk, lr),
            _ => {
                return Err(
                    Failure::BadInput(format!("truth: view {name} has no image at all")).into()
                );
            }
        };
        let error_map = format!("errors/{name}.png");
        write_png(
            &self.context.output_path(&error_map)?,
            &draw_error(shown, against, self.params.error_range as f32),
        )?;
        let warped = expected.as_ref().map(|e| self.warp(view, e)).transpose()?.flatten();
        let similar = expected.as_ref().map(|e| ssim(&found, e));
        let distances =
            expected.as_ref().map(|e| self.perceptual.distances(&found, e)).transpose()?;
        let [lpips, lpips_alex, lpips_vgg] = distances.unwrap_or_default();
        let scores = Scores {
            psnr: expected.as_ref().map(|e| psnr(&found, e) + counted[0]),
            ssim: similar.map(|s| s.reflected),
            ssim_valid: similar.map(|s| s.valid),
            lpips,
            lpips_alex,
            lpips_vgg,
            depth: score_depth((views_in, view), (truth_in, true_view))?,
            warp: warped.as_ref().map(|(score, _)| *score),
            low_resolution: shrunk
                .iter()
                .zip(&lr)
                .map(|(shrunk, lr)| LrScores {
                    psnr: psnr(shrunk, lr) + counted[1],
                    ssim: ssim(shrunk, lr).reflected,
                })
                .next(),
        };
        Ok(ViewScores { name: name.clone(), scores, error_map, warp: warped.map(|(_, file)| file) })
    }

    /// The true image of a view's nearest neighbour, seen from the view by the rendered depths: its
    /// score and its file.
    fn warp(&self, view: &View, expected: &Image) -> anyhow::Result<Option<(WarpScore, String)>> {
        let ((views_in, views), (truth_in, truth)) = (self.views, self.truth);
        let Some(other) = warp::neighbour(&view.camera, &views.views) else { return Ok(None) };
        let other_truth = truth.views.iter().find(|v| v.camera.name == other.camera.name);
        let Some((other_view, file)) = other_truth.and_then(|v| Some((v, v.image.as_ref()?)))
        else {
            return Ok(None);
        };
        let (Some(own), Some(theirs)) =
            (warp::read_surface(views_in, view)?, warp::read_surface(views_in, other)?)
        else {
            return Ok(None);
        };
        let image = read_view(truth_in, other_view, file, truth.background)?;
        if (image.width, image.height) != (theirs.width, theirs.height) {
            return Ok(None);
        }
        let Some((score, warped)) =
            warp::warp((&view.camera, &own, expected), (&other.camera, &theirs, &image))
        else {
            return Ok(None);
        };
        let file = format!("warps/{}.png", view.camera.name);
        write_png(&self.context.output_path(&file)?, &warped)?;
        Ok(Some((score, file)))
    }
}

/// Peak signal-to-noise ratio in dB, peak 1, of the mean squared error over all samples.
/// Predictions are clamped to [0, 1] by [`read_view`]; equal images, which have no PSNR, count as
/// 100 dB.
pub fn psnr(found: &Image, expected: &Image) -> f64 {
    let sum: f64 = found
        .data
        .iter()
        .zip(&expected.data)
        .map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2))
        .sum();
    psnr_of(sum / found.data.len() as f64)
}

/// An image of a view over its background, clamped to [0, 1].
fn read_view(
    input: &GivenInput,
    view: &View,
    file: &str,
    background: Background,
) -> anyhow::Result<Image> {
    let place = format!("view {}", view.camera.name);
    let path = input.path(file);
    let mut image = read_premultiplied(&path).bad_input(&place)?.over(background.shown());
    image.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    Ok(image)
}

/// Mean absolute error of the three channels as a colour.
fn draw_error(found: &Image, expected: &Image, range: f32) -> Rgba8 {
    let pixel = |(a, b): (&[f32], &[f32])| {
        let error = a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f32>() / 3.0;
        let [r, g, b] = heat(Palette::Error, error / range);
        [r, g, b, 255]
    };
    let data =
        found.data.chunks_exact(3).zip(expected.data.chunks_exact(3)).flat_map(pixel).collect();
    Rgba8::new(found.width, found.height, data)
}

fn score_depth(
    (views_in, view): (&GivenInput, &View),
    (truth_in, truth): (&GivenInput, &View),
) -> anyhow::Result<Option<DepthError>> {
    let (Some(found), Some(expected)) = (&view.depth, &truth.depth) else { return Ok(None) };
    let read = |path: &Path| read_exr(path).bad_input(format!("view {}", view.camera.name));
    let (found, expected) = (read(&views_in.path(found))?, read(&truth_in.path(expected))?);
    let error = depth_error(&found, &expected).context("depth needs channels Z and A of one size");
    error.map(Some).bad_input(format!("view {}", view.camera.name))
}

fn mean_of(views: &[ViewScores]) -> Scores {
    let mean = |value: &dyn Fn(&Scores) -> Option<f64>| {
        let values: Vec<f64> = views.iter().filter_map(|v| value(&v.scores)).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    let depth = |value: &dyn Fn(&DepthError) -> f64| mean(&|s| s.depth.as_ref().map(value));
    Scores {
        psnr: mean(&|s| s.psnr),
        ssim: mean(&|s| s.ssim),
        ssim_valid: mean(&|s| s.ssim_valid),
        lpips: mean(&|s| s.lpips),
        lpips_alex: mean(&|s| s.lpips_alex),
        lpips_vgg: mean(&|s| s.lpips_vgg),
        depth: depth(&|d| d.mean_absolute).map(|mean_absolute| DepthError {
            mean_absolute,
            median_absolute: depth(&|d| d.median_absolute).unwrap_or_default(),
            missed: depth(&|d| d.missed).unwrap_or_default(),
        }),
        warp: mean(&|s| s.warp.map(|w| w.psnr))
            .zip(mean(&|s| s.warp.map(|w| w.seen)))
            .map(|(psnr, seen)| WarpScore { psnr, seen }),
        low_resolution: mean(&|s| s.low_resolution.map(|l| l.psnr))
            .zip(mean(&|s| s.low_resolution.map(|l| l.ssim)))
            .map(|(psnr, ssim)| LrScores { psnr, ssim }),
    }
}

fn conventions(
    params: &Params,
    truth: &Views,
    perceptual: &Perceptual,
    made: Option<Degradation>,
) -> MetricConventions {
    let masked = if truth.views.iter().any(|v| v.mask.is_some()) {
        "; of the pixels that masks leave"
    } else {
        ""
    };
    let on = match truth.background {
        Background::Black => "black",
        Background::White | Background::Alpha => "white",
        Background::Opaque => "none: the pictures are opaque",
    };
    MetricConventions {
        background: on.to_owned(),
        psnr: format!(
            "-10 log10 of the mean squared error over pixels and channels in [0, 1]; \
            prediction in half precision, clamped; mean of per-view values{masked}"
        ),
        ssim: "Gaussian 11×11, σ 1.5, data range 1, K1 0.01, K2 0.03, f64; mean over channels and \
            pixels; borders reflected (ssim), or pixels \
               whose window is whole (ssim_valid)"
            .to_owned(),
        lpips: perceptual.convention(),
        depth: "z-depth, where the truth sees a surface at the pixel's centre; missed: opacity \
            below one half there"
            .to_owned(),
        warp: "the true picture of the view whose camera is nearest, brought over by both \
            rendered depths, against the view's own, where \
               both see the same surface (depths within 2 %, or within a pixel as the view sees \
               them; opacity at least one half)"
            .to_owned(),
        low_resolution: format!(
            "the render shrunk by {}, against the view's LR picture",
            made.map_or_else(
                || "a box, for want of a better \
                guess"
                    .to_owned(),
                |d| format!("{:?}", d.kernel).to_lowercase()
            )
        ),
        error_maps: format!("mean absolute error of R, G, B; brightest at {}", params.error_range),
    }
}

fn summary(metrics: &Metrics) -> String {
    let mean = &metrics.mean;
    let mut parts = Vec::new();
    if let (Some(psnr), Some(ssim)) = (mean.psnr, mean.ssim) {
        parts.push(format!("PSNR {psnr:.2} dB · SSIM {ssim:.4}"));
        let by = [
            ("LPIPS", mean.lpips),
            ("LPIPS (AlexNet)", mean.lpips_alex),
            ("LPIPS (VGG-16)", mean.lpips_vgg),
        ];
        let known: Vec<String> = by
            .iter()
            .filter_map(|(name, value)| Some(format!("{name} {:.4}", (*value)?)))
            .collect();
        parts.push(if known.is_empty() { format!("LPIPS {MISSING}") } else { known.join(" · ") });
    }
    parts.extend(mean.depth.map(|d| {
        format!("depth error {:.4} mean, {:.4} median", d.mean_absolute, d.median_absolute)
    }));
    if let (Some(lr), None) = (mean.low_resolution, mean.psnr) {
        parts.push(format!("at LR: PSNR {:.2} dB · SSIM {:.4}", lr.psnr, lr.ssim));
    }
    parts.push(artifact::counted(metrics.views.len(), "view"));
    parts.join(" · ")
}

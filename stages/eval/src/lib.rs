//! `eval`: scores views against ground truth, and records the definitions of the scores.
//!
//! * `metric`: the trait of a metric; `scoring`: all metrics. A new one changes `scoring/mod.rs`
//!   alone.
//! * [`psnr`], [`ssim`] and `lpips` compare with HR truth. LPIPS, by SqueezeNet, AlexNet and
//!   VGG-16, needs each network's weights and libtorch.
//! * `low_resolution`: PSNR and SSIM of the render shrunk to LR, the only scores of photographs
//!   without HR truth.
//! * [`depth_error`] compares with true depth. [`WarpScore`] compares a view with its neighbour,
//!   warped by the rendered depths.
//! * `derived`: scores near references, and the least gain over another result.
//!
//! The crate `metrics` has the types of `metrics.json`.
//!
//! Means over views are means of per-view values. Transparent backgrounds are scored on white.
//! Pixels outside a view's mask count as correct, except in PSNR, [`depth_error`] and
//! [`WarpScore`], which ignore them.

mod derived;
mod metric;
mod scored_view;
mod scoring;

use std::collections::BTreeMap;

use metrics::{ERROR_MAP_RANGE, METRICS_FILE, Metrics, Scores, ViewScores};
use pixels::{DEGRADATION_FILE, Degradation, Image, Palette, Rgba8, palette_colour, write_png};
use rayon::prelude::*;
use scene::{Background, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Rule, Stage};

use metric::{Metric, mean_of};
use scored_view::{ScoredScene, ScoredView};
#[cfg(feature = "torch")]
pub use scoring::Lpips;
pub use scoring::{DepthError, LpipsNetwork, Ssim, WarpScore, depth_error, psnr, ssim};
use scoring::{Perceptual, all_metrics, weights_rule};

/// Parameters of `eval`: none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {}

/// Stage `eval`.
pub struct Eval;

impl Stage for Eval {
    type Params = Params;
    const NAME: &'static str = "eval";
    const SUMMARY: &'static str = "Scores views against ground truth and draws error maps.";
    const LIBTORCH: bool = cfg!(feature = "torch");

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            ("truth", Input::required(&["scene/truth"], "ground truth, views of the same names")),
            (
                "baseline",
                Input::optional(
                    &["metrics"],
                    "another method's scores of the same views; the output then has the \
                    smallest PSNR gain of any view over these scores",
                ),
            ),
            (
                "references",
                Input::optional(
                    &["scene/references"],
                    "HR references, for scores of the views near a reference",
                ),
            ),
            (
                "weights",
                Input::optional(
                    &["weights"],
                    "folder with networks for LPIPS, each a pair of files: \
                    squeezenet1_1.safetensors and lpips_linear_squeeze_v0.1.safetensors; \
                    alexnet.safetensors and lpips_linear_alex_v0.1.safetensors; vgg16.safetensors \
                    and lpips_linear_vgg_v0.1.safetensors",
                ),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("metrics")
    }

    fn rules() -> Vec<Rule> {
        vec![weights_rule()]
    }

    fn run(context: &Context, _: &Params) -> anyhow::Result<()> {
        let (views_input, truth_input) = (context.input("views")?, context.input("truth")?);
        let (views, truth) = (Views::read(views_input)?, Views::read(truth_input)?);
        let perceptual =
            Perceptual::new(context.optional_input("weights"), min_scored_side(&truth))?;
        for note in perceptual.notes() {
            context.log_line(note);
        }
        let metrics = all_metrics(perceptual);
        let degradation: Option<Degradation> = truth_input.read_optional_json(DEGRADATION_FILE)?;
        let scene =
            ScoredScene { views_input, views: &views, truth_input, truth: &truth, degradation };
        let progress = context.progress("scoring", truth.views.len() as u64);
        let scored = truth.views.par_iter().map(|true_view| {
            context.check_interrupt()?;
            let scores = score(context, &metrics, &ScoredView::read(&scene, true_view)?)?;
            progress.add(1);
            anyhow::Ok(scores)
        });
        let scored = scored.collect::<anyhow::Result<Vec<ViewScores>>>()?;
        let baseline = context.optional_input("baseline");
        let least_gain = baseline.map(|input| derived::least_gain(&scored, input)).transpose()?;
        let references = context.optional_input("references").map(Views::read).transpose()?;
        let near_references =
            references.and_then(|views| derived::near_references(&scored, &truth, &views));
        let result = Metrics {
            conventions: conventions(&scene, &metrics),
            figures: metrics.iter().flat_map(|metric| metric.figures()).collect(),
            picture_titles: metrics
                .iter()
                .filter_map(|metric| {
                    Some((metric.name().to_owned(), metric.picture_title()?.to_owned()))
                })
                .collect(),
            mean: mean_of(scored.iter().map(|view| &view.scores)),
            least_gain: least_gain.flatten(),
            near_references,
            views: scored,
        };
        context.write_json(METRICS_FILE, &result)?;
        let mut summary: Vec<String> =
            metrics.iter().filter_map(|metric| metric.summary(&result.mean)).collect();
        summary.push(artifact::format_count(result.views.len(), "view"));
        context.write_summary(&summary.join(" · "))
    }
}

/// Returns the smallest side of a view with HR truth, in pixels.
fn min_scored_side(truth: &Views) -> usize {
    let views = truth.views.iter().filter(|view| view.image.is_some());
    let sides = views.map(|view| view.camera.intrinsics.width.min(view.camera.intrinsics.height));
    sides.min().map_or(usize::MAX, |side| side as usize)
}

/// Scores a view by every metric, and writes its error map and the metrics' pictures.
fn score(
    context: &Context,
    metrics: &[Box<dyn Metric>],
    view: &ScoredView<'_>,
) -> anyhow::Result<ViewScores> {
    let name = &view.true_view.camera.name;
    let error_map = format!("errors/{name}.png");
    let (render, truth) = view.compared_images();
    write_png(&context.output_path(&error_map)?, &draw_error_map(render, truth))?;
    let mut scores = Scores::new();
    let mut pictures = BTreeMap::new();
    for metric in metrics {
        let measured = metric.score(view)?;
        scores.extend(measured.scores);
        if let Some(picture) = measured.picture {
            let file = format!("{}s/{name}.png", metric.name());
            write_png(&context.output_path(&file)?, &picture)?;
            pictures.insert(metric.name().to_owned(), file);
        }
    }
    Ok(ViewScores { name: name.clone(), scores, error_map, pictures })
}

/// Draws the mean absolute error of the three channels as a colour.
fn draw_error_map(render: &Image, truth: &Image) -> Rgba8 {
    let truth_pixels = truth.data.as_chunks::<3>().0;
    let mut data = Vec::with_capacity(4 * truth_pixels.len());
    for (i, [r, g, b]) in render.data.as_chunks::<3>().0.iter().enumerate() {
        let [true_r, true_g, true_b] = truth_pixels[i];
        let error = ((r - true_r).abs() + (g - true_g).abs() + (b - true_b).abs()) / 3.0;
        data.extend(palette_colour(Palette::Error, error / ERROR_MAP_RANGE as f32));
        data.push(255);
    }
    Rgba8::new(render.width, render.height, data)
}

fn conventions(scene: &ScoredScene<'_>, metrics: &[Box<dyn Metric>]) -> BTreeMap<String, String> {
    let background = match scene.truth.background {
        Background::Black => "black",
        Background::White | Background::Alpha => "white",
        Background::Opaque => "none: the pictures are opaque",
    };
    let error_maps = format!("mean absolute error of R, G, B; brightest at {ERROR_MAP_RANGE}");
    let mut conventions = BTreeMap::from([
        ("background".to_owned(), background.to_owned()),
        ("error_maps".to_owned(), error_maps),
    ]);
    for metric in metrics {
        conventions.insert(metric.name().to_owned(), metric.convention(scene));
    }
    conventions
}

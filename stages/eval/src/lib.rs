//! `eval`: scores views against ground truth, and says by which conventions.
//!
//! * `metric`: what a metric is; `scoring`: all of them. A new one changes `scoring/mod.rs` alone.
//! * [`psnr`], [`ssim`], `lpips` (by SqueezeNet, AlexNet and VGG-16, each where its weights are
//!   given and the build has libtorch): against HR truth.
//! * `low_resolution`: PSNR and SSIM of the render shrunk to LR. Where photographs are all there
//!   is, no HR truth exists, and this alone can be known.
//! * [`depth_error`]: where the truth has depth. [`WarpScore`]: a view's neighbour, brought over by
//!   the rendered depths, against the view.
//! * `derived`: the scores near references and the least gain, over all views.
//!
//! The crate `metrics` has the types of `metrics.json`.
//!
//! Means over views are means of per-view values. Open backgrounds are scored on white. Where a
//! view has a mask, what doesn't count is taken as right, and PSNR is that of the rest.

mod derived;
mod metric;
mod scored_view;
mod scoring;

use std::collections::BTreeMap;

use contract::{Input, Output};
use metrics::{METRICS_FILE, Metrics, Scores, ViewScores};
use pixels::{DEGRADATION_FILE, Degradation, Image, Palette, Rgba8, heat, write_png};
use rayon::prelude::*;
use scene::{Background, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Stage};

use derived::{least_gain, near_references};
use metric::{Metric, mean_of};
use scored_view::{ScoredScene, ScoredView};
#[cfg(feature = "torch")]
pub use scoring::Lpips;
pub use scoring::{DepthError, LpipsNetwork, Ssim, WarpScore, depth_error, psnr, ssim};
use scoring::{Perceptual, metrics};

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
        let metrics = metrics(Perceptual::new(context.optional_input("weights"))?);
        let is_known = truth_in.path(DEGRADATION_FILE).exists();
        let made: Option<Degradation> =
            if is_known { Some(truth_in.read_json(DEGRADATION_FILE)?) } else { None };
        let scene = ScoredScene { views_in, views: &views, truth_in, truth: &truth, made };
        let progress = context.progress("scoring", truth.views.len() as u64);
        let scored = truth.views.par_iter().map(|true_view| {
            context.check_interrupt()?;
            let scores = score(context, params, &metrics, &ScoredView::read(&scene, true_view)?)?;
            progress.add(1);
            anyhow::Ok(scores)
        });
        let scored = scored.collect::<anyhow::Result<Vec<ViewScores>>>()?;
        let baseline = context.optional_input("baseline");
        let least_gain = baseline.map(|baseline| least_gain(&scored, baseline)).transpose()?;
        let references = context.optional_input("references").map(Views::read).transpose()?;
        let near = references.and_then(|near| near_references(&scored, &truth, &near));
        let found = Metrics {
            conventions: conventions(params, &scene, &metrics),
            figures: metrics.iter().flat_map(|metric| metric.figures()).collect(),
            picture_titles: picture_titles(&metrics),
            mean: mean_of(scored.iter().map(|view| &view.scores)),
            least_gain: least_gain.flatten(),
            near_references: near,
            views: scored,
        };
        context.write_json(METRICS_FILE, &found)?;
        let words = metrics.iter().filter_map(|metric| metric.in_words(&found.mean));
        let views = artifact::counted(found.views.len(), "view");
        context.write_summary(&words.chain([views]).collect::<Vec<_>>().join(" · "))
    }
}

fn picture_titles(metrics: &[Box<dyn Metric>]) -> BTreeMap<String, String> {
    let titled = metrics.iter().filter_map(|metric| Some((metric.name(), metric.picture_title()?)));
    titled.map(|(name, title)| (name.to_owned(), title.to_owned())).collect()
}

/// Scores a view by every metric, and writes its error map and what pictures they made.
fn score(
    context: &Context,
    params: &Params,
    metrics: &[Box<dyn Metric>],
    view: &ScoredView<'_>,
) -> anyhow::Result<ViewScores> {
    let name = &view.true_view.camera.name;
    let error_map = format!("errors/{name}.png");
    if let Some((found, expected)) = view.shown() {
        let drawn = draw_error(found, expected, params.error_range as f32);
        write_png(&context.output_path(&error_map)?, &drawn)?;
    }
    let (mut scores, mut pictures) = (Scores::new(), BTreeMap::new());
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

/// Mean absolute error of the three channels as a colour.
fn draw_error(found: &Image, expected: &Image, range: f32) -> Rgba8 {
    let pairs = found.data.chunks_exact(3).zip(expected.data.chunks_exact(3));
    let data = pairs.flat_map(|(a, b)| {
        let error = a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f32>() / 3.0;
        let [r, g, b] = heat(Palette::Error, error / range);
        [r, g, b, 255]
    });
    Rgba8::new(found.width, found.height, data.collect())
}

fn conventions(
    params: &Params,
    scene: &ScoredScene<'_>,
    metrics: &[Box<dyn Metric>],
) -> BTreeMap<String, String> {
    let on = match scene.truth.background {
        Background::Black => "black",
        Background::White | Background::Alpha => "white",
        Background::Opaque => "none: the pictures are opaque",
    };
    let range = params.error_range;
    let error_maps = format!("mean absolute error of R, G, B; brightest at {range}");
    let of_metrics = metrics.iter().map(|metric| (metric.name(), metric.convention(scene)));
    [("background", on.to_owned()), ("error_maps", error_maps)]
        .into_iter()
        .chain(of_metrics)
        .map(|(name, text)| (name.to_owned(), text))
        .collect()
}

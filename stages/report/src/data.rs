use std::collections::BTreeMap;

use artifact::RunNode;
use metrics::ERROR_MAP_RANGE;
use radiance::{TRAINING_FILE, TrainingLog};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::Context;

use crate::gather::{Report, Row};
use crate::heading::read_json;
use crate::layers::{Group, Layer, layers, max_pixels};
use crate::pictures::{Picture, Request, write_pictures};
use crate::scale::Scale;
use crate::tables::definition;

/// Parameters of `report`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Maximum number of views with pictures, spread evenly over the test views. A page with many
    /// results has pictures of fewer views.
    #[schemars(range(min = 1, max = 1000))]
    pub views: u32,
    /// Name of the view that the page displays first.
    #[schemars(extend("x-default" = "the first"))]
    pub compare: Option<String>,
    /// Square to which the page zooms at first: x and y of its upper left corner, and its side, in
    /// pixels of the displayed view.
    #[schemars(extend("x-default" = "the whole view"))]
    pub crop: Option<[u32; 3]>,
}

impl Default for Params {
    fn default() -> Self {
        Self { views: 50, compare: None, crop: None }
    }
}

/// Input of the page's script.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Data {
    /// Names of the data sets.
    scenes: Vec<String>,
    views: Vec<ViewData>,
    figures: Vec<FigureData>,
    rows: Vec<RowData>,
    layers: Vec<LayerData>,
    pub(crate) pictures: Vec<Picture>,
    scales: Vec<Scale>,
    curves: Vec<Curve>,
    /// Index of the best row.
    best: Option<usize>,
    /// Index of the view shown first.
    view: usize,
    /// Square to which the page zooms at first: x, y and side, in pixels of the displayed view.
    crop: Option<[u32; 3]>,
}

#[derive(Serialize)]
struct ViewData {
    name: String,
    scene: usize,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct FigureData {
    label: String,
    digits: usize,
    higher_is_better: Option<bool>,
    /// Definition of the figure; empty if unknown.
    definition: String,
}

#[derive(Serialize)]
struct RowData {
    label: String,
    scene: usize,
    training: f64,
    rendering: f64,
    axes: BTreeMap<String, String>,
    /// Mean of each figure.
    mean: Vec<Option<f64>>,
    /// Figures of each of the page's views; `None` for views without scores.
    scores: Vec<Option<Vec<Option<f64>>>>,
}

#[derive(Serialize)]
struct LayerData {
    label: String,
    group: String,
    kind: String,
    scene: usize,
    rows: Vec<usize>,
    scale: Option<usize>,
}

/// Training PSNR as a function of the number of rays.
#[derive(Serialize)]
struct Curve {
    label: String,
    /// Pairs of rays and PSNR.
    points: Vec<[f64; 2]>,
}

/// Maximum number of a page's pictures (docs/design/041).
const MAX_PICTURES: u64 = 1500;
/// Maximum number of pixels of all pictures, which bounds the time to write them (docs/design/041).
const MAX_PIXELS: u64 = 250_000_000;

impl Data {
    /// Writes the pictures' originals next to the page and collects the script's input, with copies
    /// of at most `budget` bytes.
    pub(crate) fn new(
        context: &Context,
        report: &Report<'_>,
        params: &Params,
        budget: usize,
    ) -> anyhow::Result<Self> {
        let layers = layers(report)?;
        let mut views = Vec::new();
        let mut depth_ranges = Vec::new();
        let mut requests = Vec::new();
        for (scene, scene_views) in report.scenes.iter().enumerate() {
            let first = views.len();
            for name in &scene_views.views {
                views.push(ViewData { name: name.clone(), scene });
            }
            let chosen = choose_views(report, &layers, scene, params);
            let mut ranges = Vec::new();
            for layer in layers.iter().filter(|layer| layer.scene == scene) {
                let names = chosen.iter().map(|&view| &scene_views.views[view]);
                ranges.extend(layer.depth_range(names)?);
            }
            let depths = pixels::common_range(ranges).unwrap_or((0.0, 1.0));
            depth_ranges.push(depths);
            for &view in &chosen {
                let name = scene_views.views[view].as_str();
                for (layer, _) in layers.iter().enumerate().filter(|(_, l)| l.scene == scene) {
                    requests.push(Request { view: first + view, name, layer, depths });
                }
            }
        }
        let pictures = write_pictures(context, &layers, &requests, budget)?;
        let requested = requested_view(params, &views).unwrap_or_else(|note| {
            context.log_line(note);
            None
        });
        let requested = requested.filter(|view| pictures.iter().any(|p| p.view == *view));
        let first = pictures.first().map_or(0, |picture| picture.view);
        let (layer_data, scales) = layer_data(report, &layers, &depth_ranges);
        Ok(Self {
            scenes: report.scenes.iter().map(|scene| scene.data_set.clone()).collect(),
            view: requested.unwrap_or(first),
            crop: params.crop,
            best: report.best_row(),
            figures: figures(report),
            rows: report.rows.iter().map(|row| row_data(report, row)).collect(),
            layers: layer_data,
            scales,
            curves: report.run.nodes.iter().filter_map(curve).collect(),
            pictures,
            views,
        })
    }

    /// Returns JSON without `<`, so that no tag begins in it.
    pub(crate) fn to_json(&self) -> anyhow::Result<String> {
        Ok(serde_json::to_string(self)?.replace('<', "\\u003c"))
    }
}

/// Returns the index of the view that the page should display first, if any. Fails with a log line
/// if there is no such view.
fn requested_view(params: &Params, views: &[ViewData]) -> Result<Option<usize>, String> {
    let Some(name) = &params.compare else { return Ok(None) };
    let index = views.iter().position(|view| view.name == *name);
    index.map(Some).ok_or_else(|| {
        let known = artifact::known_names(name, views.iter().map(|view| view.name.as_str()));
        format!("parameter compare: no view {name}; {known}")
    })
}

/// Chooses the views of a data set that get pictures: spread evenly, including the requested view.
fn choose_views(
    report: &Report<'_>,
    layers: &[Layer<'_>],
    scene: usize,
    params: &Params,
) -> Vec<usize> {
    let layer_count = layers.iter().filter(|layer| layer.scene == scene).count() as u64;
    let views = &report.scenes[scene].views;
    if layer_count == 0 || views.is_empty() {
        return Vec::new();
    }
    let scenes = report.scenes.len() as u64;
    let by_pixels = MAX_PIXELS / (scenes * layer_count * max_pixels(layers, scene));
    let limit = (MAX_PICTURES / (scenes * layer_count)).min(by_pixels).max(1);
    let count = limit.min(u64::from(params.views)).min(views.len() as u64) as usize;
    let mut chosen: Vec<usize> = (0..count).map(|k| k * views.len() / count).collect();
    let requested = params.compare.as_ref().and_then(|name| views.iter().position(|v| v == name));
    if let Some(requested) = requested.filter(|view| !chosen.contains(view)) {
        chosen[0] = requested;
        chosen.sort_unstable();
    }
    chosen
}

/// Returns the layers' data and their distinct scales; `depths` has the range of each data set.
fn layer_data(
    report: &Report<'_>,
    layers: &[Layer<'_>],
    depths: &[(f32, f32)],
) -> (Vec<LayerData>, Vec<Scale>) {
    let mut data = Vec::with_capacity(layers.len());
    let mut scales: Vec<Scale> = Vec::new();
    for layer in layers {
        let scale = match (&layer.group, layer.rows.first().map(|&row| &report.rows[row])) {
            (Group::Depth, _) => Some(Scale::depth(depths[layer.scene])),
            // Without HR truth, error maps show errors at LR.
            (Group::Error, Some(row)) => {
                Some(Scale::error(ERROR_MAP_RANGE, !row.metrics.has_hr_truth()))
            }
            _ => None,
        };
        let index = scale.map(|scale| {
            scales.iter().position(|other| *other == scale).unwrap_or_else(|| {
                scales.push(scale);
                scales.len() - 1
            })
        });
        data.push(LayerData {
            label: layer.label.clone(),
            group: layer.group.heading().to_owned(),
            kind: layer.group.kind(),
            scene: layer.scene,
            rows: layer.rows.clone(),
            scale: index,
        });
    }
    (data, scales)
}

fn figures(report: &Report<'_>) -> Vec<FigureData> {
    let mut figures = Vec::new();
    for figure in report.known_figures() {
        let definition = definition(report, figure).map_or("", |(_, text)| text).to_owned();
        let (label, digits) = (figure.label.clone(), figure.digits);
        let higher_is_better = figure.higher_is_better;
        figures.push(FigureData { label, digits, higher_is_better, definition });
    }
    figures
}

fn row_data(report: &Report<'_>, row: &Row<'_>) -> RowData {
    let known = report.known_figures();
    let mut scores = Vec::new();
    for (scene, scene_views) in report.scenes.iter().enumerate() {
        for name in &scene_views.views {
            let view = row.view(name).filter(|_| scene == row.scene);
            scores.push(view.map(|v| known.iter().map(|f| f.value_in(&v["scores"])).collect()));
        }
    }
    RowData {
        label: row.label.clone(),
        scene: row.scene,
        training: row.training,
        rendering: row.rendering,
        axes: row.node.values.clone(),
        mean: known.iter().map(|figure| row.mean(figure)).collect(),
        scores,
    }
}

/// Returns the training curve of an artifact that has one.
fn curve(node: &RunNode) -> Option<Curve> {
    let log: TrainingLog = read_json(node, TRAINING_FILE)?;
    let points: Vec<[f64; 2]> = log.curve.iter().map(|p| [p.rays as f64, p.psnr]).collect();
    let label = artifact::label(&node.stage, &node.point);
    (points.len() > 1).then_some(Curve { label, points })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_view_is_reported() {
        let views = ["r_0", "r_1"].map(|name| ViewData { name: name.to_owned(), scene: 0 });
        for (compare, expected) in [
            (None, Ok(None)),
            (Some("r_1"), Ok(Some(1))),
            (Some("nosuch"), Err("parameter compare: no view nosuch; known: r_0, r_1".to_owned())),
        ] {
            let compare = compare.map(str::to_owned);
            let params = Params { compare, ..Params::default() };
            assert_eq!(requested_view(&params, &views), expected);
        }
    }
}

use std::collections::BTreeMap;

use artifact::RunNode;
use serde::Serialize;
use serde_json::Value;
use stage::Context;

use crate::figures::is_known;
use crate::gather::Report;
use crate::layers::{Group, Layer, layers, pixels_of};
use crate::params::Params;
use crate::pictures::{Picture, Wanted, pictures};
use crate::row::Row;
use crate::scale::Scale;

/// What the page's script works on.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Data {
    /// Data sets.
    scenes: Vec<String>,
    views: Vec<ViewData>,
    figures: Vec<FigureData>,
    rows: Vec<RowData>,
    layers: Vec<LayerData>,
    pub(crate) pictures: Vec<PictureData>,
    scales: Vec<Scale>,
    curves: Vec<Curve>,
    /// The best row.
    best: Option<usize>,
    /// The view shown first, and the square of it, in its pixels, that pages show side by side.
    view: usize,
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
}

#[derive(Serialize)]
struct RowData {
    label: String,
    scene: usize,
    training: f64,
    rendering: f64,
    axes: BTreeMap<String, String>,
    /// Means, by figure.
    mean: Vec<Option<f64>>,
    /// By view of the page and figure; none for views without scores.
    scores: Vec<Option<Vec<Option<f64>>>>,
}

#[derive(Serialize)]
struct LayerData {
    label: String,
    group: String,
    kind: String,
    scene: usize,
    row: Option<usize>,
    scale: Option<usize>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct PictureData {
    pub(crate) view: usize,
    layer: usize,
    width: usize,
    height: usize,
    shown_width: usize,
    pub(crate) original: String,
    uri: String,
}

/// A training's PSNR against rays.
#[derive(Serialize)]
struct Curve {
    label: String,
    points: Vec<[f64; 2]>,
}

/// Pictures of a page at most, and their pixels: more than anybody looks at take long to write.
const MAX_PICTURES: u64 = 1500;
const MAX_PIXELS: u64 = 250_000_000;

impl Data {
    /// With originals beside the page, and copies of them of at most `budget` bytes.
    pub(crate) fn new(
        context: &Context,
        report: &Report<'_>,
        params: &Params,
        budget: usize,
    ) -> anyhow::Result<Self> {
        let layers = layers(report)?;
        let mut views = Vec::new();
        let mut scales = Scales::default();
        let mut wanted = Vec::new();
        for (scene, of_scene) in report.scenes.iter().enumerate() {
            let first = views.len();
            let to_view = |name: &String| ViewData { name: name.clone(), scene };
            views.extend(of_scene.views.iter().map(to_view));
            let chosen = chosen(report, &layers, scene, params);
            let names = || chosen.iter().map(|&view| &of_scene.views[view]);
            let mut ranges = Vec::new();
            for layer in layers.iter().filter(|layer| layer.scene == scene) {
                ranges.extend(layer.depth_range(names())?);
            }
            let depths = pixels::common_range(ranges).unwrap_or((0.0, 1.0));
            scales.add_scene(report, &layers, scene, depths);
            for &view in &chosen {
                let name = of_scene.views[view].as_str();
                let of_view = layers.iter().enumerate().filter(|(_, layer)| layer.scene == scene);
                wanted.extend(of_view.map(|(layer, _)| Wanted {
                    view: first + view,
                    name,
                    layer,
                    depths,
                }));
            }
        }
        let pictures = pictures(context, &layers, &wanted, budget)?;
        let is_pictured = |view: &usize| pictures.iter().any(|picture| picture.view == *view);
        let named = |name: &String| views.iter().position(|view| view.name == *name);
        let view = params.compare.as_ref().and_then(named).filter(is_pictured);
        let first = pictures.first().map_or(0, |picture| picture.view);
        Ok(Self {
            scenes: report.scenes.iter().map(|scene| scene.data_set.clone()).collect(),
            view: view.unwrap_or(first),
            crop: params.crop,
            best: report
                .best()
                .and_then(|best| report.rows.iter().position(|r| r.index == best.index)),
            figures: figures(report),
            rows: report.rows.iter().map(|row| row_data(report, row)).collect(),
            layers: scales.layer_data(&layers),
            scales: scales.all,
            curves: curves(&report.run.nodes),
            pictures: pictures.into_iter().map(PictureData::from).collect(),
            views,
        })
    }

    /// As JSON that a page can hold: no tag begins in it.
    pub(crate) fn to_json(&self) -> anyhow::Result<String> {
        Ok(serde_json::to_string(self)?.replace('<', "\\u003c"))
    }
}

impl From<Picture> for PictureData {
    fn from(picture: Picture) -> Self {
        let Picture { view, layer, width, height, shown_width, original, uri } = picture;
        Self { view, layer, width, height, shown_width, original, uri }
    }
}

/// The views of a data set that are pictured: spread evenly, the one asked for among them.
fn chosen(report: &Report<'_>, layers: &[Layer<'_>], scene: usize, params: &Params) -> Vec<usize> {
    let of_scene = layers.iter().filter(|layer| layer.scene == scene).count() as u64;
    let views = &report.scenes[scene].views;
    if of_scene == 0 || views.is_empty() {
        return Vec::new();
    }
    let scenes = report.scenes.len() as u64;
    let by_pixels = MAX_PIXELS / (scenes * of_scene * pixels_of(layers, scene));
    let room = (MAX_PICTURES / (scenes * of_scene)).min(by_pixels).max(1);
    let count = room.min(u64::from(params.views)).min(views.len() as u64) as usize;
    let mut chosen: Vec<usize> = (0..count).map(|k| k * views.len() / count).collect();
    let asked = params.compare.as_ref().and_then(|name| views.iter().position(|v| v == name));
    if let Some(asked) = asked.filter(|asked| !chosen.contains(asked)) {
        chosen[0] = asked;
        chosen.sort_unstable();
    }
    chosen
}

/// Scales of a page, each once, and which layer has which.
#[derive(Default)]
struct Scales {
    all: Vec<Scale>,
    of_layer: BTreeMap<usize, usize>,
}

impl Scales {
    fn add_scene(
        &mut self,
        report: &Report<'_>,
        layers: &[Layer<'_>],
        scene: usize,
        depths: (f32, f32),
    ) {
        for (index, layer) in layers.iter().enumerate().filter(|(_, layer)| layer.scene == scene) {
            let scale = match (&layer.group, layer.row.map(|row| &report.rows[row])) {
                (Group::Depth, _) => Scale::depth(depths),
                (Group::Error, Some(row)) => error_scale(row),
                _ => continue,
            };
            let place = self.all.iter().position(|other| *other == scale).unwrap_or_else(|| {
                self.all.push(scale);
                self.all.len() - 1
            });
            self.of_layer.insert(index, place);
        }
    }

    fn layer_data(&self, layers: &[Layer<'_>]) -> Vec<LayerData> {
        let data = layers.iter().enumerate().map(|(index, layer)| LayerData {
            label: layer.label.clone(),
            group: layer.group.heading().to_owned(),
            kind: layer.group.kind(),
            scene: layer.scene,
            row: layer.row,
            scale: self.of_layer.get(&index).copied(),
        });
        data.collect()
    }
}

/// Without HR truth, error maps show errors at LR.
fn error_scale(row: &Row<'_>) -> Scale {
    let range = row.node.parameters.get("error_range").and_then(Value::as_f64);
    Scale::error(range.unwrap_or(0.25), !row.metrics.has_hr_truth())
}

fn figures(report: &Report<'_>) -> Vec<FigureData> {
    let known = report.figures.iter().filter(|figure| is_known(figure, &report.rows));
    known
        .map(|figure| FigureData {
            label: figure.label.clone(),
            digits: figure.digits,
            higher_is_better: figure.higher_is_better,
        })
        .collect()
}

fn row_data(report: &Report<'_>, row: &Row<'_>) -> RowData {
    let known = || report.figures.iter().filter(|figure| is_known(figure, &report.rows));
    let views = report.scenes.iter().enumerate();
    let views = views.flat_map(|(scene, views)| views.views.iter().map(move |name| (scene, name)));
    let scores = views.map(|(scene, name)| {
        let view = row.view(name).filter(|_| scene == row.scene)?;
        Some(known().map(|figure| figure.of(&view["scores"])).collect())
    });
    RowData {
        label: row.label.clone(),
        scene: row.scene,
        training: row.training,
        rendering: row.rendering,
        axes: row.node.values.clone(),
        mean: known().map(|figure| row.mean(figure)).collect(),
        scores: scores.collect(),
    }
}

/// Curves of all trainings that left one.
fn curves(nodes: &[RunNode]) -> Vec<Curve> {
    nodes.iter().filter_map(curve).collect()
}

fn curve(node: &RunNode) -> Option<Curve> {
    let text = std::fs::read_to_string(node.folder.join("training.json")).ok()?;
    let log: Value = serde_json::from_str(&text).ok()?;
    let point = |point: &Value| Some([point["rays"].as_f64()?, point["psnr"].as_f64()?]);
    let points: Vec<_> = log["curve"].as_array()?.iter().filter_map(point).collect();
    let label = artifact::label(&node.stage, &node.point);
    (points.len() > 1).then_some(Curve { label, points })
}

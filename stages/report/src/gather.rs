use std::cmp::Ordering;

use artifact::{RunNode, RunRecord};
use metrics::{AnyMetrics, ScoreFormat};
use scene::Views;
use serde_json::Value;

use crate::results::scored_nodes;
use crate::unscored::{UnscoredViews, unscored_nodes};

/// Content of a page: results, data sets and figures of a run.
pub(crate) struct Report<'a> {
    pub(crate) run: &'a RunRecord,
    /// Results, sorted by the number of their ancestors.
    pub(crate) rows: Vec<Row<'a>>,
    /// Data sets with scored or unscored views, in the rows' order.
    pub(crate) scenes: Vec<SceneViews>,
    /// Figures of the results: kinds of scores, such as PSNR.
    pub(crate) figures: Vec<ScoreFormat>,
    /// Views that a failed run has made but not scored.
    pub(crate) unscored: Vec<UnscoredViews>,
    /// Reasons why results can't be read.
    pub(crate) unreadable: Vec<String>,
}

/// Views of a data set.
pub(crate) struct SceneViews {
    /// Folder or block of the data set.
    pub(crate) data_set: String,
    /// Names of the views, in the order of the scores.
    pub(crate) views: Vec<String>,
}

/// Scores of the views that one method rendered: a result, and a row of the tables.
pub(crate) struct Row<'a> {
    pub(crate) node: &'a RunNode,
    /// Content of `metrics.json`.
    pub(crate) metrics: AnyMetrics,
    /// Name that is unique among the rows.
    pub(crate) label: String,
    /// Index of the data set in [`Report::scenes`].
    pub(crate) scene: usize,
    /// Seconds of training.
    pub(crate) training: f64,
    /// Seconds of rendering, refinement included.
    pub(crate) rendering: f64,
}

impl Row<'_> {
    /// Returns the mean of a figure over the views.
    pub(crate) fn mean(&self, figure: &ScoreFormat) -> Option<f64> {
        figure.value_in(self.metrics.mean())
    }

    /// Returns the scores of a view.
    pub(crate) fn view(&self, name: &str) -> Option<&Value> {
        self.metrics.views().iter().find(|view| view["name"] == name)
    }

    /// Returns the number of views.
    pub(crate) fn view_count(&self) -> usize {
        self.metrics.views().len()
    }
}

impl<'a> Report<'a> {
    /// Reads the scores of a run.
    pub(crate) fn new(run: &'a RunRecord) -> Self {
        let mut report = Self {
            run,
            rows: vec![],
            scenes: vec![],
            figures: vec![],
            unscored: vec![],
            unreadable: vec![],
        };
        for (index, node) in scored_nodes(run) {
            match AnyMetrics::read(&node.folder) {
                Ok(metrics) => report.add(index, node, metrics),
                Err(error) => report.unreadable.push(error.to_string()),
            }
        }
        for index in unscored_nodes(run) {
            let Ok(views) = Views::read_folder(&run.nodes[index].folder) else { continue };
            let scene = report.scene(index);
            report.add_views(scene, views.views.iter().map(|view| view.camera.name.as_str()));
            report.unscored.push(UnscoredViews::new(run, index, scene));
        }
        report.figures = figures(&report.rows);
        report.label_rows();
        report
    }

    /// Returns the index of a node's data set, which is added if it is new.
    fn scene(&mut self, node: usize) -> usize {
        let data_set = self.run.data_set(node);
        let scene = self.scenes.iter().position(|scene| scene.data_set == data_set);
        scene.unwrap_or_else(|| {
            self.scenes.push(SceneViews { data_set, views: Vec::new() });
            self.scenes.len() - 1
        })
    }

    /// Adds the views of a data set that are new.
    fn add_views<'v>(&mut self, scene: usize, names: impl Iterator<Item = &'v str>) {
        let views = &mut self.scenes[scene].views;
        for name in names {
            if !views.iter().any(|view| view == name) {
                views.push(name.to_owned());
            }
        }
    }

    /// Adds a result, and its data set and views if they are new.
    fn add(&mut self, index: usize, node: &'a RunNode, metrics: AnyMetrics) {
        let scene = self.scene(index);
        self.add_views(scene, metrics.views().iter().filter_map(|view| view["name"].as_str()));
        // 0 is added because the sum of nothing is -0.
        let [training, rendering] = self
            .run
            .training_and_rendering(index)
            .map(|nodes| nodes.iter().map(|&i| self.run.nodes[i].seconds).sum::<f64>() + 0.0);
        let label = String::new();
        self.rows.push(Row { node, metrics, label, scene, training, rendering });
    }

    /// Labels rows by their values in the sweep and, without a sweep or if several blocks score, by
    /// the scored method.
    fn label_rows(&mut self) {
        let methods: Vec<(String, &str)> = (self.rows.iter())
            .map(|row| (method(self.run, row.node), row.node.stage.as_str()))
            .collect();
        let has_blocks = methods.iter().any(|(_, block)| *block != methods[0].1);
        for (row, (own, block)) in self.rows.iter_mut().zip(&methods) {
            // Two blocks may score views of the same method.
            let is_shared = methods.iter().any(|other| other.0 == *own && other.1 != *block);
            let method = if is_shared { block } else { own.as_str() };
            row.label = match (has_blocks, row.node.point.as_str()) {
                (_, "") => method.to_owned(),
                (false, point) => point.to_owned(),
                (true, point) => format!("{method}, {point}"),
            };
        }
    }

    /// Returns the figure that tells the best row: the first one with values.
    pub(crate) fn main_figure(&self) -> Option<&ScoreFormat> {
        self.known_figures().first().copied()
    }

    /// Returns the index of the row with the best mean of the main figure, the first of equal
    /// ones. Without figures, returns that of the first row.
    pub(crate) fn best_row(&self) -> Option<usize> {
        let figure = self.main_figure();
        let is_lower_better = figure.is_some_and(|f| f.higher_is_better == Some(false));
        let sign = if is_lower_better { -1.0 } else { 1.0 };
        let value = |&row: &usize| Some(sign * self.rows[row].mean(figure?)?);
        // The last of equal ones is the maximum.
        (0..self.rows.len())
            .rev()
            .max_by(|a, b| value(a).partial_cmp(&value(b)).unwrap_or(Ordering::Equal))
    }

    /// Returns the figures of which any row has a value.
    pub(crate) fn known_figures(&self) -> Vec<&ScoreFormat> {
        self.figures.iter().filter(|figure| has_values(figure, &self.rows)).collect()
    }
}

/// True if any row has a value of a figure.
pub(crate) fn has_values(figure: &ScoreFormat, rows: &[Row<'_>]) -> bool {
    rows.iter().any(|row| row.mean(figure).is_some())
}

/// True if a row has the best value of a figure among the rows of its data set; false if the data
/// set has only this row.
pub(crate) fn is_best(figure: &ScoreFormat, row: &Row<'_>, rows: &[Row<'_>]) -> bool {
    let rivals: Vec<&Row<'_>> = rows.iter().filter(|other| other.scene == row.scene).collect();
    let values = rivals.iter().filter_map(|row| row.mean(figure));
    let best = match figure.higher_is_better {
        _ if rivals.len() < 2 => None,
        Some(true) => values.reduce(f64::max),
        Some(false) => values.reduce(f64::min),
        None => None,
    };
    best.is_some() && row.mean(figure) == best
}

/// Returns the figures that the rows' metrics declare, if they have values or a text for a missing
/// value. Metrics without declared figures have one for each number among their means.
fn figures(rows: &[Row<'_>]) -> Vec<ScoreFormat> {
    let mut figures: Vec<ScoreFormat> = Vec::new();
    for row in rows {
        let declared = row.metrics.figures();
        for figure in declared.unwrap_or_else(|| numbers(row.metrics.mean())) {
            if figures.iter().all(|other| other.path != figure.path) {
                figures.push(figure);
            }
        }
    }
    figures.retain(|figure| figure.missing.is_some() || has_values(figure, rows));
    figures
}

/// Returns a figure for each number of an object.
fn numbers(mean: &Value) -> Vec<ScoreFormat> {
    let entries = mean.as_object().into_iter().flatten().filter(|(_, value)| value.is_number());
    entries
        .map(|(name, _)| ScoreFormat {
            path: name.clone(),
            label: name.clone(),
            digits: 4,
            higher_is_better: None,
            missing: None,
        })
        .collect()
}

/// Names the method that a block scores: by the block (`eval-hr`: hr), or as the work of the stage
/// that made the views (`render-depth`: rendered).
fn method(run: &RunRecord, scored: &RunNode) -> String {
    if let Some(method) = scored.stage.strip_prefix("eval-") {
        return method.to_owned();
    }
    let views = scored.inputs.get("views").and_then(|input| run.nodes.get(input.node?));
    views.map_or_else(|| scored.stage.clone(), views_label)
}

/// Returns what a stage has done with the views of its artifact, such as "rendered".
pub(crate) fn views_label(node: &RunNode) -> String {
    match node.program.as_str() {
        "render-depth" => "rendered".to_owned(),
        "refine" => "refined".to_owned(),
        "upsample" => "enlarged".to_owned(),
        _ => node.stage.clone(),
    }
}

use serde::Deserialize;
use serde_json::Value;

use crate::page::Point;

/// A figure of the scores, and how its metric says that it is shown.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub(crate) struct Figure {
    /// Its place among the scores: keys from the outermost on, `/` between them.
    pub(crate) path: String,
    pub(crate) label: String,
    pub(crate) digits: usize,
    /// Whether more of it is better; none where the metrics don't say.
    pub(crate) higher_is_better: Option<bool>,
    /// What stands where it is missing.
    pub(crate) missing: Option<String>,
}

impl Figure {
    /// The mean over a point's views.
    pub(crate) fn mean(&self, point: &Point<'_>) -> Option<f64> {
        self.of(&point.metrics["mean"])
    }

    /// Among scores.
    pub(crate) fn of(&self, scores: &Value) -> Option<f64> {
        scores.pointer(&format!("/{}", self.path))?.as_f64()
    }

    /// In words.
    pub(crate) fn text(&self, value: f64) -> String {
        format!("{value:.*}", self.digits)
    }

    /// Whether it is a point's best. One point alone has none.
    pub(crate) fn is_best(&self, value: f64, points: &[Point<'_>]) -> bool {
        let values = || points.iter().filter_map(|point| self.mean(point));
        match self.higher_is_better {
            _ if points.len() < 2 => false,
            Some(true) => value == values().fold(f64::NEG_INFINITY, f64::max),
            Some(false) => value == values().fold(f64::INFINITY, f64::min),
            None => false,
        }
    }
}

/// The figures that points have, or that would be there with more inputs: as their metrics say it, and
/// of metrics that say nothing the numbers among their means.
pub(crate) fn figures(points: &[Point<'_>]) -> Vec<Figure> {
    let mut figures: Vec<Figure> = Vec::new();
    for point in points {
        let said = serde_json::from_value::<Vec<Figure>>(point.metrics["figures"].clone());
        for figure in said.unwrap_or_else(|_| numbers(&point.metrics["mean"])) {
            if figures.iter().all(|other| other.path != figure.path) {
                figures.push(figure);
            }
        }
    }
    let is_shown = |f: &Figure| f.missing.is_some() || points.iter().any(|p| f.mean(p).is_some());
    figures.retain(is_shown);
    figures
}

/// The numbers of an object, by their names.
fn numbers(mean: &Value) -> Vec<Figure> {
    let entries = mean.as_object().into_iter().flatten().filter(|(_, value)| value.is_number());
    entries
        .map(|(name, _)| Figure {
            path: name.clone(),
            label: name.clone(),
            digits: 4,
            higher_is_better: None,
            missing: None,
        })
        .collect()
}

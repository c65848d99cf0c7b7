use serde::Deserialize;
use serde_json::Value;

use crate::row::Row;

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
    /// The mean over a row's views.
    pub(crate) fn mean(&self, row: &Row<'_>) -> Option<f64> {
        self.of(&row.metrics["mean"])
    }

    /// Among scores.
    pub(crate) fn of(&self, scores: &Value) -> Option<f64> {
        scores.pointer(&format!("/{}", self.path))?.as_f64()
    }

    /// Whether some row has it.
    pub(crate) fn is_known(&self, rows: &[Row<'_>]) -> bool {
        rows.iter().any(|row| self.mean(row).is_some())
    }

    /// In words.
    pub(crate) fn text(&self, value: f64) -> String {
        format!("{value:.*}", self.digits)
    }

    /// Whether a row has the best of it among those of its data set. One row alone has none.
    pub(crate) fn is_best(&self, row: &Row<'_>, rows: &[Row<'_>]) -> bool {
        let others = || rows.iter().filter(|other| other.scene == row.scene);
        let values = || others().filter_map(|row| self.mean(row));
        let best = match self.higher_is_better {
            _ if others().count() < 2 => None,
            Some(true) => values().reduce(f64::max),
            Some(false) => values().reduce(f64::min),
            None => None,
        };
        best.is_some() && self.mean(row) == best
    }
}

/// The figures that rows have, or that would be there with more inputs: as their metrics say it, and
/// of metrics that say nothing the numbers among their means.
pub(crate) fn figures(rows: &[Row<'_>]) -> Vec<Figure> {
    let mut figures: Vec<Figure> = Vec::new();
    for row in rows {
        let said = serde_json::from_value::<Vec<Figure>>(row.metrics["figures"].clone());
        for figure in said.unwrap_or_else(|_| numbers(&row.metrics["mean"])) {
            if figures.iter().all(|other| other.path != figure.path) {
                figures.push(figure);
            }
        }
    }
    let is_shown = |f: &Figure| f.missing.is_some() || rows.iter().any(|r| f.mean(r).is_some());
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

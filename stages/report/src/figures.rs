use metrics::Figure;
use serde_json::Value;

use crate::row::Row;

/// Whether some row has a figure.
pub(crate) fn is_known(figure: &Figure, rows: &[Row<'_>]) -> bool {
    rows.iter().any(|row| row.mean(figure).is_some())
}

/// Whether a row has the best of a figure among those of its data set. One row alone has none.
pub(crate) fn is_best(figure: &Figure, row: &Row<'_>, rows: &[Row<'_>]) -> bool {
    let others = || rows.iter().filter(|other| other.scene == row.scene);
    let values = || others().filter_map(|row| row.mean(figure));
    let best = match figure.higher_is_better {
        _ if others().count() < 2 => None,
        Some(true) => values().reduce(f64::max),
        Some(false) => values().reduce(f64::min),
        None => None,
    };
    best.is_some() && row.mean(figure) == best
}

/// The figures that rows have, or that would be there with more inputs: as their metrics say it,
/// and of metrics that say nothing the numbers among their means.
pub(crate) fn figures(rows: &[Row<'_>]) -> Vec<Figure> {
    let mut figures: Vec<Figure> = Vec::new();
    for row in rows {
        let said = row.metrics.figures();
        for figure in said.unwrap_or_else(|| numbers(row.metrics.mean())) {
            if figures.iter().all(|other| other.path != figure.path) {
                figures.push(figure);
            }
        }
    }
    figures.retain(|figure| figure.missing.is_some() || is_known(figure, rows));
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

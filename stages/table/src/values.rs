//! Values of rows by their names: means, combinations, and what rows have in common.

use contract::plain;
use serde_json::{Map, Value};

/// A result: its keys (axes of the run, `method`), then its values, by name.
pub type Row = Map<String, Value>;

/// Combinations of values that keys have, in the order of the rows; a single empty one without
/// keys.
pub(crate) fn distinct(rows: &[Row], keys: &[String]) -> Vec<Vec<String>> {
    let mut found: Vec<Vec<String>> = Vec::new();
    for row in rows {
        let values = keys.iter().map(|key| row.get(key).map(plain).unwrap_or_default()).collect();
        if !found.contains(&values) {
            found.push(values);
        }
    }
    if found.is_empty() && keys.is_empty() { vec![Vec::new()] } else { found }
}

/// The rows whose keys have these values.
pub(crate) fn of(rows: &[Row], keys: &[String], values: &[String]) -> Vec<Row> {
    let fitting = rows.iter().filter(|row| {
        keys.iter()
            .zip(values)
            .all(|(key, value)| row.get(key).map(plain).unwrap_or_default() == *value)
    });
    fitting.cloned().collect()
}

/// The mean of a value over the rows that have it.
pub(crate) fn mean(rows: &[Row], name: &str) -> Option<f64> {
    let values: Vec<f64> = rows.iter().filter_map(|row| row.get(name)?.as_f64()).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// What rows have in common, or all that they have.
pub(crate) fn together(rows: &[Row], name: &str) -> String {
    let with: Vec<Row> = rows.iter().filter(|row| row.contains_key(name)).cloned().collect();
    distinct(&with, &[name.to_owned()]).concat().join(", ")
}

//! Values of rows by name: means, combinations, selections.

use serde_json::{Map, Value};
use stage::plain;

/// A result: keys (axes of the run, `method`) and values, by name.
pub type Row = Map<String, Value>;

/// Returns the combinations of the keys' values, in the order of the rows; without keys, one empty
/// combination.
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

/// Returns the rows whose keys have the given values.
pub(crate) fn select(rows: &[Row], keys: &[String], values: &[String]) -> Vec<Row> {
    let mut selected = rows.to_vec();
    for (key, value) in keys.iter().zip(values) {
        selected.retain(|row| row.get(key).map(plain).unwrap_or_default() == *value);
    }
    selected
}

/// Returns the mean of a value over the rows that have it.
pub(crate) fn mean(rows: &[Row], name: &str) -> Option<f64> {
    let values: Vec<f64> = rows.iter().filter_map(|row| row.get(name)?.as_f64()).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Lists the distinct values that rows have under a name.
pub(crate) fn listed(rows: &[Row], name: &str) -> String {
    let with: Vec<Row> = rows.iter().filter(|row| row.contains_key(name)).cloned().collect();
    distinct(&with, &[name.to_owned()]).concat().join(", ")
}

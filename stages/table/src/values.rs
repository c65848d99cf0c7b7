//! Values of rows by name: means, combinations, selections.

use serde_json::{Map, Value};
use stage::plain;

/// Key of a result's scene.
pub(crate) const SCENE: &str = "scene";
/// Names of a result's provenance, which aren't keys.
pub(crate) const PROVENANCE: [&str; 2] = ["commit", "machine"];
/// Name of the reason why a row has no values.
pub(crate) const MISSING: &str = "missing";

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

/// Returns the scenes of the rows that have a value; an empty name for rows without a scene.
pub(crate) fn scenes(rows: &[Row], name: &str) -> Vec<String> {
    distinct(&with(rows, name), &[SCENE.to_owned()]).concat()
}

/// Returns the rows that have an entry of this name.
fn with(rows: &[Row], name: &str) -> Vec<Row> {
    rows.iter().filter(|row| row.contains_key(name)).cloned().collect()
}

/// Returns the difference between the means of a value over two groups of results, each over the
/// results with a counterpart in the other group: scenes, protocols and seeds are equal, and all
/// other keys but the `compared` ones. A key that only one of both has doesn't count.
pub(crate) fn difference(of: &[Row], over: &[Row], compared: &[&str], name: &str) -> Option<f64> {
    let is_counterpart = |row: &Row, other: &Row| {
        let mut keys = row.iter().filter(|(key, value)| is_key(key, value));
        other.contains_key(name)
            && keys.all(|(key, value)| {
                compared.contains(&key.as_str()) || other.get(key).is_none_or(|o| o == value)
            })
    };
    let paired_mean = |rows: &[Row], others: &[Row]| {
        let mut paired = rows.to_vec();
        paired.retain(|row| others.iter().any(|other| is_counterpart(row, other)));
        mean(&paired, name)
    };
    Some(paired_mean(of, over)? - paired_mean(over, of)?)
}

/// True for an entry that may identify a row: an axis of the run, the method or its group.
pub(crate) fn is_key(name: &str, value: &Value) -> bool {
    value.is_string() && name != MISSING && !PROVENANCE.contains(&name)
}

/// Lists the distinct values that rows have under a name.
pub(crate) fn listed(rows: &[Row], name: &str) -> String {
    distinct(&with(rows, name), &[name.to_owned()]).concat().join(", ")
}

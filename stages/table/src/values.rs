//! Values of rows by name: means, combinations, selections.

use serde_json::{Map, Value};
use stage::plain;

/// Key of a result's scene.
pub(crate) const SCENE: &str = "scene";

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
    let with: Vec<Row> = rows.iter().filter(|row| row.contains_key(name)).cloned().collect();
    distinct(&with, &[SCENE.to_owned()]).concat()
}

/// Returns the difference between the means of a value over two groups of rows, each over the
/// scenes that both groups have. Rows without a scene are compared with all scenes.
pub(crate) fn difference(of: &[Row], over: &[Row], name: &str) -> Option<f64> {
    let scenes = [scenes(of, name), scenes(over, name)];
    let common_mean = |rows: &[Row]| {
        let mut common = rows.to_vec();
        if !scenes.concat().iter().any(String::is_empty) {
            common.retain(|row| {
                let scene = row.get(SCENE).map(plain).unwrap_or_default();
                scenes.iter().all(|scenes| scenes.contains(&scene))
            });
        }
        mean(&common, name)
    };
    Some(common_mean(of)? - common_mean(over)?)
}

/// Lists the distinct values that rows have under a name.
pub(crate) fn listed(rows: &[Row], name: &str) -> String {
    let with: Vec<Row> = rows.iter().filter(|row| row.contains_key(name)).cloned().collect();
    distinct(&with, &[name.to_owned()]).concat().join(", ")
}

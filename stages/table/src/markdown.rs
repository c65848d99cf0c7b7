//! The Markdown document: a table of all rows, a table for each scene, gains, the spread over
//! seeds, and failed points.

use std::collections::BTreeMap;

use artifact::{FailedPoint, Failure, bail_usage, label};

use crate::figures::Figures;
use crate::grid::{Layout, NO_VALUE, markdown_table};
use crate::params::Params;
use crate::rows::{GROUP, method_name};
use crate::values::{Row, SCENE, difference, distinct, is_key, mean, scenes, select};

/// File of [`Document::picture`].
pub(crate) const PICTURE: &str = "front.svg";

/// Tables and their picture.
pub(crate) struct Document {
    /// Markdown, which shows the picture.
    pub(crate) text: String,
    /// All results of the first table by cost and score, as SVG.
    pub(crate) picture: Option<String>,
}

/// Returns the document. Fails if parameters name keys or values that no result has.
pub(crate) fn document(
    params: &Params,
    rows: &[Row],
    figures: &Figures,
    failed: &[FailedPoint],
) -> Result<Document, Failure> {
    let keys = row_keys(params, rows)?;
    let reference = reference(params, rows)?;
    let numbers = rows.iter().flatten().filter(|(_, value)| value.is_number());
    let numbers: Vec<&String> = numbers.map(|(name, _)| name).collect();
    check_names("front", "value", params.front.as_slice(), rows, &numbers)?;
    let is_by_seed = keys == ["seed"];
    let scene = SCENE.to_owned();
    let is_averaged = !keys.contains(&scene) && !params.columns.contains(&scene);
    // A comparison (`relative_to`) has one table, of the means.
    let mut scenes = distinct(rows, std::slice::from_ref(&scene)).concat();
    if !is_averaged || reference.is_some() || scenes.len() < 2 {
        scenes.clear();
    }
    let layout = Layout { params, figures, keys, reference };
    let mut text = format!("# {}\n\n", params.title);
    if !scenes.is_empty() {
        text += &format!("Means over {}:\n\n", scenes.join(", "));
    }
    text += &layout.table(rows, false);
    if layout.reference.as_ref().is_some_and(Vec::is_empty) {
        let named = named_values(&params.relative_to);
        text += &format!("\nNo result has {named}, so nothing is compared.\n");
    }
    let picture = layout.front_picture(rows);
    if picture.is_some() {
        text += &format!("\n![The results by cost and score]({PICTURE})\n");
    }
    for name in scenes {
        let selected = select(rows, std::slice::from_ref(&scene), std::slice::from_ref(&name));
        text += &format!("\n## {name}\n\n{}", layout.table(&selected, true));
    }
    text += &gains(params, rows);
    if is_by_seed {
        text += &spread(rows, figures, params.compared_value()).unwrap_or_default();
    }
    // Points with a reason were excluded on purpose.
    let failed: Vec<&FailedPoint> = failed.iter().filter(|point| point.reason.is_none()).collect();
    if !failed.is_empty() {
        text += "\nFailed, or waiting for a failed stage:\n\n";
        for point in failed {
            text += &format!("* {}\n", label(&point.stage, &point.point));
        }
    }
    Ok(Document { text, picture })
}

/// Returns the keys that identify a row: the given ones, or else all that differ; and the group.
fn row_keys(params: &Params, rows: &[Row]) -> Result<Vec<String>, Failure> {
    let mut known: Vec<&String> = Vec::new();
    for (name, value) in rows.iter().flatten() {
        if is_key(name, value) && !known.contains(&name) {
            known.push(name);
        }
    }
    check_names("rows", "key", &params.rows, rows, &known)?;
    check_names("columns", "key", &params.columns, rows, &known)?;
    let mut keys = params.rows.clone();
    if keys.is_empty() {
        for name in known {
            let differs = distinct(rows, std::slice::from_ref(name)).len() > 1;
            if differs && name != SCENE && !params.columns.contains(name) {
                keys.push(name.clone());
            }
        }
    }
    let group = GROUP.to_owned();
    if !params.groups.is_empty() && !keys.contains(&group) && !params.columns.contains(&group) {
        keys.push(group);
    }
    Ok(keys)
}

/// Fails if a parameter names a key or value that no result has.
fn check_names(
    parameter: &str,
    kind: &str,
    names: &[String],
    rows: &[Row],
    known: &[&String],
) -> Result<(), Failure> {
    for name in names {
        if !rows.is_empty() && !rows.iter().any(|row| row.contains_key(name)) {
            let known = artifact::known_names(name, known.iter().map(|name| name.as_str()));
            bail_usage!("parameter {parameter}: no result has a {kind} {name:?}; {known}");
        }
    }
    Ok(())
}

/// Returns the results that others are compared with; none if the run left them out. Fails if they
/// don't have the compared value.
fn reference(params: &Params, rows: &[Row]) -> Result<Option<Vec<Row>>, Failure> {
    if params.relative_to.is_empty() || rows.is_empty() {
        return Ok(None);
    }
    let (keys, values): (Vec<String>, Vec<String>) = params.relative_to.clone().into_iter().unzip();
    let selected = select(rows, &keys, &values);
    let name = params.compared_value();
    if !selected.is_empty() && mean(&selected, name).is_none() {
        let named = named_values(&params.relative_to);
        bail_usage!("parameter relative_to: no result with {named} has a value {name:?}");
    }
    Ok(Some(selected))
}

fn named_values(values: &BTreeMap<String, String>) -> String {
    let named: Vec<String> = values.iter().map(|(key, value)| format!("{key} = {value}")).collect();
    named.join(", ")
}

/// Returns the table of differences between methods in each column; empty if there are none.
fn gains(params: &Params, rows: &[Row]) -> String {
    let columns = distinct(rows, &params.columns);
    let all = [rows, &params.extra_rows[..]].concat();
    let mut head = vec!["gain".to_owned()];
    for column in &columns {
        head.push(if column.is_empty() { "all".to_owned() } else { column.join(", ") });
    }
    let mut lines = vec![head];
    for gain in &params.gains {
        let mut line = vec![gain.name.clone()];
        for column in &columns {
            let in_column = select(&all, &params.columns, column);
            let [of, over] =
                [&gain.of, &gain.over].map(|block| method_rows(params, &in_column, block));
            let difference = difference(&of, &over, &["method", GROUP], "psnr");
            line.push(difference.map_or(NO_VALUE.to_owned(), |value| format!("{value:+.2}")));
        }
        if line[1..].iter().any(|cell| cell != NO_VALUE) {
            lines.push(line);
        }
    }
    if lines.len() == 1 {
        return String::new();
    }
    format!("\n## Gain, PSNR in dB\n\n{}", markdown_table(&lines))
}

/// Returns the rows of a method: a block, or a method of `extra_rows`.
fn method_rows(params: &Params, rows: &[Row], block: &str) -> Vec<Row> {
    let is_of_method =
        |row: &&Row| row.get("method").is_some_and(|m| *m == method_name(params, block, row));
    rows.iter().filter(is_of_method).cloned().collect()
}

/// Describes the mean, standard deviation, minimum and maximum of a value over the seeds. A seed's
/// value is the mean over all scenes; seeds that lack a scene are left out.
fn spread(rows: &[Row], figures: &Figures, name: &str) -> Option<String> {
    let seed = ["seed".to_owned()];
    let scene_count = scenes(rows, name).len();
    let mut values = Vec::new();
    for key in distinct(rows, &seed) {
        let of_seed = select(rows, &seed, &key);
        values.extend(mean(&of_seed, name).filter(|_| scenes(&of_seed, name).len() == scene_count));
    }
    if values.is_empty() {
        return None;
    }
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let deviation = (squares / values.len().saturating_sub(1).max(1) as f64).sqrt();
    let min = values.iter().copied().fold(f64::INFINITY, f64::min);
    let max = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let title = figures.title(name);
    let [mean, deviation, min, max] =
        [mean, deviation, min, max].map(|value| figures.format(name, value));
    Some(format!(
        "\n{title} over {} results: {mean} ± {deviation}, from {min} to {max}\n",
        values.len()
    ))
}

#[cfg(test)]
#[path = "markdown_tests.rs"]
mod tests;

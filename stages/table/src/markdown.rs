//! Rows as Markdown: a table of all, one of each scene, gains, and what failed.

use artifact::{FailedPoint, Failure, label};

use crate::figures::Figures;
use crate::grid::{NOTHING, PLACES, Shape, grid};
use crate::params::Params;
use crate::rows::MISSING;
use crate::values::{Row, distinct, mean, of};

/// The tables, and the points that failed; a failure where parameters name what no result has.
pub(crate) fn markdown(
    params: &Params,
    rows: &[Row],
    figures: &Figures,
    failed: &[FailedPoint],
) -> Result<String, Failure> {
    let shape =
        Shape { params, figures, keys: row_keys(params, rows)?, first: reference(params, rows)? };
    let each = std::slice::from_ref(&params.each);
    let parts = if params.each.is_empty() { Vec::new() } else { distinct(rows, each).concat() };
    let parts = if parts.len() > 1 { parts } else { Vec::new() };
    let mean = if parts.is_empty() {
        String::new()
    } else {
        format!("Means over {}:\n\n", parts.join(", "))
    };
    let mut text = format!("# {}\n\n{mean}{}", params.title, shape.table(rows, false));
    for part in parts {
        let mine = of(rows, each, std::slice::from_ref(&part));
        text += &format!("\n## {part}\n\n{}", shape.table(&mine, true));
    }
    text += &gains(params, rows);
    let spreads = params.spread.iter().filter_map(|name| spread(rows, figures, name));
    spreads.for_each(|line| text += &line);
    let failed: Vec<&FailedPoint> = failed.iter().filter(|point| point.reason.is_none()).collect();
    if !failed.is_empty() {
        text += "\nFailed, or waiting for what failed:\n\n";
        failed
            .iter()
            .for_each(|point| text += &format!("* {}\n", label(&point.stage, &point.point)));
    }
    if !params.notes.is_empty() {
        text += "\n";
        params.notes.iter().for_each(|note| text += &format!("* {note}\n"));
    }
    Ok(text)
}

/// Keys that make a row: those asked for, or all that differ; and the group.
fn row_keys(params: &Params, rows: &[Row]) -> Result<Vec<String>, Failure> {
    let mut known: Vec<&String> = Vec::new();
    let is_key = |name: &str| ![&PLACES[..], &[MISSING]].concat().contains(&name);
    for (name, _) in rows.iter().flatten().filter(|(name, value)| value.is_string() && is_key(name))
    {
        if !known.contains(&name) {
            known.push(name);
        }
    }
    let each = Some(&params.each).filter(|key| !key.is_empty());
    let asked = [("rows", &params.rows), ("columns", &params.columns)];
    let asked = asked
        .into_iter()
        .flat_map(|(parameter, names)| names.iter().map(move |name| (parameter, name)));
    let mut asked = asked.chain(each.map(|name| ("each", name)));
    if let Some((parameter, name)) =
        asked.find(|(_, name)| !rows.is_empty() && !rows.iter().any(|row| row.contains_key(*name)))
    {
        let known = artifact::known_names(name, known.into_iter().map(String::as_str));
        let problem = format!("parameter {parameter}: no result has a key {name:?}; {known}");
        return Err(Failure::Usage(problem));
    }
    let differs = |name: &String| distinct(rows, std::slice::from_ref(name)).len() > 1;
    let is_row =
        |name: &&String| *name != "scene" && !params.columns.contains(name) && differs(name);
    let mut keys = if params.rows.is_empty() {
        known.into_iter().filter(is_row).cloned().collect()
    } else {
        params.rows.clone()
    };
    if !params.groups.is_empty()
        && !keys.contains(&params.grouped_by)
        && !params.columns.contains(&params.grouped_by)
    {
        keys.push(params.grouped_by.clone());
    }
    Ok(keys)
}

/// The value that others are compared with.
fn reference(params: &Params, rows: &[Row]) -> Result<Option<f64>, Failure> {
    if params.relative_to.is_empty() || rows.is_empty() {
        return Ok(None);
    }
    let (keys, values): (Vec<String>, Vec<String>) = params.relative_to.clone().into_iter().unzip();
    match mean(&of(rows, &keys, &values), params.compared()) {
        Some(value) => Ok(Some(value)),
        None => Err(Failure::Usage(format!(
            "parameter relative_to: no result has {:?}",
            params.relative_to
        ))),
    }
}

/// Differences between methods, in each column.
fn gains(params: &Params, rows: &[Row]) -> String {
    let columns = distinct(rows, &params.columns);
    let all = [rows, &params.further[..]].concat();
    let lines = params.gains.iter().map(|gain| {
        let cells = columns.iter().map(|column| {
            let value = psnr(params, &all, &gain.of, column)?;
            Some(value - psnr(params, &all, &gain.over, column)?)
        });
        (&gain.name, cells.collect::<Vec<Option<f64>>>())
    });
    let lines: Vec<_> = lines.filter(|(_, cells)| cells.iter().any(Option::is_some)).collect();
    if lines.is_empty() {
        return String::new();
    }
    let titles = columns
        .iter()
        .map(|column| if column.is_empty() { "all".to_owned() } else { column.join(", ") });
    let head: Vec<String> = std::iter::once("gain".to_owned()).chain(titles).collect();
    let cell = |gain: Option<f64>| gain.map_or(NOTHING.to_owned(), |gain| format!("{gain:+.2}"));
    let lines = lines.into_iter().map(|(name, cells)| {
        std::iter::once(name.clone()).chain(cells.into_iter().map(cell)).collect::<Vec<_>>()
    });
    let lines: Vec<Vec<String>> = std::iter::once(head).chain(lines).collect();
    format!("\n## Gain, PSNR in dB\n\n{}", grid(&lines))
}

/// The mean PSNR of a method in a column.
fn psnr(params: &Params, rows: &[Row], method: &str, column: &[String]) -> Option<f64> {
    let name = params.methods.get(method).map_or(method, String::as_str);
    let mine = of(rows, &["method".to_owned()], &[name.to_owned()]);
    mean(&of(&mine, &params.columns, column), "psnr")
}

/// How far a value is spread over all results.
fn spread(rows: &[Row], figures: &Figures, name: &str) -> Option<String> {
    let values: Vec<f64> = rows.iter().filter_map(|row| row.get(name)?.as_f64()).collect();
    let mean = mean(rows, name)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let deviation = (squares / values.len().saturating_sub(1).max(1) as f64).sqrt();
    let [least, most] =
        [f64::min, f64::max].map(|pick| values.iter().copied().reduce(pick).unwrap_or(mean));
    let title = figures.title(name);
    let [mean, least, most] = [mean, least, most].map(|value| figures.shown(name, value));
    Some(format!(
        "\n{title} over {} results: {mean} ± {deviation:.2}, from {least} to {most}\n",
        values.len()
    ))
}

#[cfg(test)]
#[path = "markdown_tests.rs"]
mod tests;

//! Rows as a Markdown table.

use artifact::{FailedPoint, label};
use serde_json::Value;

use crate::{Params, Row};

/// Names that aren't keys: what a result has, not what it is of.
const PLACES: [&str; 2] = ["commit", "machine"];

/// The table, and the points that failed.
pub(crate) fn markdown(params: &Params, rows: &[Row], failed: &[FailedPoint]) -> Result<String, String> {
    let keys = row_keys(params, rows)?;
    let groups = distinct(rows, &keys);
    let columns = distinct(rows, &params.columns);
    let values: Vec<&String> = params.values.iter().filter(|name| rows.iter().any(|row| row.contains_key(*name))).collect();
    let is_pivot = !params.columns.is_empty();
    let mut head: Vec<String> = keys.clone();
    match is_pivot {
        true => head.extend(columns.iter().map(|column| format!("{} ({})", column.join(", "), titles(&values).join(" / ")))),
        false => head.extend(titles(&values)),
    }
    let compared = values.first().map_or("psnr", |name| name.as_str());
    let first = reference(params, rows, compared)?;
    head.extend(first.is_some().then(|| "against the first".to_owned()));
    head.extend(PLACES.map(str::to_owned));
    let best = |column: &[String], name: &str| {
        let means = groups.iter().filter_map(|group| mean(&of(&of(rows, &keys, group), &params.columns, column), name));
        means.reduce(if is_less_better(name) { f64::min } else { f64::max }).filter(|_| groups.len() > 1)
    };
    let mut lines = vec![head];
    for group in &groups {
        let mine = of(rows, &keys, group);
        let mut line = group.clone();
        for column in &columns {
            let here = of(&mine, &params.columns, column);
            let cells = values.iter().map(|name| marked(name, mean(&here, name), best(column, name)));
            match is_pivot {
                true => line.push(cells.collect::<Vec<_>>().join(" / ")),
                false => line.extend(cells),
            }
        }
        if let Some(first) = first {
            line.push(mean(&mine, compared).map_or("–".to_owned(), |value| format!("{:+.2}", value - first)));
        }
        line.extend(PLACES.map(|name| together(&mine, name)));
        lines.push(line);
    }
    let mut text = format!("# {}\n\n{}", params.title, grid(&lines));
    params.spread.iter().filter_map(|name| spread(rows, name)).for_each(|line| text += &line);
    if !failed.is_empty() {
        text += "\nFailed, or waiting for what failed:\n\n";
        failed.iter().for_each(|point| text += &format!("* {}\n", label(&point.stage, &point.point)));
    }
    Ok(text)
}

/// Keys that make a row: those asked for, or all that differ.
fn row_keys(params: &Params, rows: &[Row]) -> Result<Vec<String>, String> {
    let mut known: Vec<&String> = Vec::new();
    for (name, _) in rows.iter().flatten().filter(|(name, value)| value.is_string() && !PLACES.contains(&name.as_str())) {
        if !known.contains(&name) {
            known.push(name);
        }
    }
    if let Some(name) = params.rows.iter().chain(&params.columns).find(|name| !known.contains(name) && !rows.is_empty()) {
        let known = artifact::known_names(name, known.into_iter().map(String::as_str));
        return Err(format!("parameter rows: no result has a key {name:?}; {known}"));
    }
    if !params.rows.is_empty() {
        return Ok(params.rows.clone());
    }
    let differs = |name: &String| distinct(rows, std::slice::from_ref(name)).len() > 1;
    let is_row = |name: &&String| *name != "scene" && !params.columns.contains(name) && differs(name);
    Ok(known.into_iter().filter(is_row).cloned().collect())
}

/// The value that others are compared with.
fn reference(params: &Params, rows: &[Row], compared: &str) -> Result<Option<f64>, String> {
    if params.relative_to.is_empty() || rows.is_empty() {
        return Ok(None);
    }
    let (keys, values): (Vec<String>, Vec<String>) = params.relative_to.clone().into_iter().unzip();
    match mean(&of(rows, &keys, &values), compared) {
        Some(value) => Ok(Some(value)),
        None => Err(format!("parameter relative_to: no result has {:?}", params.relative_to)),
    }
}

/// Combinations of values that keys have, in the order of the rows; a single empty one without keys.
fn distinct(rows: &[Row], keys: &[String]) -> Vec<Vec<String>> {
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
fn of(rows: &[Row], keys: &[String], values: &[String]) -> Vec<Row> {
    let fits = |row: &&Row| keys.iter().zip(values).all(|(key, value)| row.get(key).map(plain).unwrap_or_default() == *value);
    rows.iter().filter(fits).cloned().collect()
}

/// The mean of a value over the rows that have it.
fn mean(rows: &[Row], name: &str) -> Option<f64> {
    let values: Vec<f64> = rows.iter().filter_map(|row| row.get(name)?.as_f64()).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// How far a value is spread over all results.
fn spread(rows: &[Row], name: &str) -> Option<String> {
    let values: Vec<f64> = rows.iter().filter_map(|row| row.get(name)?.as_f64()).collect();
    let mean = mean(rows, name)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let deviation = (squares / values.len().saturating_sub(1).max(1) as f64).sqrt();
    let [least, most] = [f64::min, f64::max].map(|pick| values.iter().copied().reduce(pick).unwrap_or(mean));
    let title = titles(&[&name.to_owned()]).concat();
    let [mean, least, most] = [mean, least, most].map(|value| shown(name, value));
    Some(format!("\n{title} over {} results: {mean} ± {deviation:.2}, from {least} to {most}\n", values.len()))
}

/// What rows have in common, or all that they have.
fn together(rows: &[Row], name: &str) -> String {
    distinct(rows, &[name.to_owned()]).concat().join(", ")
}

/// A value as text, without quotes.
pub(crate) fn plain(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

fn is_less_better(name: &str) -> bool {
    name.starts_with("lpips") || name.ends_with("_s") || name.starts_with("depth")
}

/// A value as it is shown; the best of its column in bold.
fn marked(name: &str, value: Option<f64>, best: Option<f64>) -> String {
    let Some(value) = value else { return "–".to_owned() };
    let text = shown(name, value);
    // What is shown alike is as good.
    if best.is_some_and(|best| shown(name, best) == text) { format!("**{text}**") } else { text }
}

fn shown(name: &str, value: f64) -> String {
    match name {
        "rays_per_s" => format!("{:.0} k", value / 1e3),
        "samples_per_ray" => format!("{value:.1}"),
        name if name.ends_with("_s") && value >= 120.0 => format!("{:.1} min", value / 60.0),
        name if name.ends_with("_s") => format!("{value:.1} s"),
        name if name.contains("psnr") || name.contains("gain") => format!("{value:.2}"),
        _ if value.fract() == 0.0 => format!("{value:.0}"),
        _ => format!("{value:.4}"),
    }
}

/// Column titles of values.
fn titles(values: &[&String]) -> Vec<String> {
    let title = |name: &str| match name {
        "psnr" | "ssim" | "lpips" => name.to_uppercase(),
        "train_s" => "training".to_owned(),
        "render_s" => "rendering".to_owned(),
        "refine_s" => "refining".to_owned(),
        "rays_per_s" => "rays/s".to_owned(),
        name => name.replace('_', " "),
    };
    values.iter().map(|name| title(name)).collect()
}

fn grid(lines: &[Vec<String>]) -> String {
    let line =
        |cells: &[String]| format!("| {} |\n", cells.iter().map(|cell| cell.replace('|', "\\|")).collect::<Vec<_>>().join(" | "));
    let rule = vec!["---".to_owned(); lines[0].len()];
    [&lines[0], &rule].into_iter().chain(&lines[1..]).map(|cells| line(cells)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;
    use std::collections::BTreeMap;

    fn rows() -> Vec<Row> {
        let row = |scene: &str, variant: &str, protocol: &str, psnr: f64, lpips: Option<f64>, train_s: f64| {
            let mut row = json!({"scene": scene, "variant": variant, "protocol": protocol, "method": "eval", "psnr": psnr, "train_s": train_s,
                "commit": "abc1234", "machine": "2 cores"});
            lpips.iter().for_each(|value| row["lpips"] = json!(value));
            row.as_object().cloned().unwrap()
        };
        vec![
            row("lego", "as it is", "100x2", 30.0, Some(0.05), 100.0),
            row("chair", "as it is", "100x2", 32.0, Some(0.04), 140.0),
            row("lego", "no warm-up", "100x2", 29.5, None, 90.0),
            row("chair", "no warm-up", "100x2", 32.25, None, 310.0),
        ]
    }

    #[test]
    fn results_of_one_row_are_averaged_and_the_best_is_marked() {
        let relative_to = BTreeMap::from([("variant".to_owned(), "as it is".to_owned())]);
        let params = Params { title: "Ablation".to_owned(), relative_to, ..Params::default() };
        let expected = "\
# Ablation

| variant | PSNR | LPIPS | training | against the first | commit | machine |
| --- | --- | --- | --- | --- | --- | --- |
| as it is | **31.00** | **0.0450** | **2.0 min** | +0.00 | abc1234 | 2 cores |
| no warm-up | 30.88 | – | 3.3 min | -0.12 | abc1234 | 2 cores |
";
        assert_eq!(markdown(&params, &rows(), &[]).unwrap(), expected);
    }

    #[test]
    fn columns_hold_all_values_of_a_key() {
        let params = Params {
            rows: vec!["variant".to_owned()],
            columns: vec!["scene".to_owned()],
            values: vec!["psnr".to_owned(), "lpips".to_owned()],
            ..Params::default()
        };
        let failed = [FailedPoint { stage: "eval".to_owned(), point: "scene=ship".to_owned() }];
        let expected = "\
# Results

| variant | lego (PSNR / LPIPS) | chair (PSNR / LPIPS) | commit | machine |
| --- | --- | --- | --- | --- |
| as it is | **30.00** / **0.0500** | 32.00 / **0.0400** | abc1234 | 2 cores |
| no warm-up | 29.50 / – | **32.25** / – | abc1234 | 2 cores |

Failed, or waiting for what failed:

* eval [scene=ship]
";
        assert_eq!(markdown(&params, &rows(), &failed).unwrap(), expected);
    }

    #[test]
    fn keys_that_no_result_has_are_refused() {
        for (rows_by, relative_to, words) in [
            (
                vec!["varant"],
                vec![],
                "parameter rows: no result has a key \"varant\"; did you mean variant? known: method, protocol, scene, variant",
            ),
            (vec![], vec![("variant", "nothing")], "parameter relative_to: no result has {\"variant\": \"nothing\"}"),
        ] {
            let params = Params {
                rows: rows_by.into_iter().map(str::to_owned).collect(),
                relative_to: relative_to.into_iter().map(|(k, v)| (k.to_owned(), v.to_owned())).collect(),
                ..Params::default()
            };
            assert_eq!(markdown(&params, &rows(), &[]).unwrap_err(), words);
        }
        let spread = Params { spread: vec!["psnr".to_owned()], ..Params::default() };
        let text = markdown(&spread, &rows(), &[]).unwrap();
        assert!(text.ends_with("\nPSNR over 4 results: 30.94 ± 1.39, from 29.50 to 32.25\n"), "{text}");
        let nothing =
            markdown(&Params::default(), &[], &[FailedPoint { stage: "eval".to_owned(), point: String::new() }]).unwrap();
        assert!(nothing.contains("* eval\n"), "{nothing}");
    }
}

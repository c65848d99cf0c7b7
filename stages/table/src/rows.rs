use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context as _;
use artifact::{RunNode, RunRecord};
use metrics::AnyMetrics;
use serde_json::{Value, json};

use crate::figures::Figures;
use crate::params::Params;
use crate::values::Row;

/// Why a row has no values.
pub(crate) const MISSING: &str = "missing";

/// A row for every result of a run, and for what was left out of it: in the order of the groups,
/// and otherwise of the run.
///
/// Figures of their metrics go into `figures`.
pub(crate) fn rows(
    run: &RunRecord,
    params: &Params,
    figures: &mut Figures,
) -> anyhow::Result<Vec<Row>> {
    let commit = run.commit().unwrap_or_default();
    let mut scored: Vec<(usize, &RunNode)> =
        run.nodes.iter().enumerate().filter(|(_, node)| node.is_shown).collect();
    // Blocks that come through fewer stages stand first: rendered views before refined ones.
    scored.sort_by_key(|(_, node)| depth(run, &node.stage));
    let mut rows: Vec<(usize, Row)> = Vec::new();
    for (index, node) in scored {
        let mut row = keys(params, &node.stage, &node.values);
        row.extend(scores(node, figures)?);
        row.extend(times(run, index)?);
        row.extend(seconds_per_view(&row));
        row.insert("commit".to_owned(), json!(commit));
        row.insert("machine".to_owned(), json!(node.host));
        rows.push((place(params, &node.stage), row));
    }
    for point in &run.failed {
        let Some(reason) = &point.reason else { continue };
        let mut row = keys(params, &point.stage, &point.values);
        row.insert(MISSING.to_owned(), json!(reason));
        rows.push((place(params, &point.stage), row));
    }
    rows.sort_by_key(|(place, _)| *place);
    Ok(rows.into_iter().map(|(_, row)| row).collect())
}

/// How many nodes a stage's results were made of, at most.
fn depth(run: &RunRecord, stage: &str) -> Option<usize> {
    let of_stage = run.nodes.iter().enumerate().filter(|(_, node)| node.stage == stage);
    of_stage.map(|(index, _)| run.ancestors(index).len()).max()
}

/// What a result is of: values of axes, method and its group.
fn keys(params: &Params, stage: &String, values: &BTreeMap<String, String>) -> Row {
    let mut row: Row = values.iter().map(|(name, value)| (name.clone(), json!(value))).collect();
    row.insert("method".to_owned(), json!(params.methods.get(stage).unwrap_or(stage)));
    if !params.groups.is_empty() {
        let group = params.groups.iter().find(|group| group.methods.contains(stage));
        row.insert(params.grouped_by.clone(), json!(group.map_or("", |group| group.name.as_str())));
    }
    for (name, value) in params.fields.get(stage).into_iter().flatten() {
        let value = of_key(&row, value);
        row.insert(name.clone(), value);
    }
    row
}

/// A value, or that of the key which it names in braces: a number where it is one.
fn of_key(row: &Row, value: &Value) -> Value {
    let named = value.as_str().and_then(|text| text.strip_prefix('{')?.strip_suffix('}'));
    let Some(text) = named.and_then(|name| row.get(name)?.as_str()) else { return value.clone() };
    text.parse::<u64>().map_or_else(|_| json!(text), |number| json!(number))
}

/// The place of a method in the table; those of no group come last.
fn place(params: &Params, stage: &String) -> usize {
    let mut all = params.groups.iter().flat_map(|group| &group.methods);
    all.position(|method| method == stage).unwrap_or(usize::MAX)
}

/// What a view took to render, or where it was refined, to refine.
fn seconds_per_view(row: &Row) -> Option<(String, Value)> {
    let [views, rendering, refining] =
        ["views", "render_s", "refine_s"].map(|name| row.get(name).and_then(Value::as_f64));
    let seconds = refining.filter(|seconds| *seconds > 0.0).or(rendering)?;
    Some(("seconds_per_view".to_owned(), json!(seconds / views.filter(|views| *views > 0.0)?)))
}

/// What a result's own file says: means of metrics, or what a refiner's training says of itself.
fn scores(node: &RunNode, figures: &mut Figures) -> anyhow::Result<Row> {
    let mut found = Row::new();
    if node.kind == "refiner" {
        let file = read(&node.folder.join("refiner.json"))?;
        numbers("", &file, &mut found);
        let gain = file["refined_psnr"]
            .as_f64()
            .zip(file["rendered_psnr"].as_f64())
            .map(|(after, before)| after - before);
        found.extend(gain.map(|gain| ("gain".to_owned(), json!(gain))));
        return Ok(found);
    }
    if node.kind != "metrics" {
        return Ok(found);
    }
    let file = AnyMetrics::read(&node.folder)?;
    figures.add(&file);
    numbers("", file.mean(), &mut found);
    let near = file.near_references();
    for (name, value) in [
        ("least_gain", file.least_gain()),
        ("near_psnr", &near["psnr"]),
        ("near_views", &near["views"]),
    ] {
        numbers(name, value, &mut found);
    }
    found.insert("views".to_owned(), json!(file.views().len()));
    Ok(found)
}

/// Every number inside a value, by its path.
fn numbers(name: &str, value: &Value, found: &mut Row) {
    match value {
        Value::Number(_) => _ = found.insert(name.to_owned(), value.clone()),
        Value::Object(entries) => {
            for (key, value) in entries {
                let name = if name.is_empty() { key.clone() } else { format!("{name}.{key}") };
                numbers(&name, value, found);
            }
        }
        _ => {}
    }
}

fn read(path: &Path) -> anyhow::Result<Value> {
    let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
    serde_json::from_slice(&bytes).with_context(|| path.display().to_string())
}

/// Seconds of what a result came through. What fields and refiners were made of counts as training;
/// other views count as rendering, and those of them that no field made directly as refining.
fn times(run: &RunRecord, index: usize) -> anyhow::Result<Row> {
    let ancestors = run.ancestors(index);
    let is_trained = |node: &RunNode| ["field", "refiner"].contains(&node.kind.as_str());
    let trained: Vec<usize> =
        ancestors.iter().copied().filter(|&i| is_trained(&run.nodes[i])).collect();
    let in_training: Vec<usize> = trained.iter().flat_map(|&i| run.ancestors(i)).collect();
    let is_views = |i: &usize| run.nodes[*i].kind == "views";
    let training: Vec<usize> = ancestors
        .iter()
        .copied()
        .filter(|i| in_training.contains(i) && (is_views(i) || trained.contains(i)))
        .collect();
    let rendering: Vec<usize> =
        ancestors.iter().copied().filter(|i| is_views(i) && !in_training.contains(i)).collect();
    let refining: Vec<usize> =
        rendering.iter().copied().filter(|&i| !is_by_field(run, i)).collect();
    // 0 is added since the sum of nothing is -0.
    let seconds = |nodes: &[usize]| nodes.iter().map(|&i| run.nodes[i].seconds).sum::<f64>() + 0.0;
    let mut row = Row::new();
    for (name, nodes) in [("train_s", &training), ("render_s", &rendering), ("refine_s", &refining)]
    {
        row.insert(name.to_owned(), json!(seconds(nodes)));
    }
    // Of the field that the views show: the first one of the run that isn't there for a refiner.
    let field = trained.iter().map(|&i| &run.nodes[i]).find(|node| node.kind == "field");
    if let Some(field) = field {
        let path = field.folder.join("training.json");
        if path.exists() {
            let log = read(&path)?;
            row.insert("samples_per_ray".to_owned(), log["samples_per_ray"].clone());
            row.insert(
                "rays_per_s".to_owned(),
                json!(log["rays"].as_f64().unwrap_or(0.0) / field.seconds.max(1e-9)),
            );
        }
    }
    Ok(row)
}

/// Whether a node was made of a field directly.
fn is_by_field(run: &RunRecord, index: usize) -> bool {
    let mut parents = run.nodes[index].inputs.values().filter_map(|input| input.node);
    parents.any(|parent| run.nodes[parent].kind == "field")
}

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context as _;
use artifact::{RunNode, RunRecord};
use metrics::AnyMetrics;
use radiance::{TRAINING_FILE, TrainingLog};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use stage::Progress;

use crate::figures::Figures;
use crate::params::Params;
use crate::values::{MISSING, Row};

/// Key of a method's group: the images that its training has seen.
pub(crate) const GROUP: &str = "has seen";

/// Returns a row for every result of a run and for every left-out one, in the order of the groups,
/// then by the number of stages before them. Figures of their metrics are added to `figures`.
pub(crate) fn rows(
    run: &RunRecord,
    params: &Params,
    figures: &mut Figures,
    progress: &Progress,
) -> anyhow::Result<Vec<Row>> {
    let commit = run.commit().unwrap_or_default();
    let mut scored: Vec<(usize, &RunNode)> =
        run.nodes.iter().enumerate().filter(|(_, node)| node.is_shown).collect();
    // Blocks with fewer stages before them come first: rendered views before refined ones.
    scored.sort_by_key(|(_, node)| ancestor_count(run, &node.stage));
    let mut rows: Vec<(usize, Row)> = Vec::new();
    for (finished, (index, node)) in scored.into_iter().enumerate() {
        progress.set(finished as u64, "");
        let mut row = keys(params, &node.stage, &node.values);
        row.extend(scores(node, figures)?);
        row.extend(times(run, index)?);
        row.extend(seconds_per_view(&row));
        row.insert("commit".to_owned(), json!(commit));
        row.insert("machine".to_owned(), json!(node.host));
        rows.push((table_rank(params, &node.stage), row));
    }
    for point in &run.failed {
        let Some(reason) = &point.reason else { continue };
        let mut row = keys(params, &point.stage, &point.values);
        row.insert(MISSING.to_owned(), json!(reason));
        rows.push((table_rank(params, &point.stage), row));
    }
    rows.sort_by_key(|(rank, _)| *rank);
    Ok(rows.into_iter().map(|(_, row)| row).collect())
}

/// Returns the maximum number of nodes that a stage's results depend on.
fn ancestor_count(run: &RunRecord, stage: &str) -> Option<usize> {
    let nodes = run.nodes.iter().enumerate().filter(|(_, node)| node.stage == stage);
    nodes.map(|(index, _)| run.ancestors(index).len()).max()
}

/// Returns the keys of a result: values of axes, method and group.
fn keys(params: &Params, stage: &String, values: &BTreeMap<String, String>) -> Row {
    let mut row: Row = values.iter().map(|(name, value)| (name.clone(), json!(value))).collect();
    row.insert("method".to_owned(), json!(method_name(params, stage, &row)));
    if !params.groups.is_empty() {
        let group = params.groups.iter().find(|group| group.methods.contains(stage));
        row.insert(GROUP.to_owned(), json!(group.map_or("", |group| group.name.as_str())));
    }
    row
}

/// Returns the name of a block's method, with the row's values of the keys in the name.
pub(crate) fn method_name(params: &Params, block: &str, row: &Row) -> String {
    let mut method = params.methods.get(block).map_or(block, String::as_str).to_owned();
    for (name, value) in row {
        if let Some(value) = value.as_str() {
            method = method.replace(&format!("{{{name}}}"), value);
        }
    }
    method
}

/// Returns the position of a method in the table; methods without a group are last.
fn table_rank(params: &Params, stage: &String) -> usize {
    let mut all = params.groups.iter().flat_map(|group| &group.methods);
    all.position(|method| method == stage).unwrap_or(usize::MAX)
}

/// Returns the seconds per view of refining, or of rendering if nothing was refined.
fn seconds_per_view(row: &Row) -> Option<(String, Value)> {
    let [views, rendering, refining] =
        ["views", "render_s", "refine_s"].map(|name| row.get(name).and_then(Value::as_f64));
    let seconds = refining.filter(|seconds| *seconds > 0.0).or(rendering)?;
    Some(("seconds_per_view".to_owned(), json!(seconds / views.filter(|views| *views > 0.0)?)))
}

/// Returns the values of a result's own file: means of metrics, or a refiner's scores.
fn scores(node: &RunNode, figures: &mut Figures) -> anyhow::Result<Row> {
    let mut found = Row::new();
    if node.kind == "refiner" {
        let file: Value = read(&node.folder.join("refiner.json"))?;
        numbers("", &file, &mut found);
        let scores = (file["refined_psnr"].as_f64(), file["rendered_psnr"].as_f64());
        if let (Some(refined), Some(rendered)) = scores {
            found.insert("gain".to_owned(), json!(refined - rendered));
        }
    } else if node.kind == "metrics" {
        let file = AnyMetrics::read(&node.folder)?;
        figures.add(&file);
        numbers("", file.mean(), &mut found);
        numbers("least_gain", file.least_gain(), &mut found);
        numbers("near_psnr", &file.near_references()["psnr"], &mut found);
        numbers("near_views", &file.near_references()["views"], &mut found);
        found.insert("views".to_owned(), json!(file.views().len()));
    }
    Ok(found)
}

/// Adds every number inside a value, by its path.
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

fn read<T: DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
    serde_json::from_slice(&bytes).with_context(|| path.display().to_string())
}

/// Returns the seconds of training, rendering and refining, the processor seconds of training, the
/// peak memory, and the size and training speed of the field that the views show. The seconds of
/// rendered views also count as refining if the views weren't rendered from a field.
fn times(run: &RunRecord, index: usize) -> anyhow::Result<Row> {
    let [trained, rendered] = run.training_and_rendering(index);
    let mut refined = rendered.clone();
    refined.retain(|&i| {
        let mut parents = run.nodes[i].inputs.values().filter_map(|input| input.node);
        !parents.any(|parent| run.nodes[parent].kind == "field")
    });
    // Not `Iterator::sum`, whose result is -0.0 without elements.
    let [training, rendering, refining] = [&trained, &rendered, &refined]
        .map(|nodes| nodes.iter().fold(0.0, |sum, &i| sum + run.nodes[i].seconds));
    let processor_seconds = trained.iter().map(|&i| run.nodes[i].processor_seconds);
    let processor = processor_seconds.fold(0.0, |sum, own| sum + own.unwrap_or(f64::NAN));
    let peaks = trained.iter().chain(&rendered).filter_map(|&i| run.nodes[i].peak_memory);
    let peak_memory = peaks.max().unwrap_or(0);
    let mut row = Row::new();
    row.insert("train_s".to_owned(), json!(training));
    row.insert("render_s".to_owned(), json!(rendering));
    row.insert("refine_s".to_owned(), json!(refining));
    if processor.is_finite() {
        row.insert("train_cpu_s".to_owned(), json!(processor));
    }
    if peak_memory > 0 {
        row.insert("peak_mb".to_owned(), json!(peak_memory as f64 / 1e6));
    }
    let rendered_from = rendered.iter().flat_map(|&i| run.nodes[i].inputs.values());
    let mut parents = rendered_from.filter_map(|input| Some(&run.nodes[input.node?]));
    if let Some(field) = parents.find(|node| node.kind == "field") {
        row.insert("field_mb".to_owned(), json!(weights_bytes(&field.folder)? as f64 / 1e6));
        let path = field.folder.join(TRAINING_FILE);
        if path.exists() {
            let log: TrainingLog = read(&path)?;
            row.insert("samples_per_ray".to_owned(), json!(log.samples_per_ray));
            let rays_per_second = log.rays as f64 / field.seconds.max(1e-9);
            row.insert("rays_per_s".to_owned(), json!(rays_per_second));
        }
    }
    Ok(row)
}

/// Returns the size of a field's weights.
fn weights_bytes(folder: &Path) -> anyhow::Result<u64> {
    let mut bytes = 0;
    for entry in std::fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let entry = entry?;
        if entry.path().extension().is_some_and(|extension| extension == "safetensors") {
            bytes += entry.metadata()?.len();
        }
    }
    Ok(bytes)
}

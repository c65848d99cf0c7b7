//! Two results with all that they were made of, and what differs between them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::Context as _;
use artifact::{Damage, Manifest, label};
use metrics::METRICS_FILE;
use planning::{Change, changes};
use serde::Serialize;
use serde_json::{Map, Value};
use store::{Record, Store};

/// Finished actions with all that they were made of, by stage and point.
pub(crate) struct Lineage {
    records: BTreeMap<String, Record>,
}

/// What differs in one stage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct StageDifference {
    /// Stage and point.
    pub(crate) stage: String,
    /// Parts of the key, defaults that the scene decided, metrics, and files.
    pub(crate) changes: Vec<Change>,
}

impl Lineage {
    /// Of the actions that have these keys. What garbage collection has taken is left out.
    pub(crate) fn of(
        store: &Store,
        keys: impl IntoIterator<Item = String>,
    ) -> anyhow::Result<Self> {
        let (mut open, mut seen): (Vec<String>, BTreeSet<String>) =
            (keys.into_iter().collect(), BTreeSet::new());
        let mut found: Vec<Record> = Vec::new();
        while let Some(key) = open.pop() {
            if !seen.insert(key.clone()) {
                continue;
            }
            if let Some(record) = store.record(&key)? {
                // What can't be read isn't gone.
                if let Err(unreadable @ Damage::Unreadable { .. }) = store.manifest(&record.output)
                {
                    return Err(unreadable.into());
                }
                open.extend(record.made_of.clone());
                found.push(record);
            }
        }
        // A point is of the run that made the result first: where a stage has one result, its name
        // is enough.
        let is_single =
            |stage: &str| found.iter().filter(|record| record.stage == stage).count() == 1;
        let records = found.iter().map(|record| {
            let name = if is_single(&record.stage) {
                record.stage.clone()
            } else {
                label(&record.stage, &record.point)
            };
            (name, record.clone())
        });
        Ok(Self { records: records.collect() })
    }

    /// What differs from an earlier one, stage by stage. Where what a stage was made of differs,
    /// its inputs' hashes aren't told.
    pub(crate) fn differences(
        &self,
        before: &Self,
        store: &Store,
    ) -> anyhow::Result<Vec<StageDifference>> {
        let names: BTreeSet<&String> = self.records.keys().chain(before.records.keys()).collect();
        let mut found = Vec::new();
        for name in names {
            let sides = [(before, before.records.get(name)), (self, self.records.get(name))];
            let depth = Depth::of(sides.map(|(_, record)| record), store);
            let [parts_before, parts_now] = sides.map(|(lineage, record)| match record {
                Some(record) => lineage.parts(record, store, depth),
                None => Ok(Map::new()),
            });
            let changes = changes(&parts_before?, &parts_now?);
            if !changes.is_empty() {
                found.push(StageDifference { stage: name.clone(), changes });
            }
        }
        Ok(found)
    }

    /// What may differ of a result, by name.
    fn parts(
        &self,
        record: &Record,
        store: &Store,
        depth: Depth,
    ) -> anyhow::Result<Map<String, Value>> {
        if depth == Depth::Name {
            let stage = record.key_parts.iter().filter(|(name, _)| *name == "stage");
            return Ok(stage.map(owned).collect());
        }
        let mut parts: Map<String, Value> = record
            .key_parts
            .iter()
            .filter(|(name, value)| {
                !(name.starts_with("input ") && self.is_made(record, value, store))
            })
            .map(owned)
            .collect();
        let manifest = store.manifest(&record.output).ok();
        parts.insert(
            "artifact".to_owned(),
            Value::from(if manifest.is_some() { "kept" } else { "gone" }),
        );
        if let Some(manifest) = manifest.filter(|_| depth == Depth::Content) {
            add_content(&mut parts, record, &manifest, &store.object(&record.output))?;
        }
        Ok(parts)
    }

    /// Whether an input's hash is of something here that the record's action was made of.
    fn is_made(&self, record: &Record, hash: &Value, store: &Store) -> bool {
        let outputs = self.records.values().filter(|other| record.made_of.contains(&other.key()));
        outputs.into_iter().any(|other| is_of(store, hash, &other.output))
    }
}

/// How much of two results is compared.
#[derive(Clone, Copy, PartialEq)]
enum Depth {
    /// One of them isn't there: its stage's name says it all.
    Name,
    /// The artifact of one is gone.
    Key,
    /// Metrics, files, and what the scene decided, too.
    Content,
}

impl Depth {
    fn of(records: [Option<&Record>; 2], store: &Store) -> Self {
        match records {
            [Some(before), Some(now)] => {
                let is_kept = |record: &Record| store.manifest(&record.output).is_ok();
                if is_kept(before) && is_kept(now) { Self::Content } else { Self::Key }
            }
            _ => Self::Name,
        }
    }
}

/// Adds an artifact's files by their hashes; of JSON files the numbers that count.
fn add_content(
    parts: &mut Map<String, Value>,
    record: &Record,
    manifest: &Manifest,
    folder: &Path,
) -> anyhow::Result<()> {
    for file in manifest.files.iter().filter(|file| !file.path.ends_with(".json")) {
        parts.insert(format!("file {}", file.path), Value::from(file.blake3.clone()));
    }
    for file in manifest
        .files
        .iter()
        .filter(|file| file.path.ends_with(".json") && !file.path.contains('/'))
    {
        let path = folder.join(&file.path);
        let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
        let Ok(value) = serde_json::from_slice::<Value>(&bytes) else { continue };
        // Which file has the values in use isn't recorded: what names no parameter is something
        // else.
        let resolved = value.get("resolved").and_then(Value::as_object).into_iter().flatten();
        for (name, value) in
            resolved.filter(|(name, _)| record.key_parts.contains_key(&format!("parameter {name}")))
        {
            parts.insert(format!("resolved {name}"), value.clone());
        }
        if file.path == METRICS_FILE {
            numbers("mean", &value["mean"], &mut |name, value| {
                parts.insert(format!("metric {name}"), value.clone());
            });
        }
    }
    Ok(())
}

fn owned((name, value): (&String, &Value)) -> (String, Value) {
    (name.clone(), value.clone())
}

/// Whether an input's hash is of an artifact or of one of its folders.
fn is_of(store: &Store, hash: &Value, output: &str) -> bool {
    hash == output || store.manifest(output).is_ok_and(|manifest| is_of_folder(hash, &manifest))
}

fn is_of_folder(hash: &Value, manifest: &Manifest) -> bool {
    let folders: BTreeSet<String> = manifest
        .files
        .iter()
        .filter_map(|file| file.path.split_once('/'))
        .map(|(folder, _)| folder.to_owned())
        .collect();
    folders.iter().any(|folder| *hash == manifest.subtree(folder).identity())
}

/// Tells of every number inside a value, by its path.
fn numbers(name: &str, value: &Value, tell: &mut dyn FnMut(&str, &Value)) {
    match value {
        Value::Number(_) => tell(name, value),
        Value::Object(entries) => {
            entries.iter().for_each(|(key, value)| numbers(&format!("{name}.{key}"), value, tell));
        }
        _ => {}
    }
}

//! Comparison of two results and of all actions that they depend on.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::Context as _;
use artifact::{Damage, Manifest, label};
use metrics::METRICS_FILE;
use planning::{Change, changes};
use serde::Serialize;
use serde_json::{Map, Value};
use store::{Record, Store};

/// Records of finished actions and of all actions that they depend on.
pub(crate) struct Lineage {
    /// Records by stage, or by stage and point if a stage has several results.
    records: BTreeMap<String, Record>,
}

/// Differences in one stage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct StageDifference {
    /// Stage and point.
    pub(crate) stage: String,
    /// Changed parts of the key, defaults that the scene decided, metrics, and files.
    pub(crate) changes: Vec<Change>,
}

impl Lineage {
    /// Reads the records of keys and of their ancestors. Records that garbage collection has
    /// deleted are skipped.
    pub(crate) fn read(store: &Store, keys: BTreeSet<String>) -> anyhow::Result<Self> {
        let mut open: Vec<String> = keys.into_iter().collect();
        let mut seen: BTreeSet<String> = BTreeSet::new();
        let mut found: Vec<Record> = Vec::new();
        while let Some(key) = open.pop() {
            if !seen.insert(key.clone()) {
                continue;
            }
            if let Some(record) = store.record(&key)? {
                // An unreadable artifact isn't a deleted one.
                if let Err(unreadable @ Damage::Unreadable { .. }) = store.manifest(&record.output)
                {
                    return Err(unreadable.into());
                }
                open.extend(record.made_of.clone());
                found.push(record);
            }
        }
        // A record's point belongs to the run that first created the result, so the same result may
        // have different points on the two sides. The stage alone identifies a single result.
        let mut records = BTreeMap::new();
        for record in &found {
            let is_single = found.iter().filter(|other| other.stage == record.stage).count() == 1;
            let name =
                if is_single { record.stage.clone() } else { label(&record.stage, &record.point) };
            records.insert(name, record.clone());
        }
        Ok(Self { records })
    }

    /// Finds the differences from an earlier lineage, stage by stage. If a stage's parent differs,
    /// the hash of that input isn't reported.
    pub(crate) fn differences(
        &self,
        before: &Self,
        store: &Store,
    ) -> anyhow::Result<Vec<StageDifference>> {
        let names: BTreeSet<&String> = self.records.keys().chain(before.records.keys()).collect();
        let mut differences = Vec::new();
        for name in names {
            let (old, new) = (before.records.get(name), self.records.get(name));
            let [old, new] = if let (Some(old), Some(new)) = (old, new) {
                let mut parts = [before.parts(old, store), self.parts(new, store)];
                let manifests = [old, new].map(|record| store.manifest(&record.output));
                if let [Ok(old_manifest), Ok(new_manifest)] = manifests {
                    add_content(&mut parts[0], old, &old_manifest, store)?;
                    add_content(&mut parts[1], new, &new_manifest, store)?;
                }
                parts
            } else {
                [old, new].map(stage_part)
            };
            let changes = changes(&old, &new);
            if !changes.is_empty() {
                differences.push(StageDifference { stage: name.clone(), changes });
            }
        }
        Ok(differences)
    }

    /// Returns the parts of a result that don't need its artifact, by name.
    fn parts(&self, record: &Record, store: &Store) -> Map<String, Value> {
        let mut parts = record.key_parts.clone();
        parts.retain(|name, value| {
            !(name.starts_with("input ") && self.is_from_parent(record, value, store))
        });
        let state = if store.manifest(&record.output).is_ok() { "kept" } else { "gone" };
        parts.insert("artifact".to_owned(), Value::from(state));
        parts
    }

    /// True if an input's hash is the artifact, or a folder of it, of a parent in this lineage.
    fn is_from_parent(&self, record: &Record, hash: &Value, store: &Store) -> bool {
        let mut parents = self.records.values().filter(|r| record.made_of.contains(&r.key()));
        parents.any(|parent| {
            let Ok(manifest) = store.manifest(&parent.output) else {
                return *hash == parent.output;
            };
            let paths = manifest.files.iter().filter_map(|file| file.path.split_once('/'));
            let folders: BTreeSet<&str> = paths.map(|(folder, _)| folder).collect();
            *hash == parent.output
                || folders.iter().any(|folder| *hash == manifest.subtree(folder).identity())
        })
    }
}

/// Returns the stage's name, the only part that is compared if one side doesn't have the stage.
fn stage_part(record: Option<&Record>) -> Map<String, Value> {
    let stage = record.and_then(|record| record.key_parts.get_key_value("stage"));
    stage.map(|(name, value)| (name.clone(), value.clone())).into_iter().collect()
}

/// Adds metrics, the hashes of files, and values that the scene decided. JSON files contribute
/// their metrics and resolved defaults instead of their hashes.
fn add_content(
    parts: &mut Map<String, Value>,
    record: &Record,
    manifest: &Manifest,
    store: &Store,
) -> anyhow::Result<()> {
    for file in &manifest.files {
        if !file.path.ends_with(".json") {
            parts.insert(format!("file {}", file.path), Value::from(file.blake3.clone()));
            continue;
        }
        if file.path.contains('/') {
            continue;
        }
        let path = store.object(&record.output).join(&file.path);
        let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
        let Ok(json) = serde_json::from_slice::<Value>(&bytes) else { continue };
        // No record names the file of resolved defaults. Entries that aren't parameters belong to
        // another kind of file.
        for (name, value) in json.get("resolved").and_then(Value::as_object).into_iter().flatten() {
            if record.key_parts.contains_key(&format!("parameter {name}")) {
                parts.insert(format!("resolved {name}"), value.clone());
            }
        }
        if file.path == METRICS_FILE {
            add_numbers(parts, "metric mean", &json["mean"]);
        }
    }
    Ok(())
}

/// Adds every number in a JSON value, by its dotted path after `name`.
fn add_numbers(parts: &mut Map<String, Value>, name: &str, value: &Value) {
    match value {
        Value::Number(_) => _ = parts.insert(name.to_owned(), value.clone()),
        Value::Object(entries) => {
            for (key, value) in entries {
                add_numbers(parts, &format!("{name}.{key}"), value);
            }
        }
        _ => {}
    }
}

use std::collections::BTreeMap;

use serde_json::{Map, Value};

use super::contents::Contents;
use super::roots::Root;

/// What roots reach, and why it stays.
#[derive(Debug, Default)]
pub(super) struct Kept {
    /// By key.
    pub(super) records: BTreeMap<String, String>,
    /// By identity.
    pub(super) objects: BTreeMap<String, String>,
    /// By key.
    pub(super) unfinished: BTreeMap<String, String>,
}

/// From the roots to the records and unfinished actions they name, to those actions' inputs, and to the records that made them.
pub(super) fn reach(contents: &Contents, roots: &[Root]) -> Kept {
    let mut kept = Kept::default();
    let mut open: Vec<(String, String)> = Vec::new();
    for root in roots.iter().rev() {
        let fitting = contents.records.iter().filter(|(_, record)| root.waiting.iter().any(|node| node.may_be(record)));
        let keys = root.keys.iter().chain(fitting.map(|(key, _)| key));
        open.extend(keys.map(|key| (key.clone(), root.why.clone())));
    }
    while let Some((key, why)) = open.pop() {
        if let Some(action) = contents.unfinished.get(&key)
            && kept.unfinished.insert(key.clone(), why.clone()).is_none()
            && let Some(action) = action
        {
            keep_inputs(contents, (&action.stage, &action.key_parts), &mut kept, &mut open);
        }
        if let Some(record) = contents.records.get(&key)
            && !kept.records.contains_key(&key)
        {
            kept.objects.entry(record.output.clone()).or_insert_with(|| why.clone());
            kept.records.insert(key, why);
            keep_inputs(contents, (&record.stage, &record.key_parts), &mut kept, &mut open);
        }
    }
    kept
}

/// Keeps the inputs of an action, and goes on with what made them.
fn keep_inputs(
    contents: &Contents,
    (stage, key_parts): (&str, &Map<String, Value>),
    kept: &mut Kept,
    open: &mut Vec<(String, String)>,
) {
    for object in contents.inputs(key_parts) {
        let why = format!("{stage} was made of it");
        kept.objects.entry(object.clone()).or_insert_with(|| why.clone());
        open.extend(contents.makers(object).map(|key| (key.clone(), why.clone())));
    }
}

use std::collections::{BTreeMap, BTreeSet};

use crate::garbage::contents::Contents;
use crate::garbage::roots::Root;

/// Entries of a store that some root reaches, each with a reason: the reason of the first root
/// that reaches it, or `input of STAGE`.
#[derive(Debug, Default)]
pub(crate) struct Kept {
    /// Reasons by key.
    pub(crate) records: BTreeMap<String, String>,
    /// Reasons by identity (content hash).
    pub(crate) objects: BTreeMap<String, String>,
    /// Reasons by key.
    pub(crate) unfinished: BTreeMap<String, String>,
}

/// Marks the records and unfinished actions of all roots and, for roots `with_inputs`, the actions
/// that produced their inputs.
pub(crate) fn reach(contents: &Contents, roots: &[Root]) -> Kept {
    let mut kept = Kept::default();
    for root in roots {
        let matching = contents
            .records
            .iter()
            .filter(|(_, record)| root.waiting.iter().any(|node| node.matches(record)));
        let mut to_visit: Vec<(String, String)> = root
            .keys
            .iter()
            .chain(matching.map(|(key, _)| key))
            .map(|key| (key.clone(), root.reason.clone()))
            .collect();
        let mut seen = BTreeSet::new();
        while let Some((key, reason)) = to_visit.pop() {
            if !seen.insert(key.clone()) {
                continue;
            }
            if root.with_inputs {
                to_visit.extend(input_actions(contents, &key));
            }
            if contents.unfinished.contains_key(&key) {
                kept.unfinished.entry(key.clone()).or_insert_with(|| reason.clone());
            }
            if let Some(record) = contents.records.get(&key) {
                kept.objects.entry(record.output.clone()).or_insert_with(|| reason.clone());
                kept.records.entry(key).or_insert(reason);
            }
        }
    }
    kept
}

/// Returns the actions that produced an action's inputs, each with the reason for keeping it.
fn input_actions(contents: &Contents, key: &str) -> Vec<(String, String)> {
    let mut actions = Vec::new();
    if let Some(record) = contents.records.get(key) {
        let reason = format!("input of {}", record.stage);
        actions.extend(record.made_of.iter().map(|key| (key.clone(), reason.clone())));
    }
    if let Some(Some(action)) = contents.unfinished.get(key) {
        let reason = format!("input of {}", action.stage);
        actions.extend(action.made_of.iter().map(|key| (key.clone(), reason.clone())));
    }
    actions
}

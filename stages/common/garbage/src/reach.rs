use std::collections::BTreeMap;

use crate::contents::Contents;
use crate::roots::Root;

/// What roots reach, and why it stays.
#[derive(Debug, Default)]
pub(crate) struct Kept {
    /// By key.
    pub(crate) records: BTreeMap<String, String>,
    /// By identity.
    pub(crate) objects: BTreeMap<String, String>,
    /// By key.
    pub(crate) unfinished: BTreeMap<String, String>,
}

/// From the roots to the records and unfinished actions that they name and, where a root asks for
/// it, on to the actions that those were made of.
pub(crate) fn reach(contents: &Contents, roots: &[Root]) -> Kept {
    let mut kept = Kept::default();
    for root in roots {
        let fitting = contents
            .records
            .iter()
            .filter(|(_, record)| root.waiting.iter().any(|node| node.may_be(record)));
        let mut open: Vec<(String, String)> = root
            .keys
            .iter()
            .chain(fitting.map(|(key, _)| key))
            .map(|key| (key.clone(), root.why.clone()))
            .collect();
        let mut seen = std::collections::BTreeSet::new();
        while let Some((key, why)) = open.pop() {
            if !seen.insert(key.clone()) {
                continue;
            }
            if root.with_inputs {
                open.extend(made_of(contents, &key));
            }
            if contents.unfinished.contains_key(&key) {
                kept.unfinished.entry(key.clone()).or_insert_with(|| why.clone());
            }
            if let Some(record) = contents.records.get(&key) {
                kept.objects.entry(record.output.clone()).or_insert_with(|| why.clone());
                kept.records.entry(key).or_insert(why);
            }
        }
    }
    kept
}

/// The actions that an action was made of, and why they stay.
fn made_of(contents: &Contents, key: &str) -> Vec<(String, String)> {
    let finished = contents.records.get(key).map(|record| (&record.stage, &record.made_of));
    let unfinished = contents
        .unfinished
        .get(key)
        .and_then(Option::as_ref)
        .map(|action| (&action.stage, &action.made_of));
    let parents = [finished, unfinished].into_iter().flatten();
    parents
        .flat_map(|(stage, keys)| {
            keys.iter().map(move |key| (key.clone(), format!("{stage} was made of it")))
        })
        .collect()
}

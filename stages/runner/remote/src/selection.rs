use std::collections::{BTreeMap, BTreeSet};

use artifact::Failure;
use store::{Record, Store, StoreError};

/// Selection of the actions to copy.
#[derive(clap::Args, Clone, Debug, Default)]
pub(crate) struct Selection {
    /// Copy only this action, given by its key or the beginning of it; may be repeated
    #[arg(long = "key", value_name = "KEY")]
    pub(crate) keys: Vec<String>,
    /// Copy only the actions that created this artifact, given by its hash or the beginning of it;
    /// may be repeated
    #[arg(long = "artifact", value_name = "HASH")]
    pub(crate) artifacts: Vec<String>,
    /// Also copy the actions that created the inputs of the selected actions, directly or not
    #[arg(long)]
    pub(crate) history: bool,
}

impl Selection {
    /// True if all actions are selected.
    pub(crate) fn is_all(&self) -> bool {
        self.keys.is_empty() && self.artifacts.is_empty()
    }

    /// Returns the keys of the selected actions among `records`. Messages call the records' store
    /// `location`.
    pub(crate) fn keys_among(
        &self,
        records: &BTreeMap<String, Record>,
        location: &str,
    ) -> anyhow::Result<BTreeSet<String>> {
        if self.is_all() {
            return Ok(records.keys().cloned().collect());
        }
        let mut selected = BTreeSet::new();
        for start in &self.keys {
            selected.insert(find_unique(start, records.keys(), "action", location)?);
        }
        for start in &self.artifacts {
            let outputs = records.values().map(|record| &record.output);
            let hash = find_unique(start, outputs, "artifact", location)?;
            selected.extend(keys_of_artifact(records, &hash));
        }
        Ok(if self.history { with_history(records, selected) } else { selected })
    }
}

/// Reads all records of a store.
pub(crate) fn records_by_key(store: &Store) -> Result<BTreeMap<String, Record>, StoreError> {
    Ok(store.records()?.into_iter().map(|record| (record.key(), record)).collect())
}

/// Returns the keys of the actions that created an artifact.
pub(crate) fn keys_of_artifact(records: &BTreeMap<String, Record>, hash: &str) -> BTreeSet<String> {
    let matching = records.iter().filter(|(_, record)| record.output == hash);
    matching.map(|(key, _)| key.clone()).collect()
}

/// Adds the keys of all actions that created inputs, directly or not, as far as recorded.
pub(crate) fn with_history(
    records: &BTreeMap<String, Record>,
    keys: BTreeSet<String>,
) -> BTreeSet<String> {
    let mut open: Vec<String> = keys.into_iter().collect();
    let mut found = BTreeSet::new();
    while let Some(key) = open.pop() {
        let Some(record) = records.get(&key) else { continue };
        if found.insert(key) {
            open.extend(record.made_of.iter().cloned());
        }
    }
    found
}

/// Returns the only name that begins with `start`; `noun` describes the names in messages.
pub(crate) fn find_unique<'a>(
    start: &str,
    names: impl Iterator<Item = &'a String>,
    noun: &str,
    location: &str,
) -> anyhow::Result<String> {
    let found: BTreeSet<&String> =
        names.filter(|name| !start.is_empty() && name.starts_with(start)).collect();
    let problem = match found.len() {
        1 => return Ok(found.into_iter().cloned().collect()),
        0 => format!(
            "{location}: no {noun} {start:?}; on the machine that computed it, `nerf-sr status \
            --json` lists keys and hashes"
        ),
        count => {
            format!("{location}: {count} matches for {noun} {start:?}; give more characters")
        }
    };
    Err(Failure::Usage(problem).into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(output: &str, made_of: &[&str]) -> Record {
        Record {
            output: output.to_owned(),
            made_of: made_of.iter().map(|&key| key.to_owned()).collect(),
            ..Record::default()
        }
    }

    fn records() -> BTreeMap<String, Record> {
        let all = [
            ("k1", record("h1", &[])),
            ("k2", record("h1", &["k1", "gone"])),
            ("k3", record("h3", &["k2"])),
        ];
        all.into_iter().map(|(key, record)| (key.to_owned(), record)).collect()
    }

    #[test]
    fn selections_resolve_to_keys_or_an_error() {
        let owned = |list: &[&str]| list.iter().map(|&text| text.to_owned()).collect::<Vec<_>>();
        for (keys, artifacts, history, expected) in [
            (&[][..], &[][..], false, Ok(&["k1", "k2", "k3"][..])),
            (&["k3"], &[], false, Ok(&["k3"])),
            (&["k3"], &[], true, Ok(&["k1", "k2", "k3"])),
            (&[], &["h1"], false, Ok(&["k1", "k2"])),
            (&["k1"], &["h3"], false, Ok(&["k1", "k3"])),
            (&["k"], &[], false, Err("3 matches for action \"k\"")),
            (&["x"], &[], false, Err("there: no action \"x\"")),
            (&[""], &[], false, Err("no action \"\"")),
            (&[], &["h2"], false, Err("no artifact \"h2\"")),
        ] {
            let selection = Selection { keys: owned(keys), artifacts: owned(artifacts), history };
            match (selection.keys_among(&records(), "there"), expected) {
                (Ok(found), Ok(expected)) => {
                    assert_eq!(found.into_iter().collect::<Vec<_>>(), expected);
                }
                (Err(error), Err(expected)) => {
                    assert!(error.to_string().contains(expected), "{error}");
                }
                (found, expected) => panic!("found {found:?}, expected {expected:?}"),
            }
        }
    }
}

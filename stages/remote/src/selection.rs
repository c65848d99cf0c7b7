use std::collections::{BTreeMap, BTreeSet};

use artifact::{Failure, counted};
use store::Record;

/// Which actions are copied.
#[derive(clap::Args, Clone, Debug, Default)]
pub(crate) struct Selection {
    /// Only this action, by its key or how that begins; may be given several times
    #[arg(long = "key", value_name = "KEY")]
    pub(crate) keys: Vec<String>,
    /// Only the actions that made this artifact, by its hash or how that begins; may be given
    /// several times
    #[arg(long = "artifact", value_name = "HASH")]
    pub(crate) artifacts: Vec<String>,
    /// Also the actions that those were made of
    #[arg(long)]
    pub(crate) history: bool,
}

impl Selection {
    /// Keys of the actions that are meant, out of these records. `place` is where they lie, in
    /// words.
    pub(crate) fn of(
        &self,
        records: &BTreeMap<String, Record>,
        place: &str,
    ) -> anyhow::Result<BTreeSet<String>> {
        if self.keys.is_empty() && self.artifacts.is_empty() {
            return Ok(records.keys().cloned().collect());
        }
        let mut selected = BTreeSet::new();
        for start in &self.keys {
            selected.insert(one(start, records.keys(), "action", place)?);
        }
        for start in &self.artifacts {
            let identity =
                one(start, records.values().map(|record| &record.output), "artifact", place)?;
            selected.extend(
                records
                    .iter()
                    .filter(|(_, record)| record.output == identity)
                    .map(|(key, _)| key.clone()),
            );
        }
        Ok(if self.history { with_history(records, selected) } else { selected })
    }
}

/// Keys, and those of all actions that they were made of, where there is a record of them.
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

/// The one name that begins so.
pub(crate) fn one<'a>(
    start: &str,
    names: impl Iterator<Item = &'a String>,
    what: &str,
    place: &str,
) -> anyhow::Result<String> {
    let found: BTreeSet<&String> =
        names.filter(|name| !start.is_empty() && name.starts_with(start)).collect();
    let problem = match found.len() {
        1 => return Ok(found.into_iter().cloned().collect()),
        0 => format!("{place}: no {what} {start:?}; `nerf-sr status` shows what there is"),
        count => format!("{place}: {} begin with {start:?}; give more of it", counted(count, what)),
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
    fn selections() {
        let words = |list: &[&str]| list.iter().map(|&word| word.to_owned()).collect::<Vec<_>>();
        for (keys, artifacts, history, expected) in [
            (&[][..], &[][..], false, Ok(&["k1", "k2", "k3"][..])),
            (&["k3"], &[], false, Ok(&["k3"])),
            (&["k3"], &[], true, Ok(&["k1", "k2", "k3"])),
            (&[], &["h1"], false, Ok(&["k1", "k2"])),
            (&["k1"], &["h3"], false, Ok(&["k1", "k3"])),
            (&["k"], &[], false, Err("3 actions begin with \"k\"")),
            (&["x"], &[], false, Err("there: no action \"x\"")),
            (&[""], &[], false, Err("no action \"\"")),
            (&[], &["h2"], false, Err("no artifact \"h2\"")),
        ] {
            let selection = Selection { keys: words(keys), artifacts: words(artifacts), history };
            match (selection.of(&records(), "there"), expected) {
                (Ok(found), Ok(expected)) => {
                    assert_eq!(found.into_iter().collect::<Vec<_>>(), expected);
                }
                (Err(error), Err(expected)) => {
                    assert!(error.to_string().contains(expected), "{error}");
                }
                (found, expected) => panic!("{found:?} where {expected:?}"),
            }
        }
    }
}

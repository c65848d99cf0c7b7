//! What may go: records that the pipeline doesn't come to any more, and objects that no record names.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use artifact::{Store, StoreError};

/// What `gc` would remove, for people: one line each.
pub(crate) struct Garbage {
    pub(crate) lines: Vec<String>,
    pub(crate) bytes: u64,
    records: Vec<String>,
    objects: Vec<String>,
    partials: Vec<String>,
}

/// An object younger than this may belong to a run that is about to write its record.
const GRACE: Duration = Duration::from_secs(3600);

/// Finds what is neither named by `keep` (keys the present pipeline comes to) nor younger than `days`.
pub(crate) fn find(store: &Store, keep: &BTreeSet<String>, days: u64) -> Result<Garbage, StoreError> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let old = |unix: u64| now.saturating_sub(unix) >= days * 86_400;
    let (mut garbage, mut live) =
        (Garbage { lines: vec![], bytes: 0, records: vec![], objects: vec![], partials: vec![] }, BTreeSet::new());
    let mut makers: BTreeMap<String, String> = BTreeMap::new();
    for record in store.records()? {
        let key = record.key();
        if keep.contains(&key) || !old(record.started_unix) {
            live.insert(record.output);
        } else {
            let point = if record.point.is_empty() { String::new() } else { format!(" [{}]", record.point) };
            let age = now.saturating_sub(record.started_unix) / 3600;
            makers.insert(record.output, format!("{}{point}, {age} h old", record.stage));
            garbage.records.push(key);
        }
    }
    for object in store.objects()? {
        let age = std::fs::metadata(store.object(&object)).and_then(|m| m.modified()).ok().and_then(|t| t.elapsed().ok());
        let named = makers.get(&object);
        if live.contains(&object) || (named.is_none() && age.is_none_or(|a| a < GRACE)) {
            continue;
        }
        let bytes = store.manifest(&object).map_or(0, |m| m.size());
        garbage.bytes += bytes;
        garbage.lines.push(format!(
            "{}  {:>9.1} MB  {}",
            &object[..10.min(object.len())],
            bytes as f64 / 1e6,
            named.map_or("no record names it", String::as_str)
        ));
        garbage.objects.push(object);
    }
    for partial in store.partials()? {
        let folder = store.partial(&partial);
        let age = std::fs::metadata(&folder).and_then(|m| m.modified()).ok().and_then(|t| t.elapsed().ok());
        if !keep.contains(&partial) && age.is_some_and(|a| a > GRACE && a.as_secs() >= days * 86_400) {
            garbage.lines.push(format!("{}  checkpoints of an unfinished action", &partial[..10.min(partial.len())]));
            garbage.partials.push(partial);
        }
    }
    Ok(garbage)
}

impl Garbage {
    /// Removes it: records first, so that none names an object that is gone.
    pub(crate) fn remove(&self, store: &Store) -> Result<(), StoreError> {
        self.records.iter().try_for_each(|key| store.remove_record(key))?;
        self.objects.iter().try_for_each(|object| store.remove_object(object))?;
        self.partials.iter().try_for_each(|key| store.remove_partial(key))
    }
}

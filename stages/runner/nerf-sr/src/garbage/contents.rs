use std::collections::{BTreeMap, BTreeSet};

use artifact::Damage;
use store::{Record, Store, StoreError, Unfinished};

use crate::garbage::roots::Root;

/// Records, objects and unfinished actions of a store.
pub(crate) struct Contents {
    /// Records by key.
    pub(crate) records: BTreeMap<String, Record>,
    /// Keys of all records and logs.
    pub(crate) action_keys: Vec<String>,
    /// Size of each object in bytes, by identity (content hash).
    pub(crate) objects: BTreeMap<String, u64>,
    /// Keys of finished actions whose working folders still exist.
    pub(crate) leftover_partials: Vec<String>,
    /// Unfinished actions by key; `None` if the action's description is missing.
    pub(crate) unfinished: BTreeMap<String, Option<Unfinished>>,
}

/// Entries of a store that some root reaches, each with a reason: the reason of the first root
/// that reaches it, or `input of STAGE`.
#[derive(Debug, Default)]
pub(crate) struct Kept {
    /// Reasons by the key of an action with a record, or of an unfinished one.
    pub(crate) actions: BTreeMap<String, String>,
    /// Reasons by identity (content hash).
    pub(crate) objects: BTreeMap<String, String>,
}

impl Contents {
    /// Reads a store. Fails if an entry can't be read or a record is damaged: the artifacts that
    /// such a record needs would be unknown, and deleted.
    pub(crate) fn read(store: &Store) -> Result<Self, StoreError> {
        let action_keys = store.action_keys()?;
        let mut records = BTreeMap::new();
        for key in &action_keys {
            if let Some(record) = store.undamaged_record(key)? {
                records.insert(key.clone(), record);
            }
        }
        let mut objects = BTreeMap::new();
        for identity in store.objects()? {
            let bytes = object_bytes(store, &identity)?;
            objects.insert(identity, bytes);
        }
        let leftover_partials = store.leftover_partials()?;
        let mut unfinished = BTreeMap::new();
        for key in store.partials()?.into_iter().filter(|key| !leftover_partials.contains(key)) {
            let action = store.unfinished(&key)?;
            unfinished.insert(key, action);
        }
        Ok(Self { records, action_keys, objects, leftover_partials, unfinished })
    }

    /// Marks the actions of all roots and, for roots `with_inputs`, the actions that produced their
    /// inputs.
    pub(crate) fn reach(&self, roots: &[Root]) -> Kept {
        let mut kept = Kept::default();
        for root in roots {
            let is_waiting = |record: &Record| root.waiting.iter().any(|node| node.matches(record));
            let matching = self.records.iter().filter(|(_, record)| is_waiting(record));
            let keys = root.keys.iter().chain(matching.map(|(key, _)| key));
            let mut to_visit: Vec<(String, String)> =
                keys.map(|key| (key.clone(), root.reason.clone())).collect();
            let mut seen = BTreeSet::new();
            while let Some((key, reason)) = to_visit.pop() {
                if !seen.insert(key.clone()) {
                    continue;
                }
                if root.with_inputs {
                    to_visit.extend(self.input_actions(&key));
                }
                if let Some(record) = self.records.get(&key) {
                    kept.objects.entry(record.output.clone()).or_insert_with(|| reason.clone());
                } else if !self.unfinished.contains_key(&key) {
                    continue;
                }
                kept.actions.entry(key).or_insert(reason);
            }
        }
        kept
    }

    /// Returns the actions that produced an action's inputs, each with the reason for keeping it.
    fn input_actions(&self, key: &str) -> Vec<(String, String)> {
        let record = self.records.get(key).map(|record| (&record.stage, &record.made_of));
        let unfinished = self.unfinished.get(key).and_then(Option::as_ref);
        let unfinished = unfinished.map(|action| (&action.stage, &action.made_of));
        let mut actions = Vec::new();
        for (stage, made_of) in record.into_iter().chain(unfinished) {
            actions.extend(made_of.iter().map(|key| (key.clone(), format!("input of {stage}"))));
        }
        actions
    }
}

/// Returns an object's size in bytes; 0 if the object is damaged.
fn object_bytes(store: &Store, identity: &str) -> Result<u64, StoreError> {
    match store.manifest(identity) {
        Ok(manifest) => Ok(manifest.size()),
        Err(unreadable @ Damage::Unreadable { .. }) => Err(unreadable.into()),
        Err(_) => Ok(0),
    }
}

use std::collections::BTreeMap;

use artifact::Damage;
use store::{Record, Store, StoreError, Unfinished};

/// What lies in a store.
pub(crate) struct Contents {
    /// Records by key.
    pub(crate) records: BTreeMap<String, Record>,
    /// Keys of all records and logs.
    pub(crate) action_files: Vec<String>,
    /// Bytes of the objects, by identity.
    pub(crate) objects: BTreeMap<String, u64>,
    /// Actions that have finished, but whose folders of work are still there, by key.
    pub(crate) left_over: Vec<String>,
    /// Actions that haven't finished, by key; where known, what they are.
    pub(crate) unfinished: BTreeMap<String, Option<Unfinished>>,
}

impl Contents {
    /// Reads what lies in a store. What can't be read may be needed, and a damaged record doesn't
    /// tell what it needs: either is an error.
    pub(crate) fn of(store: &Store) -> Result<Self, StoreError> {
        let action_files = store.action_files()?;
        let mut records = BTreeMap::new();
        for key in &action_files {
            if let Some(record) = store.undamaged_record(key)? {
                records.insert(key.clone(), record);
            }
        }
        let mut objects = BTreeMap::new();
        for identity in store.objects()? {
            let bytes = size(store, &identity)?;
            objects.insert(identity, bytes);
        }
        let left_over = store.finished_partials()?;
        let mut unfinished = BTreeMap::new();
        for key in store.partials()?.into_iter().filter(|key| !left_over.contains(key)) {
            let action = store.unfinished(&key)?;
            unfinished.insert(key, action);
        }
        Ok(Self { records, action_files, objects, left_over, unfinished })
    }
}

/// Bytes of an object; 0 for a damaged one.
fn size(store: &Store, identity: &str) -> Result<u64, StoreError> {
    match store.manifest(identity) {
        Ok(manifest) => Ok(manifest.size()),
        Err(unreadable @ Damage::Unreadable { .. }) => Err(unreadable.into()),
        Err(_) => Ok(0),
    }
}

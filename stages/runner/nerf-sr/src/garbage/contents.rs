use std::collections::BTreeMap;

use artifact::Damage;
use store::{Record, Store, StoreError, Unfinished};

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
}

/// Returns an object's size in bytes; 0 if the object is damaged.
fn object_bytes(store: &Store, identity: &str) -> Result<u64, StoreError> {
    match store.manifest(identity) {
        Ok(manifest) => Ok(manifest.size()),
        Err(unreadable @ Damage::Unreadable { .. }) => Err(unreadable.into()),
        Err(_) => Ok(0),
    }
}

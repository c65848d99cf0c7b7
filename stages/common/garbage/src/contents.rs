use std::collections::BTreeMap;

use store::{Record, Store, StoreError, Unfinished};

/// What lies in a store.
pub(crate) struct Contents {
    /// Records by key.
    pub(crate) records: BTreeMap<String, Record>,
    /// Keys of all files beside the records, those that can't be read among them.
    pub(crate) action_files: Vec<String>,
    /// Bytes of the objects, by identity.
    pub(crate) objects: BTreeMap<String, u64>,
    /// Actions that haven't finished, by key; where known, what they are.
    pub(crate) unfinished: BTreeMap<String, Option<Unfinished>>,
}

impl Contents {
    pub(crate) fn of(store: &Store) -> Result<Self, StoreError> {
        let objects = store.objects()?.into_iter();
        Ok(Self {
            records: store.records()?.into_iter().map(|record| (record.key(), record)).collect(),
            action_files: store.action_files()?,
            objects: objects
                .map(|identity| {
                    (identity.clone(), store.manifest(&identity).map_or(0, |m| m.size()))
                })
                .collect(),
            unfinished: store
                .partials()?
                .into_iter()
                .map(|key| (key.clone(), store.unfinished(&key)))
                .collect(),
        })
    }
}

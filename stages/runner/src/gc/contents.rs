use std::collections::{BTreeMap, BTreeSet};

use artifact::{Manifest, Record, Store, StoreError, Unfinished};
use serde_json::{Map, Value};

/// What lies in a store.
pub(super) struct Contents {
    /// Records by key.
    pub(super) records: BTreeMap<String, Record>,
    /// Keys of all files beside the records, those that can't be read among them.
    pub(super) action_files: Vec<String>,
    /// Objects by identity.
    pub(super) objects: BTreeMap<String, Object>,
    /// Actions that haven't finished, by key; where known, what they are.
    pub(super) unfinished: BTreeMap<String, Option<Unfinished>>,
    /// The objects that an input's content hash may mean.
    by_content: BTreeMap<String, BTreeSet<String>>,
    /// The keys of the records that made an object.
    makers: BTreeMap<String, BTreeSet<String>>,
}

/// An object, as far as it matters here.
pub(super) struct Object {
    pub(super) bytes: u64,
}

impl Contents {
    pub(super) fn of(store: &Store) -> Result<Self, StoreError> {
        let mut contents = Self {
            records: store.records()?.into_iter().map(|record| (record.key(), record)).collect(),
            action_files: store.action_files()?,
            objects: BTreeMap::new(),
            unfinished: store.partials()?.into_iter().map(|key| (key.clone(), store.unfinished(&key))).collect(),
            by_content: BTreeMap::new(),
            makers: BTreeMap::new(),
        };
        for (key, record) in &contents.records {
            contents.makers.entry(record.output.clone()).or_default().insert(key.clone());
        }
        for identity in store.objects()? {
            let manifest = store.manifest(&identity).ok();
            contents.by_content.entry(identity.clone()).or_default().insert(identity.clone());
            for hash in manifest.iter().flat_map(subtrees) {
                contents.by_content.entry(hash).or_default().insert(identity.clone());
            }
            contents.objects.insert(identity, Object { bytes: manifest.map_or(0, |m| m.size()) });
        }
        Ok(contents)
    }

    /// The objects that an action's key names as inputs.
    pub(super) fn inputs<'a>(&'a self, key_parts: &'a Map<String, Value>) -> impl Iterator<Item = &'a String> {
        let hashes = key_parts.iter().filter(|(name, _)| name.starts_with("input ")).filter_map(|(_, hash)| hash.as_str());
        hashes.filter_map(|hash| self.by_content.get(hash)).flatten()
    }

    /// The keys of the records that made an object.
    pub(super) fn makers(&self, object: &str) -> impl Iterator<Item = &String> {
        self.makers.get(object).into_iter().flatten()
    }
}

/// Content hashes of all folders of an artifact.
fn subtrees(manifest: &Manifest) -> Vec<String> {
    let folders: BTreeSet<&str> =
        manifest.files.iter().flat_map(|file| file.path.match_indices('/').map(|(at, _)| &file.path[..at])).collect();
    folders.into_iter().map(|folder| manifest.subtree(folder).identity()).collect()
}

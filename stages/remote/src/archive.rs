//! The file that `export` writes and `import` reads: a tar of `export.json`, `objects/HASH/…` and
//! `actions/KEY.json`, in this order. Whatever stands in `export.json` follows, sorted, and nothing
//! else: each object's manifest, then its files in the manifest's order, then the records. Equal
//! histories make equal bytes.

use serde::{Deserialize, Serialize};

/// The first entry.
pub(crate) const INDEX: &str = "export.json";
/// Version of this form.
pub(crate) const EXPORT: u32 = 1;

/// `export.json`: what follows.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Index {
    /// Version of the archive's form.
    pub(crate) export: u32,
    /// Version of the store that manifests and records come from.
    pub(crate) store: u32,
    /// The artifact that this is about.
    pub(crate) artifact: String,
    /// Artifacts that follow, sorted.
    pub(crate) objects: Vec<String>,
    /// Keys of the records that follow, sorted.
    pub(crate) actions: Vec<String>,
}

/// Where an object's file stands.
pub(crate) fn object_entry(identity: &str, file: &str) -> String {
    format!("objects/{identity}/{file}")
}

/// Where a record stands.
pub(crate) fn action_entry(key: &str) -> String {
    format!("actions/{key}.json")
}

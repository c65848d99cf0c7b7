use std::fs;
use std::io;

use artifact::{MANIFEST_FILE, Manifest, hash_json, write_atomically};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::error::{StoreError, at};
use crate::folder::Store;
use crate::lock::Entered;

/// Version of a key's list of parts: names of parameters changed between 1 and 2.
pub const KEY_VERSION: u64 = 2;
/// The part that holds it.
pub const KEY_VERSION_PART: &str = "key version";

/// `actions/KEY.json`: the whole key and what came of it. A field of a later version is passed
/// over.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Record {
    /// Name of the stage's block in pipeline.yaml.
    pub stage: String,
    /// The sweep's point, e.g. `supersample=2`; empty without a sweep.
    pub point: String,
    /// Every part of the key, by name. The key is the blake3 of this map's canonical JSON.
    pub key_parts: Map<String, Value>,
    /// Keys of the actions that made its inputs.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub made_of: Vec<String>,
    /// Identity of the artifact that came out.
    pub output: String,
    /// When it started, seconds since 1970.
    pub started_unix: u64,
    /// How long it took.
    pub seconds: f64,
    /// Threads it had.
    pub threads: usize,
    /// Peak resident memory of its process, in bytes; records of earlier versions have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory: Option<u64>,
    /// Processor time of all its threads, in seconds; records of earlier versions have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub processor_seconds: Option<f64>,
    /// Where it ran.
    pub host: String,
    /// What its `summary.txt` says, so that nothing of an artifact is read to show it; records of
    /// earlier versions have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub summary: Option<String>,
}

impl Record {
    /// Whether its key is of an older version: no plan comes to it any more, though what it names
    /// may still be wanted.
    pub fn has_old_key(&self) -> bool {
        self.key_parts.get(KEY_VERSION_PART).and_then(Value::as_u64) != Some(KEY_VERSION)
    }

    /// The action's key.
    pub fn key(&self) -> String {
        hash_json(&self.key_parts)
    }
}

/// `partial/KEY/action.json`: an action that was begun.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Unfinished {
    /// Name of the stage's block in pipeline.yaml.
    pub stage: String,
    /// The sweep's point.
    pub point: String,
    /// Every part of the key, by name.
    pub key_parts: Map<String, Value>,
    /// Keys of the actions that made its inputs.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub made_of: Vec<String>,
    /// When it was begun, seconds since 1970.
    pub started_unix: u64,
}

impl Store {
    /// The record of a key, if the action was done and its object is whole (sizes only; see
    /// [`Store::verify`]).
    pub fn hit(&self, key: &str) -> Option<Record> {
        self.record(key).filter(|record| self.is_whole(&record.output))
    }

    /// As [`Store::hit`], and where an object's files are whole but its manifest is missing, cut
    /// short or another's, that is written again. `kind` is what the stage makes.
    pub fn hit_or_repair(&self, _: &Entered, key: &str, kind: &str) -> Option<Record> {
        if let Some(record) = self.hit(key) {
            return Some(record);
        }
        let record = self.record(key)?;
        let object = self.object(&record.output);
        let found = Manifest::of_folder(kind, &object).ok()?;
        if found.identity() != record.output {
            return None;
        }
        let mut text = serde_json::to_string_pretty(&found).ok()?;
        text.push('\n');
        write_atomically(&object.join(MANIFEST_FILE), text.as_bytes()).ok()?;
        self.hit(key)
    }

    /// The record of a key. One that doesn't parse counts as absent: the action is run again.
    pub fn record(&self, key: &str) -> Option<Record> {
        let bytes = fs::read(self.action(key, "json")).ok()?;
        serde_json::from_slice(&bytes).ok()
    }

    /// All records, sorted by key.
    pub fn records(&self) -> Result<Vec<Record>, StoreError> {
        let keys = self.names("actions")?;
        Ok(keys.iter().filter_map(|name| self.record(name.strip_suffix(".json")?)).collect())
    }

    /// Keys that have any file among the actions, sorted: records that can't be read are among
    /// them.
    pub fn action_files(&self) -> Result<Vec<String>, StoreError> {
        let names = self.names("actions")?;
        let mut keys: Vec<String> =
            names.iter().filter_map(|name| Some(name.rsplit_once('.')?.0.to_owned())).collect();
        keys.dedup();
        Ok(keys)
    }

    /// Keys of actions that haven't finished, sorted.
    pub fn partials(&self) -> Result<Vec<String>, StoreError> {
        self.names("partial")
    }

    /// An action that was begun, where its file is whole.
    pub fn unfinished(&self, key: &str) -> Option<Unfinished> {
        serde_json::from_slice(&fs::read(self.partial(key).join("action.json")).ok()?).ok()
    }

    /// Whether an unfinished action left a checkpoint.
    pub fn has_checkpoint(&self, key: &str) -> bool {
        let files = walkdir::WalkDir::new(self.partial(key).join("work")).into_iter().flatten();
        files.into_iter().any(|entry| entry.file_type().is_file())
    }

    /// Writes a record, in place of the one that its key has.
    pub(crate) fn write_record(&self, record: &Record) -> Result<(), StoreError> {
        let path = self.action(&record.key(), "json");
        let mut text = serde_json::to_string_pretty(record)
            .map_err(|e| StoreError::NoArtifact(e.to_string()))?;
        text.push('\n');
        at(&path, write_atomically(&path, text.as_bytes()))
    }

    /// Removes an action's record and log.
    pub fn remove_record(&self, key: &str) -> Result<(), StoreError> {
        // The record goes first: a log without a record is only a log.
        for path in [self.action(key, "json"), self.action(key, "log")] {
            match fs::remove_file(&path) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                result => at(&path, result)?,
            }
        }
        Ok(())
    }

    /// Removes an unfinished action with its checkpoints.
    pub fn remove_partial(&self, key: &str) -> Result<(), StoreError> {
        self.discard(&self.partial(key))
    }
}

#[cfg(test)]
mod tests {
    use artifact::Damage;

    use super::*;
    use crate::testing::{entered, make};

    #[test]
    fn a_lost_file_is_a_miss_and_a_flipped_byte_is_found() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let done = make(&store, "a", "1234");
        fs::write(store.object(&done.output).join("x"), "1235").unwrap();
        assert!(matches!(store.verify(&done.output), Err(Damage::Content { .. })));
        fs::remove_file(store.object(&done.output).join("x")).unwrap();
        assert_eq!(store.hit(&done.key()), None);
        assert_eq!(store.hit_or_repair(&entered(&store), &done.key(), "text"), None);
        // Made again, the damaged object is replaced.
        make(&store, "a", "1234");
        store.verify(&done.output).unwrap();
    }

    /// Whatever became of a manifest, it is written again; whatever stands in an object's place, it
    /// gives way to the object.
    #[test]
    fn manifests_are_repaired_and_objects_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let (done, other) = (make(&store, "a", "1234"), make(&store, "b", "other"));
        let (object, manifest) =
            (store.object(&done.output), store.object(&done.output).join(MANIFEST_FILE));
        let foreign = fs::read(store.object(&other.output).join(MANIFEST_FILE)).unwrap();
        for damage in [None, Some(&b""[..]), Some(&b"{}"[..]), Some(&foreign[..])] {
            fs::remove_file(&manifest).unwrap();
            if let Some(bytes) = damage {
                fs::write(&manifest, bytes).unwrap();
            }
            assert_eq!(store.hit(&done.key()), None);
            assert_eq!(
                store.hit_or_repair(&entered(&store), &done.key(), "text").as_ref(),
                Some(&done)
            );
            store.verify(&done.output).unwrap();
        }
        fs::remove_dir_all(&object).unwrap();
        fs::write(&object, "a file").unwrap();
        assert_eq!(store.hit_or_repair(&entered(&store), &done.key(), "text"), None);
        assert_eq!(make(&store, "a", "1234"), done);
        fs::remove_file(&manifest).unwrap();
        assert_eq!(make(&store, "a", "1234"), done);
        store.verify(&done.output).unwrap();
        store.empty_trash().unwrap();
        assert_eq!(fs::read_dir(dir.path().join("trash")).unwrap().count(), 0);
    }
}

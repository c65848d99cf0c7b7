use std::fs;
use std::io;

use artifact::{hash_json, write_json_atomically};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::error::{StoreError, at, read_if_found};
use crate::folder::Store;
use crate::lock::Entered;
use crate::objects::is_hash;

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
    pub fn hit(&self, key: &str) -> Result<Option<Record>, StoreError> {
        let Some(record) = self.record(key)? else { return Ok(None) };
        Ok(self.is_whole(&record.output)?.then_some(record))
    }

    /// As [`Store::hit`], and where an object's files are whole but its manifest is missing, cut
    /// short or another's, that is written again. `kind` is what the stage makes.
    pub fn hit_or_repair(
        &self,
        _: &Entered,
        key: &str,
        kind: &str,
    ) -> Result<Option<Record>, StoreError> {
        let Some(record) = self.record(key)? else { return Ok(None) };
        let is_whole = self.is_whole(&record.output)? || self.repair(&record.output, kind)?;
        Ok(is_whole.then_some(record))
    }

    /// The record of a key. A damaged one counts as absent: the action is run again.
    pub fn record(&self, key: &str) -> Result<Option<Record>, StoreError> {
        match self.undamaged_record(key) {
            Err(StoreError::Content { .. }) => Ok(None),
            record => record,
        }
    }

    /// The record of a key. A damaged one, or one of another key, is [`StoreError::Content`].
    pub fn undamaged_record(&self, key: &str) -> Result<Option<Record>, StoreError> {
        let path = self.action(key, "json");
        let Some(bytes) = read_if_found(&path)? else { return Ok(None) };
        let problem = match serde_json::from_slice::<Record>(&bytes) {
            Ok(record) if record.key() == key => return Ok(Some(record)),
            Ok(_) => "the record is of another action".to_owned(),
            Err(error) => format!("the record is damaged: {error}"),
        };
        let remedy = "`nerf-sr verify --remove` removes it".to_owned();
        Err(StoreError::Content { path, problem, remedy })
    }

    /// All records, sorted by key, without the damaged ones.
    pub fn records(&self) -> Result<Vec<Record>, StoreError> {
        let mut records = Vec::new();
        for key in self.action_files()? {
            records.extend(self.record(&key)?);
        }
        Ok(records)
    }

    /// Keys that have any file among the actions, sorted: those of damaged records are among them.
    pub fn action_files(&self) -> Result<Vec<String>, StoreError> {
        let mut keys = Vec::new();
        for name in self.names("actions")? {
            // Other names are somebody else's.
            if let Some((key, "json" | "log")) = name.rsplit_once('.')
                && is_hash(key)
            {
                keys.push(key.to_owned());
            }
        }
        keys.dedup();
        Ok(keys)
    }

    /// Keys of actions that haven't finished, sorted.
    pub fn partials(&self) -> Result<Vec<String>, StoreError> {
        self.names("partial")
    }

    /// An action that was begun, where its file is whole: a kill may have cut the file short.
    pub fn unfinished(&self, key: &str) -> Result<Option<Unfinished>, StoreError> {
        let bytes = read_if_found(&self.partial(key).join("action.json"))?;
        Ok(bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok()))
    }

    /// Whether an unfinished action left a checkpoint.
    pub fn has_checkpoint(&self, key: &str) -> Result<bool, StoreError> {
        let work = self.partial(key).join("work");
        for entry in walkdir::WalkDir::new(&work) {
            match entry {
                Ok(entry) if entry.file_type().is_file() => return Ok(true),
                Ok(_) => {}
                Err(error) => {
                    let path = error.path().unwrap_or(&work).to_path_buf();
                    let source = io::Error::from(error);
                    if source.kind() != io::ErrorKind::NotFound {
                        return Err(StoreError::Io { path, source });
                    }
                }
            }
        }
        Ok(false)
    }

    /// Writes a record, in place of the one that its key has.
    pub(crate) fn write_record(&self, record: &Record) -> Result<(), StoreError> {
        let path = self.action(&record.key(), "json");
        at(&path, write_json_atomically(&path, record))
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
    use artifact::{Damage, MANIFEST_FILE};

    use super::*;
    use crate::testing::{UNREADABLE, begin, entered, make};

    #[test]
    fn a_lost_file_is_a_miss_and_a_flipped_byte_is_found() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let done = make(&store, "a", "1234");
        fs::write(store.object(&done.output).join("x"), "1235").unwrap();
        assert!(matches!(store.verify(&done.output), Err(Damage::Content { .. })));
        fs::remove_file(store.object(&done.output).join("x")).unwrap();
        assert_eq!(store.hit(&done.key()).unwrap(), None);
        assert_eq!(store.hit_or_repair(&entered(&store), &done.key(), "text").unwrap(), None);
        // Made again, the damaged object is replaced.
        make(&store, "a", "1234");
        store.verify(&done.output).unwrap();
    }

    /// A record that can't be read is no missing one; each look names it.
    #[test]
    fn unreadable_records_are_errors() {
        for damage in UNREADABLE {
            let dir = tempfile::tempdir().unwrap();
            let store = Store::open(dir.path()).unwrap();
            let key = make(&store, "a", "1234").key();
            damage(&store.action(&key, "json"));
            for problem in [
                store.record(&key).err(),
                store.hit(&key).err(),
                store.hit_or_repair(&entered(&store), &key, "text").err(),
                store.records().err(),
            ] {
                let said = problem.unwrap().to_string();
                assert!(said.contains(&format!("actions/{key}.json: ")), "{said}");
            }
        }
    }

    /// A damaged record counts as absent, unless one asks for it; and so does another action's: a
    /// swapped file is no hit.
    #[test]
    fn damaged_records_are_no_hits() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let (a, b) = (make(&store, "a", "1234"), make(&store, "b", "5678"));
        let path = store.action(&a.key(), "json");
        for (bytes, words) in [
            (Vec::new(), "the record is damaged"),
            (b"{\"stage\":".to_vec(), "the record is damaged"),
            (fs::read(store.action(&b.key(), "json")).unwrap(), "of another action"),
        ] {
            fs::write(&path, bytes).unwrap();
            assert_eq!(store.hit(&a.key()).unwrap(), None);
            assert_eq!(store.records().unwrap(), std::slice::from_ref(&b));
            let said = store.undamaged_record(&a.key()).unwrap_err().to_string();
            assert!(said.contains(words) && said.contains("verify --remove"), "{said}");
        }
        fs::write(dir.path().join("actions/notes.txt"), "mine").unwrap();
        fs::write(dir.path().join("actions/notes.json"), "mine").unwrap();
        let mut keys = [a.key(), b.key()];
        keys.sort();
        assert_eq!(store.action_files().unwrap(), keys, "the others are somebody else's");
    }

    #[test]
    fn unreadable_actions_that_were_begun_are_errors() {
        for damage in UNREADABLE {
            let dir = tempfile::tempdir().unwrap();
            let store = Store::open(dir.path()).unwrap();
            let attempt = begin(&store, "a", None);
            let key = store.partials().unwrap().remove(0);
            assert!(store.unfinished(&key).unwrap().is_some());
            assert!(!store.has_checkpoint(&key).unwrap());
            let file = store.partial(&key).join("action.json");
            fs::write(&file, "{\"sta").unwrap();
            assert_eq!(store.unfinished(&key).unwrap(), None, "cut by a kill");
            damage(&file);
            let said = store.unfinished(&key).unwrap_err().to_string();
            assert!(said.contains("action.json: "), "{said}");
            fs::create_dir_all(&attempt.work).unwrap();
            fs::write(attempt.work.join("checkpoint"), "").unwrap();
            assert!(store.has_checkpoint(&key).unwrap());
        }
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
            assert_eq!(store.hit(&done.key()).unwrap(), None);
            let repaired = store.hit_or_repair(&entered(&store), &done.key(), "text").unwrap();
            assert_eq!(repaired.as_ref(), Some(&done));
            store.verify(&done.output).unwrap();
        }
        fs::remove_dir_all(&object).unwrap();
        fs::write(&object, "a file").unwrap();
        assert_eq!(store.hit_or_repair(&entered(&store), &done.key(), "text").unwrap(), None);
        assert_eq!(make(&store, "a", "1234"), done);
        fs::remove_file(&manifest).unwrap();
        assert_eq!(make(&store, "a", "1234"), done);
        store.verify(&done.output).unwrap();
        store.empty_trash().unwrap();
        assert_eq!(fs::read_dir(dir.path().join("trash")).unwrap().count(), 0);
    }
}

use std::fs;
use std::io;
use std::path::Path;

use artifact::{hash_json, write_json_atomically};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::error::{StoreError, if_found, with_path};
use crate::folder::{Store, remove_if_found};
use crate::lock::{Closed, Entered};
use crate::objects::is_hash;

/// Version of a key's list of parts; names of parameters differ between versions 1 and 2.
pub const KEY_VERSION: u64 = 2;
/// Name of the part with the version.
pub const KEY_VERSION_PART: &str = "key version";

/// `actions/KEY.json`: record of a finished action. Unknown fields, of later versions, are ignored.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Record {
    /// Name of the stage's block in pipeline.yaml.
    pub stage: String,
    /// Point of the sweep, e.g. `supersample=2`; empty without a sweep.
    pub point: String,
    /// Parts of the key, by name. The key is the blake3 of this map's canonical JSON.
    pub key_parts: Map<String, Value>,
    /// Keys of the actions that created the inputs.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub made_of: Vec<String>,
    /// Identity of the created artifact.
    pub output: String,
    /// Start time in seconds since 1970.
    pub started_unix: u64,
    /// Duration in seconds, with that of interrupted attempts whose checkpoints were used.
    pub seconds: f64,
    /// Number of threads.
    pub threads: usize,
    /// Peak resident memory of the process in bytes; missing in records of earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory: Option<u64>,
    /// Processor time of all threads in seconds, summed like `seconds`; missing in records of
    /// earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub processor_seconds: Option<f64>,
    /// Cost by the runner's model; missing for stages without a model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<ModelCost>,
    /// Name of the machine.
    pub host: String,
    /// Content of the artifact's `summary.txt`, so that displaying it doesn't read the artifact;
    /// missing in records of earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub summary: Option<String>,
}

/// Cost of an action by the runner's model, without a correction for the machine.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ModelCost {
    /// Processor time of all threads in seconds.
    pub processor_seconds: f64,
    /// Peak resident memory of the process in bytes.
    pub peak_memory: u64,
    /// Kind of scene by which the model estimated the cost of a ray; missing for stages that cast
    /// no rays, and in records of earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene: Option<SceneKind>,
}

/// Kind of scene, on which the cost of a ray depends.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SceneKind {
    /// Object before a background of one colour: most rays miss it.
    #[default]
    Object,
    /// Opaque scene in NDC.
    Frustum,
    /// Opaque scene all around the cameras.
    Unbounded,
}

impl SceneKind {
    /// Returns whether every ray hits a surface.
    pub fn is_opaque(self) -> bool {
        self != Self::Object
    }
}

impl Record {
    /// Returns whether the key has an older version. No plan yields such a key any more, but its
    /// artifact may still be needed.
    pub fn has_old_key(&self) -> bool {
        self.key_parts.get(KEY_VERSION_PART).and_then(Value::as_u64) != Some(KEY_VERSION)
    }

    /// Returns the key of the action.
    pub fn key(&self) -> String {
        hash_json(&self.key_parts)
    }
}

/// `partial/KEY/action.json`: an unfinished action.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Unfinished {
    /// Name of the stage's block in pipeline.yaml.
    pub stage: String,
    /// Point of the sweep.
    pub point: String,
    /// Parts of the key, by name.
    pub key_parts: Map<String, Value>,
    /// Keys of the actions that created the inputs.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub made_of: Vec<String>,
    /// Start time in seconds since 1970.
    pub started_unix: u64,
}

impl Store {
    /// Returns the record of a key if its object is complete. Only sizes are checked; see
    /// [`Store::verify`].
    pub fn hit(&self, key: &str) -> Result<Option<Record>, StoreError> {
        let Some(record) = self.record(key)? else { return Ok(None) };
        Ok(self.is_complete(&record.output)?.then_some(record))
    }

    /// Returns the record like [`Store::hit`], and rewrites a missing or damaged manifest of an
    /// object whose files are complete. `kind` is the kind of the object.
    pub fn hit_or_repair(
        &self,
        _: &Entered,
        key: &str,
        kind: &str,
    ) -> Result<Option<Record>, StoreError> {
        let Some(record) = self.record(key)? else { return Ok(None) };
        let is_complete = self.is_complete(&record.output)? || self.repair(&record.output, kind)?;
        Ok(is_complete.then_some(record))
    }

    /// Returns the record of a key. A damaged record counts as absent, so that the action runs
    /// again.
    pub fn record(&self, key: &str) -> Result<Option<Record>, StoreError> {
        match self.undamaged_record(key) {
            Err(StoreError::Content { .. }) => Ok(None),
            record => record,
        }
    }

    /// Returns the record of a key; [`StoreError::Content`] if it is damaged or has another key.
    pub fn undamaged_record(&self, key: &str) -> Result<Option<Record>, StoreError> {
        let path = self.action(key, "json");
        let Some(bytes) = if_found(&path, fs::read(&path))? else { return Ok(None) };
        let problem = match serde_json::from_slice::<Record>(&bytes) {
            Ok(record) if record.key() == key => return Ok(Some(record)),
            Ok(_) => "the record belongs to another action".to_owned(),
            Err(error) => format!("the record is damaged: {error}"),
        };
        let problem = problem + "; remove the record by `nerf-sr verify --remove`";
        Err(StoreError::Content { path, problem })
    }

    /// Returns all undamaged records, sorted by key.
    pub fn records(&self) -> Result<Vec<Record>, StoreError> {
        let mut records = Vec::new();
        for key in self.action_keys()? {
            records.extend(self.record(&key)?);
        }
        Ok(records)
    }

    /// Returns a record of the artifact that contains a folder; `None` for a folder elsewhere.
    pub fn record_of_folder(&self, folder: &Path) -> Result<Option<Record>, StoreError> {
        let objects = self.root().join("objects").canonicalize();
        let (Ok(objects), Ok(folder)) = (objects, folder.canonicalize()) else { return Ok(None) };
        let Ok(inside) = folder.strip_prefix(objects) else { return Ok(None) };
        let Some(identity) = inside.iter().next() else { return Ok(None) };
        Ok(self.records()?.into_iter().find(|record| record.output.as_str() == identity))
    }

    /// Returns the keys of all records and logs, sorted; including those of damaged records.
    pub fn action_keys(&self) -> Result<Vec<String>, StoreError> {
        let mut keys = Vec::new();
        for name in self.list_names("actions")? {
            // Other files don't belong to the store.
            if let Some((key, "json" | "log")) = name.rsplit_once('.')
                && is_hash(key)
            {
                keys.push(key.to_owned());
            }
        }
        keys.dedup();
        Ok(keys)
    }

    /// Returns the keys of unfinished actions, sorted.
    pub fn partials(&self) -> Result<Vec<String>, StoreError> {
        self.list_names("partial")
    }

    /// Returns an unfinished action; `None` if its file is missing or truncated by a kill.
    pub fn unfinished(&self, key: &str) -> Result<Option<Unfinished>, StoreError> {
        let path = self.partial(key).join("action.json");
        let bytes = if_found(&path, fs::read(&path))?;
        Ok(bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok()))
    }

    /// Returns whether an unfinished action has a checkpoint.
    pub fn has_checkpoint(&self, key: &str) -> Result<bool, StoreError> {
        let work = self.partial(key).join("work");
        for entry in walkdir::WalkDir::new(&work) {
            let path = entry.as_ref().map_or_else(|e| e.path().unwrap_or(&work), |e| e.path());
            let path = path.to_path_buf();
            let entry = if_found(&path, entry.map_err(io::Error::from))?;
            if entry.is_some_and(|entry| entry.file_type().is_file()) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Writes a record, and replaces an existing one of the key.
    pub(crate) fn write_record(&self, record: &Record) -> Result<(), StoreError> {
        let path = self.action(&record.key(), "json");
        with_path(&path, write_json_atomically(&path, record))
    }

    /// Removes an action's record and log.
    pub fn remove_record(&self, key: &str) -> Result<(), StoreError> {
        // The record is removed first, since a log without a record is harmless.
        for path in [self.action(key, "json"), self.action(key, "log")] {
            if_found(&path, fs::remove_file(&path))?;
        }
        Ok(())
    }

    /// Removes an unfinished action with its checkpoints.
    pub fn remove_partial(&self, key: &str) -> Result<(), StoreError> {
        self.move_to_trash(&self.partial(key)).map(|_| ())
    }
}

/// Folders whose files are written under a temporary name first, relative to the store.
const TEMPORARY_FILE_FOLDERS: [&str; 5] = ["", "actions", "cache", "cache/sources", "pins"];

impl Store {
    /// Returns the keys of finished actions whose folder in `partial/` remains, sorted: their
    /// runners were killed right after writing the record.
    pub fn leftover_partials(&self) -> Result<Vec<String>, StoreError> {
        let locked = self.locked_keys()?;
        let mut finished = Vec::new();
        for key in self.partials()? {
            if !locked.contains(&key) && self.hit(&key)?.is_some() {
                finished.push(key);
            }
        }
        Ok(finished)
    }

    /// Removes the temporary files of killed processes. Records, pins and the file `format` are
    /// written only under the lock [`Entered`](crate::Entered), which `Closed` excludes. Temporary
    /// files of `cache` may belong to a live process; a cache file that is lost is created again.
    pub fn remove_leftovers(&self, _: &Closed) -> Result<(), StoreError> {
        for folder in TEMPORARY_FILE_FOLDERS {
            let folder = self.root().join(folder);
            for entry in if_found(&folder, fs::read_dir(&folder))?.into_iter().flatten() {
                let entry = with_path(&folder, entry)?;
                if entry.file_name().to_str().is_some_and(is_temporary) {
                    remove_if_found(&entry.path())?;
                }
            }
        }
        Ok(())
    }
}

/// Returns whether a name is a temporary one of [`artifact::write_atomically`].
fn is_temporary(name: &str) -> bool {
    name.starts_with('.') && name.ends_with(".partial")
}

#[cfg(test)]
mod tests {
    use artifact::{Damage, MANIFEST_FILE};

    use super::*;
    use crate::lock::Locked;
    use crate::testing::{UNREADABLE, begin, entered, finish_action};

    #[test]
    fn a_lost_file_is_a_miss_and_a_flipped_byte_is_found() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let done = finish_action(&store, "a", "1234");
        fs::write(store.object(&done.output).join("x"), "1235").unwrap();
        assert!(matches!(store.verify(&done.output), Err(Damage::Content { .. })));
        fs::remove_file(store.object(&done.output).join("x")).unwrap();
        assert_eq!(store.hit(&done.key()).unwrap(), None);
        assert_eq!(store.hit_or_repair(&entered(&store), &done.key(), "text").unwrap(), None);
        // Creating the artifact again replaces the damaged object.
        finish_action(&store, "a", "1234");
        store.verify(&done.output).unwrap();
    }

    #[test]
    fn folders_of_artifacts_have_records() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(&dir.path().join("store")).unwrap();
        let done = finish_action(&store, "a", "1234");
        let object = store.object(&done.output);
        fs::create_dir(object.join("in")).unwrap();
        let link = dir.path().join("link");
        std::os::unix::fs::symlink(object.join("in"), &link).unwrap();
        for (folder, expected) in [
            (object.clone(), Some(&done)),
            (object.join("in"), Some(&done)),
            (link, Some(&done)),
            (dir.path().to_path_buf(), None),
            (store.object(""), None),
            (store.object("absent"), None),
        ] {
            let found = store.record_of_folder(&folder).unwrap();
            assert_eq!(found.as_ref(), expected, "{}", folder.display());
        }
    }

    /// An unreadable record isn't treated as missing: every access fails and names the file.
    #[test]
    fn unreadable_records_are_errors() {
        for damage in UNREADABLE {
            let dir = tempfile::tempdir().unwrap();
            let store = Store::open(dir.path()).unwrap();
            let key = finish_action(&store, "a", "1234").key();
            damage(&store.action(&key, "json"));
            for problem in [
                store.record(&key).err(),
                store.hit(&key).err(),
                store.hit_or_repair(&entered(&store), &key, "text").err(),
                store.records().err(),
            ] {
                let message = problem.unwrap().to_string();
                assert!(message.contains(&format!("actions/{key}.json: ")), "{message}");
            }
        }
    }

    /// A damaged record counts as absent, as does one of another action (a swapped file).
    #[test]
    fn damaged_records_are_no_hits() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let (a, b) = (finish_action(&store, "a", "1234"), finish_action(&store, "b", "5678"));
        let path = store.action(&a.key(), "json");
        for (bytes, expected) in [
            (Vec::new(), "the record is damaged"),
            (b"{\"stage\":".to_vec(), "the record is damaged"),
            (fs::read(store.action(&b.key(), "json")).unwrap(), "belongs to another action"),
        ] {
            fs::write(&path, bytes).unwrap();
            assert_eq!(store.hit(&a.key()).unwrap(), None);
            assert_eq!(store.records().unwrap(), std::slice::from_ref(&b));
            let message = store.undamaged_record(&a.key()).unwrap_err().to_string();
            assert!(message.contains(expected) && message.contains("verify --remove"), "{message}");
        }
        fs::write(dir.path().join("actions/notes.txt"), "mine").unwrap();
        fs::write(dir.path().join("actions/notes.json"), "mine").unwrap();
        let mut keys = [a.key(), b.key()];
        keys.sort();
        assert_eq!(store.action_keys().unwrap(), keys, "other files are ignored");
    }

    #[test]
    fn unreadable_unfinished_actions_are_errors() {
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
            let message = store.unfinished(&key).unwrap_err().to_string();
            assert!(message.contains("action.json: "), "{message}");
            fs::create_dir_all(&attempt.work).unwrap();
            fs::write(attempt.work.join("checkpoint"), "").unwrap();
            assert!(store.has_checkpoint(&key).unwrap());
        }
    }

    /// Damaged manifests are rewritten. A file at the path of an object is replaced.
    #[test]
    fn manifests_are_repaired_and_objects_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let (done, other) =
            (finish_action(&store, "a", "1234"), finish_action(&store, "b", "other"));
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
        assert_eq!(finish_action(&store, "a", "1234"), done);
        fs::remove_file(&manifest).unwrap();
        assert_eq!(finish_action(&store, "a", "1234"), done);
        store.verify(&done.output).unwrap();
        store.empty_trash().unwrap();
        assert_eq!(fs::read_dir(dir.path().join("trash")).unwrap().count(), 0);
    }

    #[test]
    fn temporary_files_of_killed_writers_are_removed() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let done = finish_action(&store, "a", "1234");
        for folder in TEMPORARY_FILE_FOLDERS {
            fs::create_dir_all(dir.path().join(folder)).unwrap();
            fs::write(dir.path().join(folder).join(".aB3xYz.partial"), "half").unwrap();
            fs::write(dir.path().join(folder).join("notes"), "mine").unwrap();
        }
        let key = done.key();
        fs::create_dir_all(store.partial(&key).join("work")).unwrap();
        begin(&store, "unfinished", None);
        let Locked::Acquired(closed) = store.try_close().unwrap() else { panic!("in use") };
        store.remove_leftovers(&closed).unwrap();
        for folder in TEMPORARY_FILE_FOLDERS {
            assert!(!dir.path().join(folder).join(".aB3xYz.partial").exists(), "{folder}");
            assert!(dir.path().join(folder).join("notes").exists(), "{folder}");
        }
        assert_eq!(store.hit(&key).unwrap(), Some(done));
        assert_eq!(store.leftover_partials().unwrap(), [key]);
    }
}

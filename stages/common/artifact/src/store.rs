use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::canonical::hash_json;
use crate::fsio::{sync_folder, write_atomically, write_json};
use crate::manifest::{Damage, MANIFEST_FILE, Manifest};

/// Artifacts by content and actions by key, in one folder.
///
/// ```text
/// objects/HASH/         an artifact: artifact.json and its files
/// actions/KEY.json      a finished action: its whole key, its output, when, where, in how long
/// actions/KEY.log       what it said
/// partial/KEY/work      checkpoints of an action that hasn't finished; never hashed
/// locks/KEY             one OS lock a key: the kernel drops it, whatever happens to the process
/// ```
///
/// An object is made in `partial/`, checked, hashed, fsynced and renamed; the record goes last. So what is recorded is whole.
#[derive(Debug, Clone)]
pub struct Store {
    root: PathBuf,
}

/// `actions/KEY.json`: the whole key and what came of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// Name of the stage's block in pipeline.yaml.
    pub stage: String,
    /// The sweep's point, e.g. `supersample=2`; empty without a sweep.
    pub point: String,
    /// Every part of the key, by name. The key is the blake3 of this map's canonical JSON.
    pub key_parts: Map<String, Value>,
    /// Identity of the artifact that came out.
    pub output: String,
    /// When it started, seconds since 1970.
    pub started_unix: u64,
    /// How long it took.
    pub seconds: f64,
    /// Threads it had.
    pub threads: usize,
    /// Where it ran.
    pub host: String,
}

impl Record {
    /// The action's key.
    pub fn key(&self) -> String {
        hash_json(&self.key_parts)
    }
}

/// What can go wrong in a store.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file operation failed.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A record or an object isn't what it should be.
    #[error(transparent)]
    Damage(#[from] Damage),
    /// A stage ended well but left no proper artifact.
    #[error("the stage ended without a proper artifact: {0}")]
    NoArtifact(String),
}

/// The lock on a key; held while it, or a process that was handed [`KeyLock::share`], lives.
#[derive(Debug)]
pub struct KeyLock {
    file: File,
}

impl KeyLock {
    /// The lock's file, to be handed to the stage (as its standard input, which reads as empty): so the lock outlives a runner
    /// that is killed while its stage is still writing.
    pub fn share(&self) -> io::Result<File> {
        self.file.try_clone()
    }
}

/// An action being carried out: where it writes.
#[derive(Debug)]
pub struct Attempt {
    /// The stage's `--output`; doesn't exist yet.
    pub output: PathBuf,
    /// The stage's `--work`; survives a failure.
    pub work: PathBuf,
    /// The stage's `--params`.
    pub params: PathBuf,
    /// What the stage says goes here.
    pub log: PathBuf,
    folder: PathBuf,
}

fn at<T>(path: &Path, result: io::Result<T>) -> Result<T, StoreError> {
    result.map_err(|source| StoreError::Io { path: path.to_path_buf(), source })
}

impl Store {
    /// Opens the store in a folder, making it where it isn't there.
    pub fn open(root: &Path) -> Result<Self, StoreError> {
        for folder in ["objects", "actions", "partial", "locks", "cache"] {
            let path = root.join(folder);
            at(&path, fs::create_dir_all(&path))?;
        }
        Ok(Self { root: root.to_path_buf() })
    }

    /// Where the store is.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Waits for the key's lock. Take it, look for the record again, then act.
    pub fn lock(&self, key: &str) -> Result<KeyLock, StoreError> {
        let path = self.root.join("locks").join(key);
        let file = at(&path, File::options().create(true).read(true).append(true).open(&path))?;
        at(&path, file.lock())?;
        Ok(KeyLock { file })
    }

    /// The record of a key, if the action was done and its object is whole (sizes only; see [`Store::verify`]).
    pub fn hit(&self, key: &str) -> Option<Record> {
        let record = self.record(key)?;
        let manifest = self.manifest(&record.output).ok()?;
        manifest.check_sizes(&self.object(&record.output)).ok()?;
        Some(record)
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

    /// Identities of all objects, sorted.
    pub fn objects(&self) -> Result<Vec<String>, StoreError> {
        self.names("objects")
    }

    /// Keys with checkpoints of an unfinished action, sorted.
    pub fn partials(&self) -> Result<Vec<String>, StoreError> {
        self.names("partial")
    }

    fn names(&self, folder: &str) -> Result<Vec<String>, StoreError> {
        let folder = self.root.join(folder);
        let entries = at(&folder, fs::read_dir(&folder))?;
        let mut names: Vec<String> =
            entries.filter_map(|e| e.ok()?.file_name().into_string().ok()).filter(|n| !n.starts_with('.')).collect();
        names.sort_unstable();
        Ok(names)
    }

    /// The folder of an object.
    pub fn object(&self, identity: &str) -> PathBuf {
        self.root.join("objects").join(identity)
    }

    /// The folder of an unfinished action.
    pub fn partial(&self, key: &str) -> PathBuf {
        self.root.join("partial").join(key)
    }

    /// An object's manifest.
    pub fn manifest(&self, identity: &str) -> Result<Manifest, Damage> {
        Manifest::read(&self.object(identity))
    }

    /// A file that belongs to an action: `json` its record, `log` what it said.
    pub fn action(&self, key: &str, extension: &str) -> PathBuf {
        self.root.join("actions").join(format!("{key}.{extension}"))
    }

    /// Begins an action, with its key locked. Leftovers of a killed attempt are cleared, its checkpoints kept.
    pub fn begin(&self, key: &str, params: &Value) -> Result<Attempt, StoreError> {
        let folder = self.partial(key);
        let attempt = Attempt {
            output: folder.join("output"),
            work: folder.join("work"),
            params: folder.join("params.json"),
            log: folder.join("log"),
            folder: folder.clone(),
        };
        at(&folder, fs::create_dir_all(&folder))?;
        for leftover in [attempt.output.clone(), folder.join(".output.partial")] {
            if leftover.exists() {
                at(&leftover, fs::remove_dir_all(&leftover))?;
            }
        }
        at(&attempt.params, write_json(&attempt.params, params))?;
        Ok(attempt)
    }

    /// Takes in what an attempt made: checks the manifest against the files, moves the object, writes the record last.
    /// The record's `output` is set to the object's identity.
    pub fn publish(&self, attempt: &Attempt, kind: &str, mut record: Record) -> Result<Record, StoreError> {
        let output = &attempt.output;
        if !output.is_dir() {
            return Err(StoreError::NoArtifact("its --output was not made".to_owned()));
        }
        let found = at(output, Manifest::of_folder(kind, output))?;
        if !output.join(MANIFEST_FILE).exists() {
            // The plainest stage of all, a script, may leave the hashing to the runner.
            let path = output.join(MANIFEST_FILE);
            at(&path, write_json(&path, &found))?;
        }
        let stated = Manifest::read(output)?;
        if stated != found {
            return Err(StoreError::NoArtifact(format!(
                "{MANIFEST_FILE} differs from the files beside it, or its kind is not {kind:?}"
            )));
        }
        if found.files.is_empty() {
            return Err(StoreError::NoArtifact("it has no files".to_owned()));
        }
        for file in &found.files {
            let path = output.join(&file.path);
            at(&path, File::open(&path).and_then(|f| f.sync_all()))?;
        }
        at(output, sync_folder(output))?;
        record.output = found.identity();
        let object = self.object(&record.output);
        if object.exists() && found.check_contents(&object).is_ok() {
            at(output, fs::remove_dir_all(output))?;
        } else {
            if object.exists() {
                at(&object, fs::remove_dir_all(&object))?;
            }
            at(&object, fs::rename(output, &object))?;
            at(&object, sync_folder(&self.root.join("objects")))?;
        }
        let key = record.key();
        let log = self.action(&key, "log");
        if attempt.log.exists() {
            at(&log, fs::rename(&attempt.log, &log))?;
        }
        let path = self.action(&key, "json");
        let mut text = serde_json::to_string_pretty(&record).map_err(|e| StoreError::NoArtifact(e.to_string()))?;
        text.push('\n');
        at(&path, write_atomically(&path, text.as_bytes()))?;
        at(&attempt.folder, fs::remove_dir_all(&attempt.folder))?;
        Ok(record)
    }

    /// Re-hashes one object.
    pub fn verify(&self, identity: &str) -> Result<(), Damage> {
        let folder = self.object(identity);
        let manifest = self.manifest(identity)?;
        if manifest.identity() != identity {
            return Err(Damage::Content { path: folder.join(MANIFEST_FILE) });
        }
        manifest.check_contents(&folder)
    }

    /// Removes an object; records that name it count as absent from then on.
    pub fn remove_object(&self, identity: &str) -> Result<(), StoreError> {
        let path = self.object(identity);
        // One that is damaged may be a plain file.
        at(&path, if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) })
    }

    /// Removes an action's record and log.
    pub fn remove_record(&self, key: &str) -> Result<(), StoreError> {
        let path = self.action(key, "json");
        at(&path, fs::remove_file(&path))?;
        fs::remove_file(self.action(key, "log")).ok();
        Ok(())
    }

    /// Removes an unfinished action's checkpoints.
    pub fn remove_partial(&self, key: &str) -> Result<(), StoreError> {
        let path = self.partial(key);
        at(&path, fs::remove_dir_all(&path))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn record(name: &str) -> Record {
        Record {
            stage: name.to_owned(),
            point: String::new(),
            key_parts: json!({ "stage": name }).as_object().unwrap().clone(),
            output: String::new(),
            started_unix: 0,
            seconds: 0.0,
            threads: 1,
            host: String::new(),
        }
    }

    fn make(store: &Store, name: &str, content: &str) -> Record {
        let record = record(name);
        let attempt = store.begin(&record.key(), &json!({})).unwrap();
        fs::create_dir(&attempt.output).unwrap();
        fs::write(attempt.output.join("x"), content).unwrap();
        store.publish(&attempt, "text", record).unwrap()
    }

    #[test]
    fn two_actions_may_end_in_one_object() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let (a, b) = (make(&store, "a", "same"), make(&store, "b", "same"));
        assert_eq!(a.output, b.output);
        assert_ne!(a.key(), b.key());
        assert_eq!(store.objects().unwrap(), std::slice::from_ref(&a.output));
        assert_eq!(store.hit(&a.key()), Some(a));
        assert!(store.partials().unwrap().is_empty());
    }

    #[test]
    fn a_lost_file_is_a_miss_and_a_flipped_byte_is_found() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let done = make(&store, "a", "1234");
        fs::write(store.object(&done.output).join("x"), "1235").unwrap();
        assert!(matches!(store.verify(&done.output), Err(Damage::Content { .. })));
        fs::remove_file(store.object(&done.output).join("x")).unwrap();
        assert_eq!(store.hit(&done.key()), None);
        // Made again, the damaged object is replaced.
        make(&store, "a", "1234");
        store.verify(&done.output).unwrap();
    }

    #[test]
    fn success_without_an_artifact_is_a_failure() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let attempt = store.begin("k", &json!({})).unwrap();
        assert!(matches!(store.publish(&attempt, "text", record("a")), Err(StoreError::NoArtifact(_))));
        fs::create_dir(&attempt.output).unwrap();
        fs::write(attempt.output.join("x"), "1").unwrap();
        fs::write(attempt.output.join(MANIFEST_FILE), r#"{"kind":"text","schema":1,"files":[]}"#).unwrap();
        assert!(matches!(store.publish(&attempt, "text", record("a")), Err(StoreError::NoArtifact(_))));
        assert!(store.objects().unwrap().is_empty());
    }

    #[test]
    fn a_lock_is_exclusive_and_dropped_with_its_owner() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let held = store.lock("k").unwrap();
        let other = File::open(dir.path().join("locks/k")).unwrap();
        assert!(other.try_lock().is_err());
        drop(held);
        other.try_lock().unwrap();
    }
}

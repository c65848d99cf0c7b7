use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::canonical::hash_json;
use crate::fsio::{sync_folder, write_atomically, write_json};
use crate::lock::Entered;
use crate::manifest::{Damage, MANIFEST_FILE, Manifest};
use crate::{unique, unix_time};

/// Artifacts by content and actions by key, in one folder.
///
/// ```text
/// objects/HASH/         an artifact: artifact.json and its files
/// actions/KEY.json      a finished action: its whole key, its output, when, where, in how long
/// actions/KEY.log       what it said
/// partial/KEY/          an action that hasn't finished: action.json, what it said, and in work/ its checkpoints
/// locks/KEY             one OS lock a key: the kernel drops it, whatever happens to the process
/// runs/ID.jsonl         what a run needs, written while it goes on; pins/NAME.jsonl: what is kept for good
/// gate                  entered by runs for moments, closed by garbage collection
/// format                version of all this
/// ```
///
/// An object is made in `partial/`, checked, hashed, fsynced and renamed; the record goes last. So
/// what is recorded is whole.
#[derive(Debug, Clone)]
pub struct Store {
    root: PathBuf,
    /// The format that this program knows.
    format: u32,
}

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

/// Version of a key's list of parts: names of parameters changed between 1 and 2.
pub const KEY_VERSION: u64 = 2;
/// The part that holds it.
pub const KEY_VERSION_PART: &str = "key version";

/// A stage and a sweep's point, as people read it.
pub fn label(stage: &str, point: &str) -> String {
    if point.is_empty() { stage.to_owned() } else { format!("{stage} [{point}]") }
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
    /// A newer program made the store.
    #[error(
        "{path}: the store has format {found}, this nerf-sr knows format {known}; use the newer \
        nerf-sr, or another folder with --store"
    )]
    Newer {
        /// The store.
        path: PathBuf,
        /// Its format.
        found: String,
        /// The format that this program knows.
        known: u32,
    },
}

/// Version of a store's layout. It grows when an older runner could harm what a newer one wrote.
pub const FORMAT: u32 = 1;

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

/// What an attempt made, found whole.
#[derive(Debug)]
pub struct Checked {
    attempt: Attempt,
    identity: String,
    /// Whether the store has such an object already.
    is_there: bool,
}

pub(crate) fn at<T>(path: &Path, result: io::Result<T>) -> Result<T, StoreError> {
    result.map_err(|source| StoreError::Io { path: path.to_path_buf(), source })
}

impl Store {
    /// Opens the store in a folder, making it where it isn't there. One of an older format gets
    /// this one's mark: from then on older runners leave it alone, those that are at work with it
    /// among them.
    pub fn open(root: &Path) -> Result<Self, StoreError> {
        Self::open_as(root, FORMAT)
    }

    /// As a program that knows this format.
    pub(crate) fn open_as(root: &Path, format: u32) -> Result<Self, StoreError> {
        at(root, fs::create_dir_all(root))?;
        let store = Self { root: root.to_path_buf(), format };
        if store.check_format()?.is_none_or(|found| found < format) {
            store.mark_format()?;
        }
        for folder in
            ["objects", "actions", "partial", "locks", "cache", "runs", "pins", "sinks", "trash"]
        {
            let path = root.join(folder);
            match fs::create_dir_all(&path) {
                // An old store that can't be written still shows what it has.
                Err(error) if error.kind() == io::ErrorKind::ReadOnlyFilesystem => {}
                result => at(&path, result)?,
            }
        }
        Ok(store)
    }

    /// The store's format, if it has its mark; a newer one is refused.
    pub(crate) fn check_format(&self) -> Result<Option<u32>, StoreError> {
        let path = self.root.join("format");
        match fs::read_to_string(&path) {
            Ok(text) => match text.trim().parse::<u32>() {
                Ok(found) if found <= self.format => Ok(Some(found)),
                _ => {
                    let found = text.trim().chars().take(20).collect();
                    Err(StoreError::Newer { path: self.root.clone(), found, known: self.format })
                }
            },
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(source) => Err(StoreError::Io { path, source }),
        }
    }

    /// Marks the store as of this program's format. It is closed meanwhile: who enters before is
    /// done with it, who enters later sees the mark.
    fn mark_format(&self) -> Result<(), StoreError> {
        let gate = match self.gate() {
            Err(StoreError::Io { source, .. })
                if source.kind() == io::ErrorKind::ReadOnlyFilesystem =>
            {
                return Ok(());
            }
            gate => gate?,
        };
        at(&self.root, gate.lock())?;
        // A still newer program may have been faster.
        self.check_format()?;
        let path = self.root.join("format");
        at(&path, write_atomically(&path, format!("{}\n", self.format).as_bytes()))
    }

    /// Where the store is.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The record of a key, if the action was done and its object is whole (sizes only; see
    /// [`Store::verify`]).
    pub fn hit(&self, key: &str) -> Option<Record> {
        self.record(key).filter(|record| self.is_whole(&record.output))
    }

    /// Whether an object has its own manifest and files of the right sizes; no content is read.
    pub fn is_whole(&self, identity: &str) -> bool {
        let manifest =
            self.manifest(identity).ok().filter(|manifest| manifest.identity() == identity);
        manifest.is_some_and(|manifest| manifest.check_sizes(&self.object(identity)).is_ok())
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

    pub(crate) fn names(&self, folder: &str) -> Result<Vec<String>, StoreError> {
        let folder = self.root.join(folder);
        let entries = match fs::read_dir(&folder) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => at(&folder, entries)?,
        };
        let mut names: Vec<String> = entries
            .filter_map(|e| e.ok()?.file_name().into_string().ok())
            .filter(|n| !n.starts_with('.'))
            .collect();
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

    /// An action that was begun, where its file is whole.
    pub fn unfinished(&self, key: &str) -> Option<Unfinished> {
        serde_json::from_slice(&fs::read(self.partial(key).join("action.json")).ok()?).ok()
    }

    /// Whether an unfinished action left a checkpoint.
    pub fn has_checkpoint(&self, key: &str) -> bool {
        let files = walkdir::WalkDir::new(self.partial(key).join("work")).into_iter().flatten();
        files.into_iter().any(|entry| entry.file_type().is_file())
    }

    /// Begins an action, with its key locked. Leftovers of a killed attempt are cleared, its
    /// checkpoints kept.
    pub fn begin(
        &self,
        _: &Entered,
        action: &Unfinished,
        params: &Value,
    ) -> Result<Attempt, StoreError> {
        let folder = self.partial(&hash_json(&action.key_parts));
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
        let file = folder.join("action.json");
        at(&file, write_json(&file, action))?;
        at(&attempt.params, write_json(&attempt.params, params))?;
        Ok(attempt)
    }

    /// Looks at what an attempt made: checks the manifest against the files and makes both durable.
    /// This takes its time; taking it in ([`Store::publish`]) doesn't.
    pub fn check(&self, attempt: Attempt, kind: &str) -> Result<Checked, StoreError> {
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
        make_durable(output, &found)?;
        let identity = found.identity();
        // What is there already under that name and isn't whole gives way.
        let is_there = self.verify(&identity).is_ok();
        Ok(Checked { attempt, identity, is_there })
    }

    /// Takes in what an attempt made: moves the object, writes the record last. The record's
    /// `output` is set to the object's identity.
    pub fn publish(
        &self,
        _: &Entered,
        checked: Checked,
        mut record: Record,
    ) -> Result<Record, StoreError> {
        let Checked { attempt, identity, is_there } = checked;
        record.output = identity;
        self.place(&attempt.output, &record.output, is_there)?;
        let log = self.action(&record.key(), "log");
        if attempt.log.exists() {
            at(&log, fs::rename(&attempt.log, &log))?;
        }
        self.write_record(&record)?;
        at(&attempt.folder, fs::remove_dir_all(&attempt.folder))?;
        Ok(record)
    }

    /// Moves a checked folder to an object's place, unless a whole object `is_there`. Two actions
    /// may make one object at once: it is moved where there is nothing, and what is there then
    /// stays if it is whole.
    pub(crate) fn place(
        &self,
        folder: &Path,
        identity: &str,
        is_there: bool,
    ) -> Result<(), StoreError> {
        use io::ErrorKind::{AlreadyExists, DirectoryNotEmpty, NotADirectory};
        let object = self.object(identity);
        if is_there && object.exists() {
            return Ok(());
        }
        loop {
            match fs::rename(folder, &object) {
                Ok(()) => return at(&object, sync_folder(&self.root.join("objects"))),
                Err(error)
                    if matches!(
                        error.kind(),
                        AlreadyExists | DirectoryNotEmpty | NotADirectory
                    ) => {}
                Err(source) => return Err(StoreError::Io { path: object, source }),
            }
            if self.verify(identity).is_ok() {
                return Ok(());
            }
            match self.discard(&object) {
                // The other action was faster.
                Err(StoreError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {}
                result => result?,
            }
        }
    }

    pub(crate) fn write_record(&self, record: &Record) -> Result<(), StoreError> {
        let path = self.action(&record.key(), "json");
        let mut text = serde_json::to_string_pretty(record)
            .map_err(|e| StoreError::NoArtifact(e.to_string()))?;
        text.push('\n');
        at(&path, write_atomically(&path, text.as_bytes()))
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
        self.discard(&self.object(identity))
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

    /// Takes a file or folder out of sight at once; [`Store::empty_trash`] deletes it.
    fn discard(&self, path: &Path) -> Result<(), StoreError> {
        let place = format!("{}-{}-{}", unix_time(), std::process::id(), unique());
        at(path, fs::rename(path, self.root.join("trash").join(place)))
    }

    /// Deletes what was removed. It may take its time, and may be cut short at any point.
    pub fn empty_trash(&self) -> Result<(), StoreError> {
        for name in self.names("trash")? {
            let path = self.root.join("trash").join(name);
            let removed =
                if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            match removed {
                // Somebody else empties it, too.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                result => at(&path, result)?,
            }
        }
        Ok(())
    }
}

/// Makes the files of an artifact durable, its manifest among them.
pub(crate) fn make_durable(folder: &Path, manifest: &Manifest) -> Result<(), StoreError> {
    for file in manifest.files.iter().map(|file| file.path.as_str()).chain([MANIFEST_FILE]) {
        let path = folder.join(file);
        at(&path, File::open(&path).and_then(|f| f.sync_all()))?;
    }
    at(folder, sync_folder(folder))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lock::Locked;
    use serde_json::json;

    fn entered(store: &Store) -> Entered {
        match store.try_enter().unwrap() {
            Locked::Held(entered) => entered,
            Locked::By(_) => panic!("closed"),
        }
    }

    fn unfinished(name: &str) -> Unfinished {
        Unfinished {
            stage: name.to_owned(),
            key_parts: json!({ "stage": name }).as_object().unwrap().clone(),
            ..Default::default()
        }
    }

    /// Begins an action and, unless told otherwise, makes its output.
    fn begin(store: &Store, name: &str, content: Option<&str>) -> Attempt {
        let attempt = store.begin(&entered(store), &unfinished(name), &json!({})).unwrap();
        if let Some(content) = content {
            fs::create_dir(&attempt.output).unwrap();
            fs::write(attempt.output.join("x"), content).unwrap();
        }
        attempt
    }

    fn make(store: &Store, name: &str, content: &str) -> Record {
        let checked = store.check(begin(store, name, Some(content)), "text").unwrap();
        let Unfinished { stage, key_parts, .. } = unfinished(name);
        store
            .publish(
                &entered(store),
                checked,
                Record { stage, key_parts, threads: 1, ..Record::default() },
            )
            .unwrap()
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

    #[test]
    fn success_without_an_artifact_is_a_failure() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        assert!(matches!(
            store.check(begin(&store, "k", None), "text"),
            Err(StoreError::NoArtifact(_))
        ));
        let attempt = begin(&store, "k", Some("1"));
        fs::write(attempt.output.join(MANIFEST_FILE), r#"{"kind":"text","schema":1,"files":[]}"#)
            .unwrap();
        assert!(matches!(store.check(attempt, "text"), Err(StoreError::NoArtifact(_))));
        assert!(store.objects().unwrap().is_empty());
    }

    #[test]
    fn a_newer_store_is_refused_in_one_line() {
        let dir = tempfile::tempdir().unwrap();
        Store::open(dir.path()).unwrap();
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "1\n");
        Store::open(dir.path()).unwrap();
        for text in ["2\n", "99", "", "new"] {
            fs::write(dir.path().join("format"), text).unwrap();
            let message = Store::open(dir.path()).unwrap_err().to_string();
            assert!(
                message.contains("use the newer nerf-sr") && !message.contains('\n'),
                "{message}"
            );
        }
    }

    /// A newer program marks the store as its own when it opens it. An older one that is at work
    /// there changes nothing from then on.
    #[test]
    fn an_older_program_at_work_stops_when_a_newer_one_comes() {
        let dir = tempfile::tempdir().unwrap();
        let older = Store::open_as(dir.path(), 1).unwrap();
        let done = make(&older, "a", "1234");
        let checked = older.check(begin(&older, "b", Some("5678")), "text").unwrap();
        let newer = Store::open_as(dir.path(), 2).unwrap();
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "2\n");
        for refused in
            [older.try_enter().err(), older.try_close().err(), Store::open_as(dir.path(), 1).err()]
        {
            assert_eq!(
                refused.unwrap().to_string(),
                format!(
                    "{}: the store has format 2, this nerf-sr knows format 1; use the newer \
                    nerf-sr, or another folder with --store",
                    dir.path().display()
                )
            );
        }
        drop(checked);
        assert_eq!(
            (newer.objects().unwrap(), newer.hit(&done.key())),
            (vec![done.output.clone()], Some(done))
        );
        // It makes what the older one left half made.
        let made = make(&newer, "b", "5678");
        assert_eq!(newer.hit(&made.key()), Some(made));
        Store::open_as(dir.path(), 2).unwrap();
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "2\n");
    }

    /// Actions with different keys mend one damaged object at once, again and again.
    #[test]
    fn actions_at_once_make_one_object() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let output = make(&store, "a", "1234").output;
        for round in 0..200 {
            fs::write(store.object(&output).join("x"), "4321").unwrap();
            std::thread::scope(|scope| {
                for action in 0..3 {
                    let store = &store;
                    scope.spawn(move || {
                        assert_eq!(
                            make(store, &format!("{round} {action}"), "1234").output.len(),
                            64
                        );
                    });
                }
            });
            store.verify(&output).unwrap();
        }
    }

    /// Who is inside when a newer program comes is waited for. Of several newer ones the newest has
    /// the store.
    #[test]
    fn a_newer_program_waits_for_who_is_inside() {
        let dir = tempfile::tempdir().unwrap();
        let older = Store::open_as(dir.path(), 1).unwrap();
        let inside = entered(&older);
        let formats = [2, 4, 3];
        let opened = std::thread::scope(|scope| {
            let root = dir.path();
            let openings =
                formats.map(|format| scope.spawn(move || Store::open_as(root, format).is_ok()));
            std::thread::sleep(std::time::Duration::from_millis(100));
            assert_eq!(
                fs::read_to_string(dir.path().join("format")).unwrap(),
                "1\n",
                "not while somebody is inside"
            );
            drop(inside);
            openings.map(|opening| opening.join().unwrap())
        });
        assert!(opened[1], "the newest");
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "4\n");
    }
}

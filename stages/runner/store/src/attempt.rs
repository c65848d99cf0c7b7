use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use artifact::{
    Damage, MANIFEST_FILE, Manifest, hash_json, list_output_files, write_json,
    write_json_atomically,
};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::action::{Record, Unfinished};
use crate::error::{StoreError, with_path};
use crate::folder::{Store, make_writable, remove_if_found};
use crate::lock::Entered;
use crate::objects::make_durable;

/// Paths of one attempt at an action.
#[derive(Debug)]
pub struct Attempt {
    /// `--output` of the stage; doesn't exist yet.
    pub output: PathBuf,
    /// `--work` of the stage; survives a failure.
    pub work: PathBuf,
    /// `--params` of the stage.
    pub params: PathBuf,
    /// Log of the stage.
    pub log: PathBuf,
    folder: PathBuf,
}

/// Time that attempts at an action took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TimeSpent {
    /// Duration in seconds.
    pub seconds: f64,
    /// Processor time of all threads in seconds.
    pub processor_seconds: f64,
}

/// Checked and durable output of an attempt, ready to be published.
#[derive(Debug)]
pub struct CheckedOutput {
    attempt: Attempt,
    identity: String,
    /// True if the store already has the object.
    is_stored: bool,
}

impl Attempt {
    /// Removes the checkpoints, if there are any.
    pub fn remove_checkpoints(&self) -> Result<(), StoreError> {
        remove_if_found(&self.work)
    }

    /// Returns the time that earlier attempts spent on the checkpoints; zero without a checkpoint
    /// or a recorded time.
    pub fn time_spent(&self) -> TimeSpent {
        let has_checkpoint =
            fs::read_dir(&self.work).is_ok_and(|mut entries| entries.next().is_some());
        let bytes = fs::read(self.time_file()).ok().filter(|_| has_checkpoint);
        bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default()
    }

    /// Records the time that all attempts spent, for an attempt that resumes from the checkpoints.
    pub fn record_time_spent(&self, time: &TimeSpent) -> io::Result<()> {
        write_json(&self.time_file(), time)
    }

    fn time_file(&self) -> PathBuf {
        self.folder.join("time.json")
    }

    /// Replaces hard links by copies, since writing to a file by its other name would change the
    /// artifact. Fails if there is anything other than folders and regular files.
    fn copy_hard_links(&self) -> Result<(), StoreError> {
        let files = list_output_files(&self.output).map_err(|source| match source.kind() {
            io::ErrorKind::InvalidData => StoreError::NoArtifact(source.to_string()),
            _ => StoreError::Io { path: self.output.clone(), source },
        })?;
        let copy = self.folder.join("copy");
        for (file, metadata) in files {
            if metadata.nlink() > 1 {
                with_path(&file, fs::copy(&file, &copy).and_then(|_| fs::rename(&copy, &file)))?;
            }
        }
        Ok(())
    }
}

impl Store {
    /// Begins an action, whose key the caller has locked. Removes the output of a killed attempt,
    /// but keeps its checkpoints.
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
        with_path(&folder, fs::create_dir_all(&folder))?;
        for leftover in [attempt.output.clone(), folder.join(".output.partial")] {
            remove_if_found(&leftover)?;
        }
        let file = folder.join("action.json");
        with_path(&file, write_json_atomically(&file, action))?;
        with_path(&attempt.params, write_json(&attempt.params, params))?;
        Ok(attempt)
    }

    /// Does all slow work of publishing an attempt's output, so that [`Store::publish`] is fast.
    /// Replaces hard links by copies, writes the manifest if the stage wrote none, checks the
    /// manifest against the files, and makes both durable. Fails for symbolic links and special
    /// files.
    pub fn check(&self, attempt: Attempt, kind: &str) -> Result<CheckedOutput, StoreError> {
        let output = &attempt.output;
        if output.symlink_metadata().is_err() {
            return Err(StoreError::missing_output());
        }
        with_path(output, make_writable(output))?;
        attempt.copy_hard_links()?;
        let found = with_path(output, Manifest::of_folder(kind, output))?;
        if !output.join(MANIFEST_FILE).exists() {
            // A stage may leave the manifest to the runner, as simple scripts do.
            let path = output.join(MANIFEST_FILE);
            with_path(&path, write_json(&path, &found))?;
        }
        let stated = Manifest::read(output)?;
        if stated.kind != kind {
            return Err(StoreError::NoArtifact(format!(
                "{MANIFEST_FILE}: expected kind {kind:?}, found {:?}",
                stated.kind
            )));
        }
        if stated != found {
            return Err(StoreError::NoArtifact(format!(
                "{MANIFEST_FILE} differs from the files; write it last, or leave it to the runner"
            )));
        }
        if found.files.is_empty() {
            let problem = "the stage has written no files to --output";
            return Err(StoreError::NoArtifact(problem.to_owned()));
        }
        make_durable(output, &found)?;
        let identity = found.identity();
        // A damaged object of this identity is replaced.
        let is_stored = self.verify(&identity).is_ok();
        Ok(CheckedOutput { attempt, identity, is_stored })
    }

    /// Publishes a checked output: moves the object into place, then writes the record, whose
    /// `output` is set to the object's identity.
    pub fn publish(
        &self,
        _: &Entered,
        checked: CheckedOutput,
        mut record: Record,
    ) -> Result<Record, StoreError> {
        let CheckedOutput { attempt, identity, is_stored } = checked;
        record.output = identity;
        self.install_object(&attempt.output, &record.output, is_stored)?;
        let log = self.action(&record.key(), "log");
        if attempt.log.exists() {
            with_path(&log, fs::rename(&attempt.log, &log))?;
        }
        self.write_record(&record)?;
        remove_if_found(&attempt.folder)?;
        Ok(record)
    }
}

/// Artifact from another store, checked in a scratch folder of this store.
#[derive(Debug)]
pub struct Arrival {
    folder: PathBuf,
    identity: String,
    /// True if a damaged object is to be replaced.
    replaces: bool,
}

impl Store {
    /// Checks an artifact from another store, its files against the manifest and the manifest
    /// against the identity, and makes it durable. Then [`Store::import_object`] is fast, unless it
    /// replaces a damaged object, which it hashes again.
    pub fn check_arrival(&self, folder: &Path, identity: &str) -> Result<Arrival, StoreError> {
        let manifest = Manifest::read(folder)?;
        if manifest.identity() != identity {
            return Err(Damage::Content { path: folder.join(MANIFEST_FILE) }.into());
        }
        manifest.check_contents(folder)?;
        make_durable(folder, &manifest)?;
        let replaces =
            self.object(identity).symlink_metadata().is_ok() && self.verify(identity).is_err();
        Ok(Arrival { folder: folder.to_path_buf(), identity: identity.to_owned(), replaces })
    }

    /// Moves a checked object into place, unless the store has a complete one.
    pub fn import_object(&self, _: &Entered, arrival: &Arrival) -> Result<(), StoreError> {
        // An object that another process has stored meanwhile isn't hashed again.
        let is_stored = !arrival.replaces && self.is_complete(&arrival.identity)?;
        self.install_object(&arrival.folder, &arrival.identity, is_stored)
    }

    /// Writes a record from another store, whose object is imported first; returns whether the
    /// record was written. An existing record stays, unless only the new one's object is complete.
    pub fn import_record(&self, _: &Entered, record: &Record) -> Result<bool, StoreError> {
        if let Some(existing) = self.record(&record.key())?
            && (existing == *record
                || self.is_complete(&existing.output)?
                || !self.is_complete(&record.output)?)
        {
            return Ok(false);
        }
        self.write_record(record)?;
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt as _, symlink};
    use std::os::unix::net::UnixListener;

    use super::*;
    use crate::testing::{begin, entered, finish_action};

    #[test]
    fn equal_outputs_of_two_actions_are_one_object() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let (a, b) = (finish_action(&store, "a", "same"), finish_action(&store, "b", "same"));
        assert_eq!(a.output, b.output);
        assert_ne!(a.key(), b.key());
        assert_eq!(store.objects().unwrap(), std::slice::from_ref(&a.output));
        assert_eq!(store.hit(&a.key()).unwrap(), Some(a));
        assert!(store.partials().unwrap().is_empty());
    }

    /// Links in an output are refused instead of followed, and the next attempt starts anew.
    #[test]
    fn links_and_special_files_are_refused() {
        type Harm = fn(&Path, &Path);
        let cases: [(&str, Harm); 5] = [
            ("output is a symbolic link", |out, user_folder| symlink(user_folder, out).unwrap()),
            ("output is a symbolic link", |out, _| symlink("nowhere", out).unwrap()),
            ("output is a regular file", |out, _| fs::write(out, "").unwrap()),
            ("output/in/x is a symbolic link", |out, user_folder| {
                fs::create_dir_all(out.join("in")).unwrap();
                symlink(user_folder.join("x"), out.join("in/x")).unwrap();
            }),
            ("output/socket is a socket", |out, _| {
                fs::create_dir(out).unwrap();
                drop(UnixListener::bind(out.join("socket")).unwrap());
            }),
        ];
        let dir = tempfile::tempdir().unwrap();
        let (store, user_folder) =
            (Store::open(&dir.path().join("s")).unwrap(), dir.path().join("own"));
        fs::create_dir(&user_folder).unwrap();
        fs::write(user_folder.join("x"), "mine").unwrap();
        for (expected, harm) in cases {
            let attempt = begin(&store, "k", None);
            harm(&attempt.output, &user_folder);
            let message = store.check(attempt, "text").unwrap_err().to_string();
            assert!(message.contains(expected) && !message.contains('\n'), "{expected}: {message}");
        }
        assert_eq!(fs::read_dir(&user_folder).unwrap().count(), 1);
        assert_eq!(store.hit(&finish_action(&store, "k", "1").key()).unwrap().unwrap().stage, "k");
    }

    /// A stage may leave folders without write permission, which can't be moved or deleted.
    #[test]
    fn read_only_folders_are_published_and_deleted() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let begin_read_only = || {
            let attempt = begin(&store, "k", Some("1"));
            for inner in [attempt.output.join("in"), attempt.work.join("in")] {
                fs::create_dir_all(&inner).unwrap();
                fs::write(inner.join("x"), "1").unwrap();
                for folder in inner.ancestors().take(2) {
                    fs::set_permissions(folder, fs::Permissions::from_mode(0o555)).unwrap();
                }
            }
            attempt
        };
        begin_read_only();
        // The next attempt deletes the output.
        let checked = store.check(begin_read_only(), "text").unwrap();
        let record = Record { stage: "k".to_owned(), ..Record::default() };
        let output = store.publish(&entered(&store), checked, record).unwrap().output;
        for folder in [store.object(&output), store.object(&output).join("in")] {
            assert_eq!(folder.metadata().unwrap().permissions().mode() & 0o777, 0o755);
            fs::set_permissions(folder, fs::Permissions::from_mode(0o555)).unwrap();
        }
        store.remove_object(&output).unwrap();
        begin_read_only().remove_checkpoints().unwrap();
        store.empty_trash().unwrap();
        assert!(store.list_names("trash").unwrap().is_empty());
    }

    /// Writing to a hard-linked file outside of the store doesn't change the artifact.
    #[test]
    fn hard_links_become_copies() {
        let dir = tempfile::tempdir().unwrap();
        let (store, user_file) =
            (Store::open(&dir.path().join("s")).unwrap(), dir.path().join("own"));
        fs::write(&user_file, "before").unwrap();
        let attempt = begin(&store, "k", Some("1"));
        fs::hard_link(&user_file, attempt.output.join("linked")).unwrap();
        let checked = store.check(attempt, "text").unwrap();
        let record = Record { stage: "k".to_owned(), ..Record::default() };
        let output = store.publish(&entered(&store), checked, record).unwrap().output;
        fs::write(&user_file, "after!").unwrap();
        store.verify(&output).unwrap();
    }

    #[test]
    fn time_of_earlier_attempts_counts_with_a_checkpoint() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let attempt = begin(&store, "k", None);
        let time = TimeSpent { seconds: 1.5, processor_seconds: 3.0 };
        attempt.record_time_spent(&time).unwrap();
        fs::create_dir_all(&attempt.work).unwrap();
        assert_eq!(attempt.time_spent(), TimeSpent::default());
        fs::write(attempt.work.join("checkpoint"), "").unwrap();
        assert_eq!(begin(&store, "k", None).time_spent(), time);
        fs::write(attempt.time_file(), "{").unwrap();
        assert_eq!(attempt.time_spent(), TimeSpent::default());
    }

    #[test]
    fn an_attempt_without_an_artifact_fails() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let unlisted = begin(&store, "k", None).copy_hard_links();
        assert!(matches!(unlisted, Err(StoreError::Io { .. })), "{unlisted:?}");
        let linked = begin(&store, "k", Some("1"));
        std::os::unix::fs::symlink("gone", linked.output.join("link")).unwrap();
        assert!(matches!(linked.copy_hard_links(), Err(StoreError::NoArtifact(_))));
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

    /// Writes an artifact into a scratch folder; returns the folder and the identity.
    fn write_arrival(store: &Store, content: &str) -> (PathBuf, String) {
        let folder = store.scratch("run").join("arriving");
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("x"), content).unwrap();
        let manifest = Manifest::of_folder("text", &folder).unwrap();
        write_json(&folder.join(MANIFEST_FILE), &manifest).unwrap();
        (folder, manifest.identity())
    }

    fn record(output: &str, host: &str) -> Record {
        Record {
            stage: "s".to_owned(),
            output: output.to_owned(),
            host: host.to_owned(),
            ..Record::default()
        }
    }

    /// Imports an artifact and its record; returns whether the record is new, and the identity.
    fn import_from(store: &Store, entered: &Entered, host: &str) -> (bool, String) {
        let (folder, identity) = write_arrival(store, "1234");
        store.import_object(entered, &store.check_arrival(&folder, &identity).unwrap()).unwrap();
        (store.import_record(entered, &record(&identity, host)).unwrap(), identity)
    }

    #[test]
    fn existing_records_stay_and_damaged_objects_are_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let entered = entered(&store);
        let (is_new, identity) = import_from(&store, &entered, "first");
        assert!(is_new);
        assert!(!import_from(&store, &entered, "second").0);
        let key = record("", "").key();
        assert_eq!(store.hit(&key).unwrap().unwrap().host, "first");
        fs::write(store.object(&identity).join("x"), "12").unwrap();
        import_from(&store, &entered, "third");
        store.verify(&identity).unwrap();
        assert_eq!(store.hit(&key).unwrap().unwrap().host, "first");
    }

    #[test]
    fn incomplete_or_changed_artifacts_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let (folder, identity) = write_arrival(&store, "1234");
        assert!(matches!(
            store.check_arrival(&folder, &"0".repeat(64)),
            Err(StoreError::Damage(Damage::Content { .. }))
        ));
        fs::write(folder.join("x"), "1235").unwrap();
        assert!(matches!(
            store.check_arrival(&folder, &identity),
            Err(StoreError::Damage(Damage::Content { .. }))
        ));
        fs::remove_file(folder.join("x")).unwrap();
        assert!(matches!(
            store.check_arrival(&folder, &identity),
            Err(StoreError::Damage(Damage::Missing { .. }))
        ));
        assert!(store.objects().unwrap().is_empty());
    }
}

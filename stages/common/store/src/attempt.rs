use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::PathBuf;

use artifact::{
    MANIFEST_FILE, Manifest, OutputFileError, hash_json, list_output_files, write_json,
};
use serde_json::Value;

use crate::action::{Record, Unfinished};
use crate::error::{StoreError, at};
use crate::folder::{Store, remove};
use crate::lock::Entered;
use crate::objects::make_durable;

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

impl Attempt {
    /// Refuses what an artifact may not contain. Replaces each file that has a second name by a
    /// copy: whoever writes to the file under its other name would change the artifact.
    fn own_files(&self) -> Result<(), StoreError> {
        let files = list_output_files(&self.output).map_err(|problem| match problem {
            OutputFileError::Kind { .. } => StoreError::NoArtifact(problem.to_string()),
            OutputFileError::Io(source) => StoreError::Io { path: self.output.clone(), source },
        })?;
        let copy = self.folder.join("copy");
        for (file, metadata) in files {
            if metadata.nlink() > 1 {
                at(&file, fs::copy(&file, &copy).and_then(|_| fs::rename(&copy, &file)))?;
            }
        }
        Ok(())
    }
}

impl Store {
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
            at(&leftover, remove(&leftover))?;
        }
        let file = folder.join("action.json");
        at(&file, write_json(&file, action))?;
        at(&attempt.params, write_json(&attempt.params, params))?;
        Ok(attempt)
    }

    /// Looks at what an attempt made: checks the manifest against the files and makes both durable.
    /// Refuses links and special files. This takes its time; taking it in ([`Store::publish`])
    /// doesn't.
    pub fn check(&self, attempt: Attempt, kind: &str) -> Result<Checked, StoreError> {
        let output = &attempt.output;
        if output.symlink_metadata().is_err() {
            return Err(StoreError::NoArtifact("its --output was not made".to_owned()));
        }
        attempt.own_files()?;
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
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;
    use std::path::Path;

    use super::*;
    use crate::testing::{begin, entered, make};

    #[test]
    fn two_actions_may_end_in_one_object() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let (a, b) = (make(&store, "a", "same"), make(&store, "b", "same"));
        assert_eq!(a.output, b.output);
        assert_ne!(a.key(), b.key());
        assert_eq!(store.objects().unwrap(), std::slice::from_ref(&a.output));
        assert_eq!(store.hit(&a.key()).unwrap(), Some(a));
        assert!(store.partials().unwrap().is_empty());
    }

    /// Nothing is written through a link, whatever the output is a link to, and the next attempt
    /// begins anew.
    #[test]
    fn links_and_special_files_are_refused() {
        type Harm = fn(&Path, &Path);
        let cases: [(&str, Harm); 5] = [
            ("output is a symbolic link", |out, own| symlink(own, out).unwrap()),
            ("output is a symbolic link", |out, _| symlink("nowhere", out).unwrap()),
            ("output is a regular file", |out, _| fs::write(out, "").unwrap()),
            ("output/in/x is a symbolic link", |out, own| {
                fs::create_dir_all(out.join("in")).unwrap();
                symlink(own.join("x"), out.join("in/x")).unwrap();
            }),
            ("output/socket is a socket", |out, _| {
                fs::create_dir(out).unwrap();
                drop(UnixListener::bind(out.join("socket")).unwrap());
            }),
        ];
        let dir = tempfile::tempdir().unwrap();
        let (store, own) = (Store::open(&dir.path().join("s")).unwrap(), dir.path().join("own"));
        fs::create_dir(&own).unwrap();
        fs::write(own.join("x"), "mine").unwrap();
        for (words, harm) in cases {
            let attempt = begin(&store, "k", None);
            harm(&attempt.output, &own);
            let message = store.check(attempt, "text").unwrap_err().to_string();
            assert!(message.contains(words) && !message.contains('\n'), "{words}: {message}");
        }
        assert_eq!(fs::read_dir(&own).unwrap().count(), 1);
        assert_eq!(store.hit(&make(&store, "k", "1").key()).unwrap().unwrap().stage, "k");
    }

    /// A file's other name is the user's: what is written there changes no artifact.
    #[test]
    fn hard_links_become_copies() {
        let dir = tempfile::tempdir().unwrap();
        let (store, own) = (Store::open(&dir.path().join("s")).unwrap(), dir.path().join("own"));
        fs::write(&own, "before").unwrap();
        let attempt = begin(&store, "k", Some("1"));
        fs::hard_link(&own, attempt.output.join("linked")).unwrap();
        let checked = store.check(attempt, "text").unwrap();
        let record = Record { stage: "k".to_owned(), ..Record::default() };
        let output = store.publish(&entered(&store), checked, record).unwrap().output;
        fs::write(&own, "after!").unwrap();
        store.verify(&output).unwrap();
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
}

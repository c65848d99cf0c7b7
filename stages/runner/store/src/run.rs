use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use artifact::{unix_time, write_atomically};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::action::Record;
use crate::error::{StoreError, if_found, lock_error, with_path};
use crate::folder::{Store, unique_name};
use crate::lock::{Entered, Holder, is_locked};

/// Line of a run's file. Lines are appended as the needed actions become known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum RunLine {
    /// First line: process and command line.
    Run { holder: Holder, command: Vec<String> },
    /// Action whose record or checkpoints the run needs.
    Action { stage: String, key: String },
    /// Action whose key depends on outputs that don't exist yet.
    Waiting(PartialKey),
    /// Last line, unless the run was killed.
    Ended { unix: u64 },
}

/// Known part of a key whose inputs are unknown. Every record with these parts may have the key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PartialKey {
    /// Name of the program, as in the part `stage` of a key.
    pub program: String,
    /// All parameters, as in the parts `parameter NAME` of a key.
    pub parameters: Map<String, Value>,
}

impl PartialKey {
    /// Returns whether a record has these parts, so that it may have the key.
    pub fn matches(&self, record: &Record) -> bool {
        let mut count = 0;
        for (name, value) in &record.key_parts {
            if let Some(name) = name.strip_prefix("parameter ") {
                count += 1;
                if self.parameters.get(name) != Some(value) {
                    return false;
                }
            }
        }
        count == self.parameters.len()
            && record.key_parts.get("stage").and_then(Value::as_str) == Some(&self.program)
    }
}

/// Content of a run's file, `runs/ID.jsonl`, or of a pin, `pins/NAME.jsonl`.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// Name of the file without extension.
    pub id: String,
    /// Process of the run, if recorded.
    pub holder: Option<Holder>,
    /// Command line.
    pub command: Vec<String>,
    /// Keys of the needed actions.
    pub keys: BTreeSet<String>,
    /// Needed nodes whose keys weren't known at the start.
    pub waiting: Vec<PartialKey>,
    /// End time in seconds since 1970; `None` for a killed run and one in progress.
    pub ended_unix: Option<u64>,
    /// True if the run is in progress.
    pub in_progress: bool,
}

impl Run {
    /// Returns the end of the run, or its start if no end is recorded, in seconds since 1970; 0 if
    /// neither is known.
    pub fn last_used_unix(&self) -> u64 {
        self.ended_unix.or(self.holder.as_ref().map(|h| h.since_unix)).unwrap_or_default()
    }

    /// Reads the file of a run or a pin; `None` if it is not found.
    fn read(store: &Store, kind: FileKind, id: &str) -> Result<Option<Self>, StoreError> {
        let path = kind.path(store, id);
        // Before the file is read: a run that ends in between has written its end by then.
        let in_progress = is_locked(&path)?;
        let Some(bytes) = if_found(&path, fs::read(&path))? else { return Ok(None) };
        let text = String::from_utf8_lossy(&bytes);
        let mut run = Self {
            id: id.to_owned(),
            holder: None,
            command: Vec::new(),
            keys: BTreeSet::new(),
            waiting: Vec::new(),
            ended_unix: None,
            in_progress,
        };
        let mut is_complete = true;
        for line in text.lines() {
            match serde_json::from_str(line) {
                Ok(line) => run.add_line(line),
                Err(_) => is_complete = false,
            }
        }
        let is_valid = match kind {
            // Pins are written atomically.
            FileKind::Pin => is_complete && run.holder.is_some() && !run.keys.is_empty(),
            // A kill or a full disk may truncate any line, even the first.
            FileKind::Run => run.holder.is_some() || is_truncated(&text),
        };
        if is_valid { Ok(Some(run)) } else { Err(kind.damage(path, id)) }
    }

    fn add_line(&mut self, line: RunLine) {
        match line {
            RunLine::Run { holder, command } => {
                (self.holder, self.command) = (Some(holder), command);
            }
            RunLine::Action { key, .. } => _ = self.keys.insert(key),
            RunLine::Waiting(waiting) => self.waiting.push(waiting),
            RunLine::Ended { unix } => self.ended_unix = Some(unix),
        }
    }
}

/// Returns whether a file ends within its first line.
fn is_truncated(text: &str) -> bool {
    text.is_empty() || (text.starts_with('{') && !text.contains('\n'))
}

/// Kind of a file of [`RunLine`]s.
#[derive(Clone, Copy)]
enum FileKind {
    Run,
    Pin,
}

impl FileKind {
    fn folder(self) -> &'static str {
        match self {
            Self::Run => "runs",
            Self::Pin => "pins",
        }
    }

    fn path(self, store: &Store, id: &str) -> PathBuf {
        store.root().join(self.folder()).join(format!("{id}{EXTENSION}"))
    }

    fn damage(self, path: PathBuf, id: &str) -> StoreError {
        let problem = match self {
            Self::Run => "the run's file is damaged; move the file away, after which `gc` may \
                delete what the run used"
                .to_owned(),
            Self::Pin => {
                format!("the pin is damaged; run `nerf-sr unpin {id}`, then pin again")
            }
        };
        StoreError::Content { path, problem }
    }
}

/// Extension of runs' files and pins.
const EXTENSION: &str = ".jsonl";

/// Locked file of a run in progress, which records the needed actions. Garbage collection keeps
/// these during the run, and afterwards for the time given to `gc`.
#[derive(Debug)]
pub struct RunFile {
    id: String,
    path: PathBuf,
    /// `None` for a store on a read-only file system, where no garbage is collected.
    file: Option<File>,
}

impl RunFile {
    /// Returns the name of the run.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Records that the run needs an action. The caller has entered the store, so that the action
    /// can't be deleted in between.
    pub fn record_action(&self, _: &Entered, stage: &str, key: &str) -> Result<(), StoreError> {
        self.write(&RunLine::Action { stage: stage.to_owned(), key: key.to_owned() })
    }

    /// Records that the run needs a node whose key is not known yet.
    pub fn record_waiting(&self, _: &Entered, waiting: PartialKey) -> Result<(), StoreError> {
        self.write(&RunLine::Waiting(waiting))
    }

    /// Records the end of the run.
    pub fn end(self) -> Result<(), StoreError> {
        self.write(&RunLine::Ended { unix: unix_time() })
    }

    fn write(&self, line: &RunLine) -> Result<(), StoreError> {
        let Some(mut file) = self.file.as_ref() else { return Ok(()) };
        // One write per line, since threads of a run share the file.
        with_path(&self.path, file.write_all(line.text(&self.path)?.as_bytes()))
    }
}

impl RunLine {
    /// Formats the line of the file at `path`, with a line feed.
    fn text(&self, path: &Path) -> Result<String, StoreError> {
        let text = serde_json::to_string(self).map_err(io::Error::from);
        Ok(with_path(path, text)? + "\n")
    }
}

impl Store {
    /// Creates the file of a new run, with its command line.
    pub fn begin_run(&self, _: &Entered, command: Vec<String>) -> Result<RunFile, StoreError> {
        let holder = Holder::this_process();
        let run = self.create_run(holder.since_unix)?;
        run.write(&RunLine::Run { holder, command })?;
        Ok(run)
    }

    /// Creates and locks the file of a run that starts at `start_unix`. On a read-only file system,
    /// the run has no file.
    fn create_run(&self, start_unix: u64) -> Result<RunFile, StoreError> {
        loop {
            let id = unique_name(start_unix)?;
            let path = FileKind::Run.path(self, &id);
            let opened = fs::create_dir_all(self.root().join(FileKind::Run.folder()))
                .and_then(|()| File::options().create_new(true).append(true).open(&path));
            match opened {
                Ok(file) => {
                    file.lock().map_err(|source| lock_error(&path, source))?;
                    return Ok(RunFile { id, path, file: Some(file) });
                }
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) if error.kind() == io::ErrorKind::ReadOnlyFilesystem => {
                    return Ok(RunFile { id, path, file: None });
                }
                Err(source) => return Err(StoreError::Io { path, source }),
            }
        }
    }

    /// Reads all runs, sorted by name. Fails for a damaged file.
    pub fn runs(&self) -> Result<Vec<Run>, StoreError> {
        self.read_all(FileKind::Run)
    }

    /// Reads all pins, sorted by name. Fails for a damaged pin.
    pub fn pins(&self) -> Result<Vec<Run>, StoreError> {
        self.read_all(FileKind::Pin)
    }

    /// Reads the run or pin of a name.
    pub fn run_or_pin(&self, name: &str) -> Result<Option<Run>, StoreError> {
        for kind in [FileKind::Run, FileKind::Pin] {
            // The name is compared with existing ones first, since it may be any text.
            if self.names(kind)?.iter().any(|id| id == name) {
                return Run::read(self, kind, name);
            }
        }
        Ok(None)
    }

    /// Returns the names of all pins, including damaged ones, sorted.
    pub fn pin_names(&self) -> Result<Vec<String>, StoreError> {
        self.names(FileKind::Pin)
    }

    /// Returns the names of all runs or pins, sorted.
    fn names(&self, kind: FileKind) -> Result<Vec<String>, StoreError> {
        let names = self.list_names(kind.folder())?;
        Ok(names.iter().filter_map(|name| Some(name.strip_suffix(EXTENSION)?.to_owned())).collect())
    }

    fn read_all(&self, kind: FileKind) -> Result<Vec<Run>, StoreError> {
        let mut runs = Vec::new();
        for id in self.names(kind)? {
            runs.extend(Run::read(self, kind, &id)?);
        }
        Ok(runs)
    }

    /// Pins actions under a name: garbage collection keeps them until [`Store::unpin`].
    pub fn pin(
        &self,
        _: &Entered,
        name: &str,
        command: Vec<String>,
        actions: &[(String, String)],
    ) -> Result<(), StoreError> {
        let path = FileKind::Pin.path(self, name);
        let mut text = RunLine::Run { holder: Holder::this_process(), command }.text(&path)?;
        for (stage, key) in actions {
            text += &RunLine::Action { stage: stage.clone(), key: key.clone() }.text(&path)?;
        }
        with_path(&path, write_atomically(&path, text.as_bytes()))
    }

    /// Removes a pin, even a damaged one; returns whether it existed.
    pub fn unpin(&self, name: &str) -> Result<bool, StoreError> {
        self.move_to_trash(&FileKind::Pin.path(self, name))
    }

    /// Removes a run's file, the leftovers of its sinks, and its submissions to a cluster.
    pub fn remove_run(&self, id: &str) -> Result<(), StoreError> {
        let (path, scratch) = (FileKind::Run.path(self, id), self.scratch(id));
        // Leftovers are worthless, so errors are ignored.
        fs::remove_dir_all(&scratch).ok();
        fs::remove_dir_all(self.root().join("slurm").join(id)).ok();
        with_path(&path, fs::remove_file(&path))
    }

    /// Returns the folder for temporary files of a run's sinks.
    pub fn scratch(&self, run: &str) -> PathBuf {
        self.root().join("sinks").join(run)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::testing::{UNREADABLE, entered};

    #[test]
    fn a_waiting_node_matches_any_record_of_its_stage_and_parameters() {
        let waiting = PartialKey {
            program: "prep".into(),
            parameters: json!({"lr": 2, "kernel": null}).as_object().unwrap().clone(),
        };
        for (parts, expected) in [
            (
                json!({"stage": "prep", "parameter lr": 2, "parameter kernel": null,
                    "input a": "x"}),
                true,
            ),
            (
                json!({"stage": "prep", "parameter lr": 2, "parameter kernel": null,
                    "input a": "y", "code": "z"}),
                true,
            ),
            (json!({"stage": "prep", "parameter lr": 3, "parameter kernel": null}), false),
            (json!({"stage": "prep", "parameter lr": 2}), false),
            (
                json!({"stage": "prep", "parameter lr": 2, "parameter kernel": null,
                    "parameter more": 1}),
                false,
            ),
            (json!({"stage": "eval", "parameter lr": 2, "parameter kernel": null}), false),
        ] {
            let record =
                Record { key_parts: parts.as_object().unwrap().clone(), ..Record::default() };
            assert_eq!(waiting.matches(&record), expected, "{parts}");
        }
    }

    #[test]
    fn a_run_is_in_progress_while_its_file_is_locked() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let file = store.begin_run(&entered(&store), vec!["nerf-sr".into(), "run".into()]).unwrap();
        file.record_action(&entered(&store), "prep", "k1").unwrap();
        let waiting = PartialKey {
            program: "train-ss".into(),
            parameters: json!({"rays": 3}).as_object().unwrap().clone(),
        };
        file.record_waiting(&entered(&store), waiting.clone()).unwrap();
        let run = store.runs().unwrap().remove(0);
        assert!(run.in_progress && run.ended_unix.is_none());
        assert_eq!((run.keys, run.waiting), (BTreeSet::from(["k1".to_owned()]), vec![waiting]));
        let id = file.id().to_owned();
        file.end().unwrap();
        let path = dir.path().join(format!("runs/{id}.jsonl"));
        // A truncated line is ignored.
        let text = fs::read_to_string(&path).unwrap() + "{\"action\":{\"sta";
        fs::write(&path, text).unwrap();
        let run = store.runs().unwrap().remove(0);
        assert!(!run.in_progress && run.ended_unix.is_some() && run.keys.len() == 1);
        store.remove_run(&id).unwrap();
        assert!(store.runs().unwrap().is_empty());
    }

    #[test]
    fn pins_are_added_and_removed() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        store.pin(&entered(&store), "paper", Vec::new(), &[("prep".into(), "k".into())]).unwrap();
        assert_eq!(store.pins().unwrap()[0].keys, BTreeSet::from(["k".to_owned()]));
        assert_eq!(store.run_or_pin("paper").unwrap().unwrap().keys.len(), 1);
        assert_eq!(store.run_or_pin("../pins/paper").unwrap(), None);
        assert!(store.unpin("paper").unwrap() && !store.unpin("paper").unwrap());
    }

    const FIRST: &str = r#"{"run":{"holder":{"pid":1,"host":"h","since_unix":5},"command":[]}}"#;
    const ACTION: &str = r#"{"action":{"stage":"s","key":"k"}}"#;

    /// A truncated run file is read as far as possible. A pin is written atomically, so a truncated
    /// one is damaged.
    #[test]
    fn damaged_files_of_runs_and_pins_are_errors() {
        let (complete, ended) = (format!("{FIRST}\n{ACTION}\n"), r#"{"ended":{"unix":9}}"#);
        for (text, is_run, is_pin) in [
            (complete.clone(), true, true),
            (format!("{FIRST}\n{ACTION}"), true, true),
            (format!("{FIRST}\n"), true, false),
            (FIRST[..20].to_owned(), true, false),
            (String::new(), true, false),
            (format!("{complete}{{\"act"), true, false),
            (format!("{FIRST}\n{{\"act{ACTION}\n{ended}\n"), true, false),
            (format!("{ACTION}\n"), false, false),
            ("my notes".to_owned(), false, false),
            ("\0".repeat(100), false, false),
        ] {
            let dir = tempfile::tempdir().unwrap();
            let store = Store::open(dir.path()).unwrap();
            for file in ["runs/x.jsonl", "pins/x.jsonl"] {
                fs::write(dir.path().join(file), &text).unwrap();
            }
            assert_eq!((store.runs().is_ok(), store.pins().is_ok()), (is_run, is_pin), "{text:?}");
            if let Err(error) = store.runs() {
                let message = error.to_string();
                assert!(
                    message.contains("runs/x.jsonl") && message.contains("move the file away"),
                    "{message}"
                );
            }
            if let Err(error) = store.pins() {
                let message = error.to_string();
                assert!(
                    message.contains("pins/x.jsonl") && message.contains("unpin x`"),
                    "{message}"
                );
            }
            assert_eq!(store.pin_names().unwrap(), ["x"]);
            assert!(store.unpin("x").unwrap() && store.pins().unwrap().is_empty());
        }
    }

    #[test]
    fn unreadable_files_of_runs_and_pins_are_errors() {
        for (file, read) in [
            ("runs/x.jsonl", Store::runs as fn(&Store) -> Result<Vec<Run>, StoreError>),
            ("pins/x.jsonl", Store::pins),
        ] {
            for damage in UNREADABLE {
                let dir = tempfile::tempdir().unwrap();
                let store = Store::open(dir.path()).unwrap();
                damage(&dir.path().join(file));
                let message = read(&store).unwrap_err().to_string();
                assert!(message.contains(file), "{message}");
                assert!(store.run_or_pin("x").is_err());
                assert_eq!(store.unpin("x").unwrap(), file.starts_with("pins"));
            }
        }
    }

    /// Two containers may share a store, a start time in seconds and the process id 1.
    #[test]
    fn names_of_runs_have_random_digits() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let ids: BTreeSet<String> =
            (0..100).map(|_| store.create_run(5).unwrap().id().to_owned()).collect();
        assert_eq!(ids.len(), 100);
        let random = |id: &String| u32::from_str_radix(id.rsplit_once('-').unwrap().1, 16).unwrap();
        let large = ids.iter().filter(|id| random(id) > u32::MAX / 2).count();
        assert!((20..80).contains(&large), "{large} of 100 have the first bit set");
    }
}

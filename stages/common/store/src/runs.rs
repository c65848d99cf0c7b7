use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use artifact::{unix_time, write_atomically};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::action::Record;
use crate::error::{StoreError, at};
use crate::folder::{Store, unique};
use crate::lock::{Entered, Holder, is_locked};

/// A line of a run's file: what the run needs becomes known while it goes on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum RunLine {
    /// The first: who runs what.
    Run { holder: Holder, command: Vec<String> },
    /// An action whose record or checkpoints it needs.
    Action { stage: String, key: String },
    /// An action whose key depends on what others will make.
    Waiting(Waiting),
    /// The last, unless the run was killed.
    Ended { unix: u64 },
}

/// A node that can't have a key yet. Any record of its stage with its parameters may turn out to be
/// its own.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Waiting {
    /// Name of the program, as in the key's part `stage`.
    pub program: String,
    /// All parameters, as in the key's parts `parameter NAME`.
    pub parameters: Map<String, Value>,
}

impl Waiting {
    /// Whether a record may be the node's.
    pub fn may_be(&self, record: &Record) -> bool {
        let named = record
            .key_parts
            .iter()
            .filter_map(|(name, value)| Some((name.strip_prefix("parameter ")?, value)));
        record.key_parts.get("stage").and_then(Value::as_str) == Some(&self.program)
            && named.clone().count() == self.parameters.len()
            && named.into_iter().all(|(name, value)| self.parameters.get(name) == Some(value))
    }
}

/// What is written down of a run: `runs/ID.jsonl`. A pin, `pins/NAME.jsonl`, has the same form.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// The file's name without its ending.
    pub id: String,
    /// Who runs it, where the file says so.
    pub holder: Option<Holder>,
    /// The command line.
    pub command: Vec<String>,
    /// Keys of the actions that it needs.
    pub keys: BTreeSet<String>,
    /// Nodes whose keys weren't known when it started.
    pub waiting: Vec<Waiting>,
    /// When it ended; a run that was killed has none.
    pub ended_unix: Option<u64>,
    /// Whether it goes on right now.
    pub in_progress: bool,
}

impl Run {
    /// When it was last known to go on, seconds since 1970.
    pub fn used_unix(&self) -> u64 {
        self.ended_unix.or(self.holder.as_ref().map(|h| h.since_unix)).unwrap_or_default()
    }

    fn read(path: &Path) -> Option<Self> {
        let id = path.file_stem()?.to_str()?.to_owned();
        let text = String::from_utf8_lossy(&fs::read(path).ok()?).into_owned();
        let mut run = Self {
            id,
            holder: None,
            command: Vec::new(),
            keys: BTreeSet::new(),
            waiting: Vec::new(),
            ended_unix: None,
            in_progress: is_locked(path),
        };
        // A line that a kill cut short says nothing.
        for line in text.lines().filter_map(|line| serde_json::from_str(line).ok()) {
            match line {
                RunLine::Run { holder, command } => {
                    (run.holder, run.command) = (Some(holder), command);
                }
                RunLine::Action { key, .. } => {
                    run.keys.insert(key);
                }
                RunLine::Waiting(waiting) => run.waiting.push(waiting),
                RunLine::Ended { unix } => run.ended_unix = Some(unix),
            }
        }
        Some(run)
    }
}

/// A run in progress, which writes down what it needs. Garbage collection keeps that as long as
/// this lives, and as long afterwards as it is told to.
#[derive(Debug)]
pub struct RunFile {
    id: String,
    /// None in a store that can't be written: nobody collects garbage there.
    file: Option<File>,
}

impl RunFile {
    /// The run's own name.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The run needs this action. Whoever says so has entered the store, so that the action can't
    /// go in between.
    pub fn needs(&self, _: &Entered, stage: &str, key: &str) -> Result<(), StoreError> {
        self.write(&RunLine::Action { stage: stage.to_owned(), key: key.to_owned() })
    }

    /// The run may need any record that this node may have.
    pub fn waits(&self, _: &Entered, waiting: Waiting) -> Result<(), StoreError> {
        self.write(&RunLine::Waiting(waiting))
    }

    /// The run has ended; what it needed is kept for as long as its owner wants.
    pub fn end(self) -> Result<(), StoreError> {
        self.write(&RunLine::Ended { unix: unix_time() })
    }

    fn write(&self, line: &RunLine) -> Result<(), StoreError> {
        let Some(mut file) = self.file.as_ref() else { return Ok(()) };
        let text =
            serde_json::to_string(line).map_err(|e| StoreError::NoArtifact(e.to_string()))?;
        // One write a line: threads of a run share the file.
        at(Path::new(&self.id), file.write_all(format!("{text}\n").as_bytes()))
    }
}

impl Store {
    /// Begins a run's file. `command` is for people.
    pub fn begin_run(&self, _: &Entered, command: Vec<String>) -> Result<RunFile, StoreError> {
        let holder = Holder::this_process();
        let folder = self.root().join("runs");
        let id = format!("{}-{}-{}", holder.since_unix, holder.pid, unique());
        let path = folder.join(format!("{id}.jsonl"));
        let opened = fs::create_dir_all(&folder)
            .and_then(|()| File::options().create_new(true).append(true).open(&path));
        let file = match opened {
            Ok(file) => Some(file),
            Err(error) if error.kind() == io::ErrorKind::ReadOnlyFilesystem => None,
            Err(source) => return Err(StoreError::Io { path, source }),
        };
        if let Some(file) = &file {
            at(&path, file.lock())?;
        }
        let run = RunFile { id, file };
        run.write(&RunLine::Run { holder, command })?;
        Ok(run)
    }

    /// All runs that are written down, by their names.
    pub fn runs(&self) -> Result<Vec<Run>, StoreError> {
        self.read_runs("runs")
    }

    /// All pins, by their names.
    pub fn pins(&self) -> Result<Vec<Run>, StoreError> {
        self.read_runs("pins")
    }

    fn read_runs(&self, folder: &str) -> Result<Vec<Run>, StoreError> {
        let names = self.names(folder)?;
        let files = names.iter().filter(|name| name.ends_with(".jsonl"));
        Ok(files.filter_map(|name| Run::read(&self.root().join(folder).join(name))).collect())
    }

    /// Pins actions under a name: garbage collection keeps them until [`Store::unpin`].
    pub fn pin(
        &self,
        _: &Entered,
        name: &str,
        command: Vec<String>,
        actions: &[(String, String)],
    ) -> Result<(), StoreError> {
        let mut lines = vec![RunLine::Run { holder: Holder::this_process(), command }];
        lines.extend(
            actions
                .iter()
                .map(|(stage, key)| RunLine::Action { stage: stage.clone(), key: key.clone() }),
        );
        let texts = lines.iter().map(serde_json::to_string).collect::<Result<Vec<_>, _>>();
        let text = texts.map_err(|e| StoreError::NoArtifact(e.to_string()))?.join("\n") + "\n";
        let path = self.pin_path(name);
        at(&path, write_atomically(&path, text.as_bytes()))
    }

    /// Takes a pin away; whether there was one.
    pub fn unpin(&self, name: &str) -> Result<bool, StoreError> {
        let path = self.pin_path(name);
        match fs::remove_file(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
            result => at(&path, result).map(|()| true),
        }
    }

    fn pin_path(&self, name: &str) -> PathBuf {
        self.root().join("pins").join(format!("{name}.jsonl"))
    }

    /// Removes a run's file, what its sinks left, and what it submitted to a cluster.
    pub fn remove_run(&self, id: &str) -> Result<(), StoreError> {
        let (path, scratch) =
            (self.root().join("runs").join(format!("{id}.jsonl")), self.scratch(id));
        // A sink's leftovers have no value.
        fs::remove_dir_all(&scratch).ok();
        fs::remove_dir_all(self.root().join("slurm").join(id)).ok();
        at(&path, fs::remove_file(&path))
    }

    /// Where a run's sinks work.
    pub fn scratch(&self, run: &str) -> PathBuf {
        self.root().join("sinks").join(run)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::testing::entered;

    #[test]
    fn a_run_is_in_progress_while_its_file_is_held() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let file = store.begin_run(&entered(&store), vec!["nerf-sr".into(), "run".into()]).unwrap();
        file.needs(&entered(&store), "prep", "k1").unwrap();
        let waiting = Waiting {
            program: "train-ss".into(),
            parameters: json!({"rays": 3}).as_object().unwrap().clone(),
        };
        file.waits(&entered(&store), waiting.clone()).unwrap();
        let run = store.runs().unwrap().remove(0);
        assert!(run.in_progress && run.ended_unix.is_none());
        assert_eq!((run.keys, run.waiting), (BTreeSet::from(["k1".to_owned()]), vec![waiting]));
        let id = file.id().to_owned();
        file.end().unwrap();
        let path = dir.path().join(format!("runs/{id}.jsonl"));
        // What a kill cut short is left out.
        let text = fs::read_to_string(&path).unwrap() + "{\"action\":{\"sta";
        fs::write(&path, text).unwrap();
        let run = store.runs().unwrap().remove(0);
        assert!(!run.in_progress && run.ended_unix.is_some() && run.keys.len() == 1);
        store.remove_run(&id).unwrap();
        assert!(store.runs().unwrap().is_empty());
    }

    #[test]
    fn a_waiting_node_may_be_any_record_of_its_stage_and_parameters() {
        let waiting = Waiting {
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
            assert_eq!(waiting.may_be(&record), expected, "{parts}");
        }
    }

    #[test]
    fn pins_come_and_go() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        store.pin(&entered(&store), "paper", Vec::new(), &[("prep".into(), "k".into())]).unwrap();
        assert_eq!(store.pins().unwrap()[0].keys, BTreeSet::from(["k".to_owned()]));
        assert!(store.unpin("paper").unwrap() && !store.unpin("paper").unwrap());
    }
}

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use artifact::unix_time;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::action::Record;
use crate::error::{StoreError, if_found, with_path};
use crate::folder::Store;
use crate::lock::{Entered, Holder, is_locked};

/// Line of a run's file. Lines are appended as the needed actions become known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RunLine {
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
    pub(crate) fn read(
        store: &Store,
        kind: FileKind,
        id: &str,
    ) -> Result<Option<Self>, StoreError> {
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
pub(crate) enum FileKind {
    Run,
    Pin,
}

impl FileKind {
    pub(crate) fn folder(self) -> &'static str {
        match self {
            Self::Run => "runs",
            Self::Pin => "pins",
        }
    }

    pub(crate) fn path(self, store: &Store, id: &str) -> PathBuf {
        store.root().join(self.folder()).join(format!("{id}{EXTENSION}"))
    }

    fn damage(self, path: PathBuf, id: &str) -> StoreError {
        let (problem, remedy) = match self {
            Self::Run => (
                "the run's file is damaged",
                "move the file away, after which `gc` may delete what the run used".to_owned(),
            ),
            Self::Pin => {
                ("the pin is damaged", format!("run `nerf-sr unpin {id}`, then pin again"))
            }
        };
        StoreError::Content { path, problem: problem.to_owned(), remedy }
    }
}

/// Extension of runs' files and pins.
pub(crate) const EXTENSION: &str = ".jsonl";

/// Locked file of a run in progress, which records the needed actions. Garbage collection keeps
/// these during the run, and afterwards for the time given to `gc`.
#[derive(Debug)]
pub struct RunFile {
    pub(crate) id: String,
    pub(crate) path: PathBuf,
    /// `None` for a store on a read-only file system, where no garbage is collected.
    pub(crate) file: Option<File>,
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

    pub(crate) fn write(&self, line: &RunLine) -> Result<(), StoreError> {
        let Some(mut file) = self.file.as_ref() else { return Ok(()) };
        // One write per line, since threads of a run share the file.
        with_path(&self.path, file.write_all(line.text(&self.path)?.as_bytes()))
    }
}

impl RunLine {
    /// Formats the line of the file at `path`, with a line feed.
    pub(crate) fn text(&self, path: &Path) -> Result<String, StoreError> {
        let text = serde_json::to_string(self).map_err(std::io::Error::from);
        Ok(with_path(path, text)? + "\n")
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

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
}

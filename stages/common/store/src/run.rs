use std::collections::BTreeSet;
use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use artifact::unix_time;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::action::Record;
use crate::error::{StoreError, at, read_if_found};
use crate::folder::Store;
use crate::lock::{Entered, Holder, is_locked};

/// A line of a run's file: what the run needs becomes known while it goes on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RunLine {
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

    /// Reads the file of a run or a pin; `None` if it is not found.
    pub(crate) fn read(store: &Store, form: Form, id: &str) -> Result<Option<Self>, StoreError> {
        let path = form.path(store, id);
        let Some(bytes) = read_if_found(&path)? else { return Ok(None) };
        let text = String::from_utf8_lossy(&bytes);
        let mut run = Self {
            id: id.to_owned(),
            holder: None,
            command: Vec::new(),
            keys: BTreeSet::new(),
            waiting: Vec::new(),
            ended_unix: None,
            in_progress: is_locked(&path)?,
        };
        let mut is_whole = true;
        for line in text.lines() {
            match serde_json::from_str(line) {
                Ok(line) => run.take_in(line),
                Err(_) => is_whole = false,
            }
        }
        let is_sound = match form {
            // Pins are written whole.
            Form::Pin => is_whole && run.holder.is_some() && !run.keys.is_empty(),
            // A line that a kill or a full disk cut short says nothing, not even the first.
            Form::Run => run.holder.is_some() || is_cut(&text),
        };
        if is_sound { Ok(Some(run)) } else { Err(form.damage(path, id)) }
    }

    fn take_in(&mut self, line: RunLine) {
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
fn is_cut(text: &str) -> bool {
    text.is_empty() || (text.starts_with('{') && !text.contains('\n'))
}

/// Which of two kinds a file of [`RunLine`]s is.
#[derive(Clone, Copy)]
pub(crate) enum Form {
    Run,
    Pin,
}

impl Form {
    pub(crate) fn folder(self) -> &'static str {
        match self {
            Self::Run => "runs",
            Self::Pin => "pins",
        }
    }

    pub(crate) fn path(self, store: &Store, id: &str) -> PathBuf {
        store.root().join(self.folder()).join(format!("{id}{ENDING}"))
    }

    fn damage(self, path: PathBuf, id: &str) -> StoreError {
        let (problem, remedy) = match self {
            Self::Run => (
                "the file of a run is damaged",
                "move it away; `gc` then keeps what that run used for no longer".to_owned(),
            ),
            Self::Pin => ("the pin is damaged", format!("`nerf-sr unpin {id}`, then pin again")),
        };
        StoreError::Content { path, problem: problem.to_owned(), remedy }
    }
}

/// Ending of the names of runs' files and pins.
pub(crate) const ENDING: &str = ".jsonl";

/// A run in progress, which writes down what it needs. Garbage collection keeps that as long as
/// this lives, and as long afterwards as it is told to.
#[derive(Debug)]
pub struct RunFile {
    pub(crate) id: String,
    /// None in a store that can't be written: nobody collects garbage there.
    pub(crate) file: Option<File>,
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

    pub(crate) fn write(&self, line: &RunLine) -> Result<(), StoreError> {
        let Some(mut file) = self.file.as_ref() else { return Ok(()) };
        let text =
            serde_json::to_string(line).map_err(|e| StoreError::NoArtifact(e.to_string()))?;
        // One write a line: threads of a run share the file.
        at(Path::new(&self.id), file.write_all(format!("{text}\n").as_bytes()))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

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
}

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use artifact::{Failure, GivenInput, report_text, sized, write_json};
use serde::Serialize;

use crate::hooks::TestHooks;
use crate::memory::{available_memory, remaining_memory};
use crate::progress::{Progress, ProgressMode};

/// A file that a stage may leave in its output: a few words on the result, which the runner prints
/// at the end.
pub const SUMMARY_FILE: &str = "summary.txt";

/// Minimum amount that [`Context::check_memory`] logs: small scenes need less.
const LOGGED_BYTES: u64 = 1_000_000_000;

/// What a running stage has at hand.
pub struct Context {
    /// Threads to use (rayon's global pool has this size).
    pub threads: usize,
    /// Where to compute: `cpu` or `cuda:N`.
    pub device: String,
    pub(crate) inputs: BTreeMap<String, GivenInput>,
    pub(crate) output: PathBuf,
    pub(crate) work: Option<PathBuf>,
    pub(crate) from_checkpoint: bool,
    pub(crate) progress: ProgressMode,
    pub(crate) interrupted: Arc<AtomicBool>,
    /// Hash of the parameters, of what the inputs are, of the stage's code and of where it
    /// computes; none where an input has no manifest.
    pub(crate) identity: Option<String>,
    /// Whether it was said that something is there already.
    pub(crate) goes_on: AtomicBool,
}

impl Context {
    /// An input that must be there.
    ///
    /// # Errors
    /// [`Failure::Usage`] where it isn't given.
    pub fn input(&self, name: &str) -> Result<&GivenInput, Failure> {
        self.optional_input(name).ok_or_else(|| {
            Failure::Usage(format!("input {name} is missing; give --input {name}=DIR"))
        })
    }

    /// An input that may be left out.
    pub fn optional_input(&self, name: &str) -> Option<&GivenInput> {
        self.inputs.get(name)
    }

    /// The path of a file in the output; folders on the way are made.
    pub fn output_path(&self, file: &str) -> anyhow::Result<PathBuf> {
        let path = self.output.join(file);
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder)
                .with_context(|| format!("cannot make {}", folder.display()))?;
        }
        Ok(path)
    }

    /// Writes a JSON file of the output.
    pub fn write_json(&self, file: &str, value: &impl Serialize) -> anyhow::Result<()> {
        let path = self.output_path(file)?;
        write_json(&path, value).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Leaves a few words on the result, which the runner prints at the end.
    pub fn write_summary(&self, text: &str) -> anyhow::Result<()> {
        let path = self.output_path(SUMMARY_FILE)?;
        fs::write(&path, format!("{}\n", text.trim_end()))
            .with_context(|| format!("cannot write {}", path.display()))
    }

    /// The folder for checkpoints, where one was given.
    pub fn work(&self) -> Option<&Path> {
        self.work.as_deref()
    }

    /// Whether to write the output from the latest checkpoint in [`Context::work`], without further
    /// training. False unless the stage sets [`FROM_CHECKPOINT`](crate::Stage::FROM_CHECKPOINT).
    pub fn from_checkpoint(&self) -> bool {
        self.from_checkpoint
    }

    /// Starts a progress display.
    pub fn progress(&self, label: &str, total: u64) -> Progress {
        Progress::new(label, total, self.progress)
            .with_hooks(TestHooks::from_environment(&self.interrupted))
    }

    /// Says something to the person watching, on one line; it also lands in the action's log.
    pub fn say(&self, text: impl std::fmt::Display) {
        if self.progress != ProgressMode::None {
            report_text(&text.to_string());
        }
    }

    /// Logs the memory that some work needs, in bytes, if that is at least [`LOGGED_BYTES`].
    ///
    /// # Errors
    /// [`Failure::Usage`] with the remedy if less is free.
    pub fn check_memory(&self, work: &str, need: u64, remedy: &str) -> Result<(), Failure> {
        remaining_memory(work, need, available_memory()?, remedy)?;
        if need >= LOGGED_BYTES {
            self.say(format!("memory: about {} for {work}", sized(need)));
        }
        Ok(())
    }

    /// Whether a signal asked the stage to stop.
    pub fn interrupted(&self) -> bool {
        self.interrupted.load(Ordering::Relaxed)
    }

    /// Fails with [`Failure::Interrupted`] once a signal asked the stage to stop: for `?` in loops.
    pub fn check_interrupt(&self) -> anyhow::Result<()> {
        if self.interrupted() { Err(Failure::Interrupted.into()) } else { Ok(()) }
    }
}

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use artifact::{Failure, GivenInput, format_size, report_text, write_json};
use serde::Serialize;

use crate::memory::{available_memory, remaining_memory};
use crate::progress::{Progress, ProgressMode, TestHooks};

/// Optional file of an output with a short summary, which the runner prints at the end.
pub const SUMMARY_FILE: &str = "summary.txt";

/// Minimum amount that [`Context::check_memory`] logs; small scenes need less. Chosen by hand.
const MIN_LOGGED_BYTES: u64 = 1_000_000_000;

/// Inputs, output and settings of a running stage.
pub struct Context {
    /// Number of threads, which is the size of rayon's global pool.
    pub threads: usize,
    /// Compute device: `cpu`, `cuda` (the first GPU) or `cuda:N`.
    pub device: String,
    pub(crate) inputs: BTreeMap<String, GivenInput>,
    pub(crate) output: PathBuf,
    pub(crate) work: Option<PathBuf>,
    pub(crate) from_checkpoint: bool,
    pub(crate) progress: ProgressMode,
    pub(crate) interrupted: Arc<AtomicBool>,
    /// Hash of parameters, inputs, code and device; `None` if an input has no manifest.
    pub(crate) identity: Option<String>,
    /// True if a part of an earlier run was restored, which is logged once.
    pub(crate) resumed: AtomicBool,
}

impl Context {
    /// Returns a required input.
    ///
    /// # Errors
    /// [`Failure::Usage`] if the input isn't given.
    pub fn input(&self, name: &str) -> Result<&GivenInput, Failure> {
        self.optional_input(name).ok_or_else(|| {
            Failure::Usage(format!("input {name} is missing; give --input {name}=DIR"))
        })
    }

    /// Returns an optional input.
    pub fn optional_input(&self, name: &str) -> Option<&GivenInput> {
        self.inputs.get(name)
    }

    /// Returns the path of a file in the output, and creates its folder.
    pub fn output_path(&self, file: &str) -> anyhow::Result<PathBuf> {
        let path = self.output.join(file);
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder)
                .with_context(|| format!("cannot create {}", folder.display()))?;
        }
        Ok(path)
    }

    /// Writes a JSON file to the output.
    pub fn write_json(&self, file: &str, value: &impl Serialize) -> anyhow::Result<()> {
        let path = self.output_path(file)?;
        write_json(&path, value).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Writes a text file to the output.
    pub fn write_text(&self, file: &str, text: &str) -> anyhow::Result<()> {
        let path = self.output_path(file)?;
        fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Writes the summary that the runner prints at the end.
    pub fn write_summary(&self, text: &str) -> anyhow::Result<()> {
        self.write_text(SUMMARY_FILE, &format!("{}\n", text.trim_end()))
    }

    /// Returns the folder for checkpoints, if given.
    pub fn work(&self) -> Option<&Path> {
        self.work.as_deref()
    }

    /// True if the output is to be written from the latest checkpoint in [`Context::work`], without
    /// further training. Only stages with [`FROM_CHECKPOINT`](crate::Stage::FROM_CHECKPOINT) accept
    /// this option.
    pub fn from_checkpoint(&self) -> bool {
        self.from_checkpoint
    }

    /// Creates progress for a piece of work.
    pub fn progress(&self, label: &str, total: u64) -> Progress {
        Progress::new(label, total, self.progress)
            .with_hooks(TestHooks::from_environment(&self.interrupted))
    }

    /// Logs one line on stderr, which is also part of the action's log; with `--progress none`,
    /// nothing.
    pub fn log_line(&self, text: impl std::fmt::Display) {
        if self.progress != ProgressMode::None {
            report_text(&text.to_string());
        }
    }

    /// Logs the memory that `work` needs, `need` bytes, if that is at least [`MIN_LOGGED_BYTES`].
    ///
    /// # Errors
    /// [`Failure::Usage`] with `remedy` if less than `need` is free.
    pub fn check_memory(&self, work: &str, need: u64, remedy: &str) -> Result<(), Failure> {
        remaining_memory(work, need, available_memory()?, remedy)?;
        if need >= MIN_LOGGED_BYTES {
            self.log_line(format!("memory: about {} for {work}", format_size(need)));
        }
        Ok(())
    }

    /// Returns whether a signal has interrupted the stage.
    pub fn is_interrupted(&self) -> bool {
        self.interrupted.load(Ordering::Relaxed)
    }

    /// Fails with [`Failure::Interrupted`] if a signal has interrupted the stage.
    pub fn check_interrupt(&self) -> anyhow::Result<()> {
        if self.is_interrupted() { Err(Failure::Interrupted.into()) } else { Ok(()) }
    }
}

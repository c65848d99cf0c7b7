//! Checks that a stage's program is the planned one before its start and after its end: the key
//! contains its code.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use stage_call::{DescribeError, Interrupted, describe_all};
use store::Store;

use crate::stages::{DescriptionCache, StageProgram, is_own};
use crate::stamp::Stamp;

/// Error returned when a program differs from the planned one, or can't be compared with it.
#[derive(Debug, thiserror::Error)]
pub enum Unconfirmed {
    /// The program's file or its code differs.
    #[error("{0} was changed or rebuilt since this was planned; run again")]
    Changed(PathBuf),
    /// The program's file can't be read.
    #[error("{program}: {problem}")]
    File {
        /// The file.
        program: PathBuf,
        /// Error of the system.
        problem: std::io::Error,
    },
    /// The program no longer describes itself.
    #[error(transparent)]
    Describe(#[from] DescribeError),
    /// A signal came while the program was asked.
    #[error("interrupted")]
    Interrupted,
}

impl From<Interrupted> for Unconfirmed {
    fn from(_: Interrupted) -> Self {
        Self::Interrupted
    }
}

impl StageProgram {
    /// Returns whether the program lies in the runner's folder. Any other is somebody's file.
    pub fn is_own(&self) -> bool {
        is_own(&self.path)
    }

    /// Confirms before a start that the program is the planned one. Returns the file's stamp.
    pub fn confirm(&self, store: &Store, stop: Option<&AtomicBool>) -> Result<Stamp, Unconfirmed> {
        let now = self.stamp_now()?;
        if self.stamp == Some(now) {
            return Ok(now);
        }
        self.stamp.map_or(Ok(()), |planned| self.check_untouched(&planned, &now))?;
        self.ask_again(store, stop).map(|()| now)
    }

    /// Confirms after an end that the program was the planned one since the `start`. A program
    /// that isn't the runner's own may be a wrapper of another one, so it is asked again.
    pub fn confirm_since(
        &self,
        start: &Stamp,
        store: &Store,
        stop: Option<&AtomicBool>,
    ) -> Result<(), Unconfirmed> {
        let now = self.stamp_now()?;
        if now == *start && self.is_own() {
            return Ok(());
        }
        self.check_untouched(start, &now)?;
        self.ask_again(store, stop)
    }

    fn stamp_now(&self) -> Result<Stamp, Unconfirmed> {
        let program = || self.path.clone();
        Stamp::of(&self.path).map_err(|problem| Unconfirmed::File { program: program(), problem })
    }

    /// Fails if somebody's file was written to: an interpreter may read a script at any time. The
    /// runner's own programs stay in memory once they have started, and a build that changes none
    /// of their code may write their files anew.
    fn check_untouched(&self, before: &Stamp, now: &Stamp) -> Result<(), Unconfirmed> {
        if self.is_own() || now.is_untouched_since(before) {
            return Ok(());
        }
        Err(Unconfirmed::Changed(self.path.clone()))
    }

    fn ask_again(&self, store: &Store, stop: Option<&AtomicBool>) -> Result<(), Unconfirmed> {
        let path: &Path = &self.path;
        let mut answers = describe_all(&[path.to_path_buf()], stop)?;
        let Some(answer) = answers.remove(path) else { return Err(Unconfirmed::Interrupted) };
        if answer?.code == self.description.code {
            return Ok(());
        }
        // The file of a wrapper may be unchanged.
        DescriptionCache::forget(store, path);
        Err(Unconfirmed::Changed(path.to_path_buf()))
    }
}

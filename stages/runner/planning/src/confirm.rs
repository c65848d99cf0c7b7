//! Checks before a stage's start and after its end that its program is the planned one: the key
//! contains the hash of its code (docs/design/002).

use std::path::Path;
use std::sync::atomic::AtomicBool;

use crate::stage_call::{Interrupted, ProgramError, describe_all};
use store::Store;

use crate::stages::{DescriptionCache, StageProgram, is_own};
use crate::stamp::Stamp;

/// Error returned when a program differs from the planned one, or can't be compared with it.
#[derive(Debug, thiserror::Error)]
pub enum ConfirmError {
    /// The program's file or its code differs, or can't be read.
    #[error(transparent)]
    Program(#[from] ProgramError),
    /// A signal came while the program was described.
    #[error("interrupted")]
    Interrupted,
}

impl From<Interrupted> for ConfirmError {
    fn from(_: Interrupted) -> Self {
        Self::Interrupted
    }
}

fn changed(path: &Path) -> ConfirmError {
    let problem = "was changed or rebuilt after planning; run again";
    ProgramError(format!("{} {problem}", path.display())).into()
}

impl StageProgram {
    /// Returns whether the program is in the runner's folder. Others are the user's files.
    pub fn is_own(&self) -> bool {
        is_own(&self.path)
    }

    /// Checks before a stage's start that the program is the planned one. Returns the file's stamp.
    /// Programs that this one calls are checked after the stage's end.
    pub fn confirm(&self, store: &Store, stop: Option<&AtomicBool>) -> Result<Stamp, ConfirmError> {
        let now = self.stamp_now()?;
        if self.stamp == Some(now) {
            return Ok(now);
        }
        if let Some(planned) = &self.stamp {
            self.check_untouched(planned, &now)?;
        }
        self.check_code(store, stop)?;
        Ok(now)
    }

    /// Checks after a stage's end that the program was the planned one since the stage's start;
    /// `start` is the file's stamp at that time. Programs outside the runner's folder are always
    /// described again: they may call other programs.
    pub fn confirm_since(
        &self,
        start: &Stamp,
        store: &Store,
        stop: Option<&AtomicBool>,
    ) -> Result<(), ConfirmError> {
        let now = self.stamp_now()?;
        if now == *start && self.is_own() {
            return Ok(());
        }
        self.check_untouched(start, &now)?;
        self.check_code(store, stop)
    }

    fn stamp_now(&self) -> Result<Stamp, ConfirmError> {
        let path = self.path.display();
        Stamp::of(&self.path).map_err(|problem| ProgramError(format!("{path}: {problem}")).into())
    }

    /// Fails if a user's file was written to: an interpreter may read a script at any time. The
    /// runner's own programs are in memory after their start, and a build may rewrite their files
    /// without a change of code.
    fn check_untouched(&self, before: &Stamp, now: &Stamp) -> Result<(), ConfirmError> {
        if self.is_own() || now.is_untouched_since(before) {
            return Ok(());
        }
        Err(changed(&self.path))
    }

    /// Describes the program again. Fails if its code has changed.
    fn check_code(&self, store: &Store, stop: Option<&AtomicBool>) -> Result<(), ConfirmError> {
        let path = &self.path;
        let mut descriptions = describe_all(std::slice::from_ref(path), stop)?;
        let description = descriptions.remove(path).ok_or(ConfirmError::Interrupted)?;
        if description?.code == self.description.code {
            return Ok(());
        }
        // The cache knows a wrapper script by its own file, which may be unchanged.
        DescriptionCache::forget(store, path);
        Err(changed(path))
    }
}

//! Checks before a stage's start and after its end that its program is the planned one: the key
//! contains the hash of its code (docs/design/002).

use std::path::Path;
use std::sync::atomic::AtomicBool;

use store::Store;

use crate::request::PlanError;
use crate::sources::Stamp;
use crate::stage_call::describe_all;
use crate::stages::{DescriptionCache, StageProgram, is_own};

fn changed(path: &Path) -> PlanError {
    let problem = "was changed or rebuilt after planning; run again";
    PlanError::Usage(format!("{} {problem}", path.display()))
}

impl StageProgram {
    /// Returns whether the program is in the runner's folder. Others are the user's files.
    pub fn is_own(&self) -> bool {
        is_own(&self.path)
    }

    /// Checks before a stage's start that the program is the planned one. Returns the file's stamp.
    /// Programs that this one calls are checked after the stage's end.
    pub fn confirm(&self, store: &Store, stop: Option<&AtomicBool>) -> Result<Stamp, PlanError> {
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
    ) -> Result<(), PlanError> {
        let now = self.stamp_now()?;
        if now == *start && self.is_own() {
            return Ok(());
        }
        self.check_untouched(start, &now)?;
        self.check_code(store, stop)
    }

    fn stamp_now(&self) -> Result<Stamp, PlanError> {
        let path = self.path.display();
        Stamp::of(&self.path).map_err(|problem| PlanError::Usage(format!("{path}: {problem}")))
    }

    /// Fails if a user's file was written to: an interpreter may read a script at any time. The
    /// runner's own programs are in memory after their start, and a build may rewrite their files
    /// without a change of code.
    fn check_untouched(&self, before: &Stamp, now: &Stamp) -> Result<(), PlanError> {
        if self.is_own() || now.is_untouched_since(before) {
            return Ok(());
        }
        Err(changed(&self.path))
    }

    /// Describes the program again. Fails if its code has changed.
    fn check_code(&self, store: &Store, stop: Option<&AtomicBool>) -> Result<(), PlanError> {
        let path = &self.path;
        let description = describe_all(std::slice::from_ref(path), stop)
            .and_then(|mut descriptions| descriptions.remove(path))
            .ok_or(PlanError::Interrupted)?;
        if description?.code == self.description.code {
            return Ok(());
        }
        // The cache knows a wrapper script by its own file, which may be unchanged.
        DescriptionCache::forget(store, path);
        Err(changed(path))
    }
}

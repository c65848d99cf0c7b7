//! Calls of Slurm's programs.

use std::ffi::{OsStr, OsString};
use std::path::PathBuf;
use std::process::Command;

use crate::SlurmError;

/// Maximum number of jobs in one call of `scancel`, which keeps its command line short; chosen by
/// hand.
const MAX_IDS_PER_CALL: usize = 500;

/// Slurm's programs.
#[derive(Clone, Debug, Default)]
pub struct Slurm {
    /// Folder of the programs in tests; empty if they are found by PATH.
    folder: PathBuf,
}

/// Returns the ID of the job that this process runs in.
pub fn current_job_id() -> Option<String> {
    std::env::var("SLURM_JOB_ID").ok()
}

impl Slurm {
    /// Returns the programs in a folder.
    #[cfg(test)]
    pub(crate) fn in_folder(folder: impl Into<PathBuf>) -> Self {
        Self { folder: folder.into() }
    }

    /// Submits a job and returns its ID.
    pub(crate) fn sbatch(&self, arguments: &[OsString]) -> Result<String, SlurmError> {
        let stdout = self.call("sbatch", arguments)?;
        // `ID`, or `ID;CLUSTER`. A site's submit filter may print lines before it.
        let last = stdout.trim().lines().last().unwrap_or_default();
        let id = last.split(';').next().unwrap_or_default();
        if id.is_empty() || !id.bytes().all(|b| b.is_ascii_digit()) {
            let problem = format!("sbatch: expected a job ID, found {last:?}");
            return Err(SlurmError(format!("{problem}; check that sbatch works in this shell")));
        }
        Ok(id.to_owned())
    }

    /// Lists the jobs of some users, one line per job in the given format.
    pub(crate) fn squeue(&self, users: &[String], format: &str) -> Result<String, SlurmError> {
        self.call("squeue", &["--noheader", "--user", &users.join(","), "--format", format])
    }

    /// Cancels jobs.
    pub fn cancel(&self, ids: &[&str]) -> Result<(), SlurmError> {
        ids.chunks(MAX_IDS_PER_CALL).try_for_each(|some| self.call("scancel", some).map(drop))
    }

    /// Ends a running job and puts it back into the queue.
    pub fn requeue(&self, id: &str) -> Result<(), SlurmError> {
        self.call("scontrol", &["requeue", id]).map(drop)
    }

    /// Calls a program and returns its stdout.
    fn call(&self, program: &str, arguments: &[impl AsRef<OsStr>]) -> Result<String, SlurmError> {
        let mut command = Command::new(self.folder.join(program));
        // A user's defaults for `squeue`, such as a state filter, would hide jobs.
        for (name, _) in std::env::vars_os() {
            if name.as_encoded_bytes().starts_with(b"SQUEUE_") {
                command.env_remove(name);
            }
        }
        let output = command.args(arguments).output().map_err(|problem| {
            let remedy = "run this where Slurm's programs are on PATH";
            SlurmError(format!("{program}: {problem}; {remedy}"))
        })?;
        if output.status.success() {
            return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
        }
        let stderr = String::from_utf8_lossy(&output.stderr);
        let lines: Vec<&str> =
            stderr.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
        let mut reason = lines.join("; ").replace(&format!("{program}: "), "");
        if reason.is_empty() {
            reason = format!("failed ({})", output.status);
        }
        Err(SlurmError(format!("{program}: {reason}")))
    }
}

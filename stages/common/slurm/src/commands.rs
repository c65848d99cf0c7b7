//! Calls of Slurm's programs.

use std::ffi::{OsStr, OsString};
use std::path::PathBuf;
use std::process::Command;

use crate::error::SlurmError;

/// Most jobs that one call names: a command line has an end.
const MOST_IDS: usize = 500;

/// Slurm's programs.
#[derive(Clone, Debug, Default)]
pub struct Slurm {
    /// Their folder; without one they are found by PATH.
    folder: Option<PathBuf>,
}

/// The job that this process runs in.
pub fn this_job() -> Option<String> {
    std::env::var("SLURM_JOB_ID").ok()
}

/// The cores that this job may use; outside of a job all of the machine.
pub fn cores() -> usize {
    let given = std::env::var("SLURM_CPUS_ON_NODE")
        .ok()
        .and_then(|text| text.parse().ok())
        .filter(|&n| n > 0);
    given.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, std::num::NonZero::get))
}

impl Slurm {
    /// The programs in a folder.
    pub fn in_folder(folder: impl Into<PathBuf>) -> Self {
        Self { folder: Some(folder.into()) }
    }

    /// Submits a job; its number.
    pub(crate) fn sbatch(&self, arguments: &[OsString]) -> Result<String, SlurmError> {
        let said = self.call("sbatch", arguments)?;
        // `NUMBER`, or `NUMBER;CLUSTER`. A site's own filter may have talked before.
        let last = said.trim().lines().last().unwrap_or_default();
        let id = last.split(';').next().unwrap_or_default();
        if id.is_empty() || !id.bytes().all(|b| b.is_ascii_digit()) {
            return Err(SlurmError::Refused {
                program: "sbatch",
                said: format!("it gave no job's number but {last:?}"),
            });
        }
        Ok(id.to_owned())
    }

    /// What the queue says of some users' jobs, in lines of a format.
    pub(crate) fn squeue(&self, users: &[String], format: &str) -> Result<String, SlurmError> {
        self.call("squeue", &["--noheader", "--user", &users.join(","), "--format", format])
    }

    /// Cancels jobs.
    pub fn cancel(&self, ids: &[&str]) -> Result<(), SlurmError> {
        ids.chunks(MOST_IDS).try_for_each(|some| self.call("scancel", some).map(drop))
    }

    /// Puts a running job into the queue once more; it is ended.
    pub fn requeue(&self, id: &str) -> Result<(), SlurmError> {
        self.call("scontrol", &["requeue", id]).map(drop)
    }

    fn call(
        &self,
        program: &'static str,
        arguments: &[impl AsRef<OsStr>],
    ) -> Result<String, SlurmError> {
        let path = self
            .folder
            .as_ref()
            .map_or_else(|| PathBuf::from(program), |folder| folder.join(program));
        let mut command = Command::new(path);
        // What a user wants to see of the queue by default hides nothing here.
        for (name, _) in
            std::env::vars_os().filter(|(name, _)| name.as_encoded_bytes().starts_with(b"SQUEUE_"))
        {
            command.env_remove(name);
        }
        let output = command
            .args(arguments)
            .output()
            .map_err(|source| SlurmError::Absent { program, source })?;
        if output.status.success() {
            return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
        }
        let said = String::from_utf8_lossy(&output.stderr);
        let lines: Vec<&str> =
            said.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
        let said = lines.join("; ").replace(&format!("{program}: "), "");
        let said = if said.is_empty() { format!("it failed ({})", output.status) } else { said };
        Err(SlurmError::Refused { program, said })
    }
}

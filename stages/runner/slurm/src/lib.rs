//! Interface to Slurm: submits tasks with dependencies as jobs and exits, so that no process has to
//! stay.
//!
//! * [`Resources`]: cores, memory, GPUs and time of a stage, as a pipeline file states them, in
//!   [`Memory`] and [`Period`]. [`Site`]: settings of a cluster.
//! * [`Submission`]: a folder with the [`Task`]s, the jobs' script and the jobs' logs. Tasks of all
//!   submissions are recognised by their identities.
//! * [`Queue`]: the jobs of a store, read from Slurm once. No file of ours lists queued jobs.
//! * [`Submission::submit`]: submits a job for each task that is neither done nor queued.
//!   [`Slurm`] calls Slurm's programs.
//!
//! This crate knows neither stages nor artifacts: a job runs a command given by the caller.
//!
//! ```
//! use slurm::{Resources, Site};
//!
//! let default: Resources = serde_yaml::from_str("{cpus: 4, mem: 8G}")?;
//! let stage: Resources = serde_yaml::from_str("{mem: 16G, gpus: 1, time: 1d12h}")?;
//! let resources = default.overridden_by(&stage);
//! assert!(resources.has_gpu());
//! assert_eq!(resources.mem.unwrap().to_string(), "16G");
//! assert_eq!(Site::default().problem_with(&resources), None);
//! # Ok::<(), serde_yaml::Error>(())
//! ```

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod amounts;
mod commands;
mod queue;
mod resources;
mod site;
mod submission;
mod submit;

use std::path::Path;

pub use amounts::{Memory, Period};
pub use commands::{Slurm, current_job_id};
pub use queue::{Job, Queue};
pub use resources::Resources;
pub use site::Site;
pub use submission::{Submission, Task, list_submissions, lock_path, newest_logs};
pub use submit::{SubmitOptions, Submitted};

/// Error of a call of Slurm, of a file of a submission or site, or of an amount's text.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct SlurmError(String);

impl SlurmError {
    pub(crate) fn file(path: &Path, problem: impl std::fmt::Display) -> Self {
        Self(format!("{}: {problem}", path.display()))
    }
}

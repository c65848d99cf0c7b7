//! Slurm from outside: tasks that need one another become jobs, and nobody stays to watch them.
//!
//! * [`Resources`]: what a stage needs, as a pipeline file says it, in [`Memory`] and [`Period`].
//!   [`Site`]: what a cluster wants besides.
//! * [`Submission`]: a folder with the [`Task`]s, the job's script and the jobs' logs; a task is
//!   known again by its identity.
//! * [`Queue`]: the jobs of a store, asked for once. Slurm's queue is the only place in which it
//!   stands what is queued.
//! * [`Submission::submit`]: a job for each task that isn't done and isn't queued. [`Slurm`] calls
//!   Slurm's programs.
//!
//! This crate knows neither stages nor artifacts. What a job does is the command's affair that its
//! script runs.
//!
//! ```
//! use slurm::{Resources, Site};
//!
//! let default: Resources = serde_yaml::from_str("{cpus: 4, mem: 8G}")?;
//! let stage: Resources = serde_yaml::from_str("{mem: 16G, gpus: 1, time: 1d12h}")?;
//! let resources = default.changed(&stage);
//! assert!(resources.has_gpu());
//! assert_eq!(resources.mem.unwrap().to_string(), "16G");
//! assert_eq!(Site::default().problem(&resources), None);
//! # Ok::<(), serde_yaml::Error>(())
//! ```

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod amounts;
mod arguments;
mod commands;
mod error;
mod queue;
mod resources;
mod script;
mod site;
mod submission;
mod submit;

pub use amounts::{AmountError, Memory, Period};
pub use commands::{Slurm, cores, this_job};
pub use error::SlurmError;
pub use queue::{Job, Queue};
pub use resources::Resources;
pub use site::Site;
pub use submission::{Submission, Task, all, job_logs};
pub use submit::{Submitted, Terms};

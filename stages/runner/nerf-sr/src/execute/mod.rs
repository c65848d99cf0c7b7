//! Executors of a plan: this machine, or the jobs of a cluster.

mod budget;
mod local;
mod node;
mod slurm;

use std::process::ExitCode;

use crate::session::Run;

pub(crate) use budget::Budget;
pub(crate) use local::Local;
pub(crate) use node::NodeJob;
pub(crate) use slurm::{Cluster, JOB_VERB};

/// Carries out plans.
pub(crate) trait Executor {
    /// Runs missing nodes and sinks, or submits jobs that will. Returns the run's exit code.
    fn carry_out(&self, run: &Run<'_>) -> anyhow::Result<ExitCode>;
}

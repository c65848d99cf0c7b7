//! Executors of a plan: this machine, or the jobs of a cluster.

mod budget;
mod local;
mod node;
mod slurm;

pub(crate) use budget::Budget;
pub(crate) use local::Local;
pub(crate) use node::{Lookup, NodeJob};
pub(crate) use slurm::{Cluster, JOB_VERB};

//! Who sees to it that a plan's nodes are made: this process, or a cluster's jobs.

mod local;
mod node;
mod places;
mod slurm;
mod work;

pub(crate) use local::{Local, say_aside};
pub(crate) use node::NodeJob;
pub(crate) use places::Budget;
pub(crate) use slurm::{Cluster, JOB_VERB};
pub(crate) use work::{Executor, Work};

//! `nerf-sr`, the runner: pipeline.yaml → plan → run. It knows stages by their `describe` alone and artifacts by their hashes.
//!
//! * [`Pipeline`]: the file as written, checked whole before anything runs.
//! * [`Plan`]: stages × swept values as nodes in an order that works; what is cached, what will run, what waits.
//! * `key`: the parts of an action's key; one list feeds both the hash and `why`.
//! * `execute`: runs nodes, some at once, each under its key's lock.
//! * `sink`: hands the run's record to stages that show it (the report).

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod cli;
mod clock;
mod counts;
mod execute;
mod gc;
mod graph;
mod key;
mod limits;
mod pipeline;
mod plan;
mod process;
mod publish;
mod remedy;
mod session;
mod sink;
mod sources;
mod stage_log;
mod stages;
mod verbs;
mod verdict;
mod waiting;
mod words;

pub use cli::main;
pub use pipeline::{Pipeline, PipelineError, StageBlock};
pub use plan::{Node, Plan, PlanError};

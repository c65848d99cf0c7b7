//! `nerf-sr`, the runner: pipeline.yaml → plan → run. It knows stages by their `describe` alone and artifacts by their hashes.
//!
//! * [`PipelineFile`]: a file as written. [`Pipeline`]: its blocks with those of the files that it extends, checked whole
//!   before anything runs. `targets` finds what pipeline.yaml doesn't have in `pipelines/`.
//! * [`Plan`]: stages × swept values as nodes in an order that works; what is cached, what will run, what waits. `check` looks at the whole
//!   file, `arguments` and `axes` at the command line, `expand` makes the nodes.
//! * `stages`: what each stage says of itself; `describing` asks those that aren't known.
//! * `key`: the parts of an action's key; one list feeds both the hash and `why`.
//! * `node_report`: what is known of a plan's nodes, for programs. `lineage`: two results with all that they were made of.
//! * `execute`: runs nodes, some at once, each under its key's lock.
//! * `sink`: hands the run's record to stages that show it (the report).

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod arguments;
mod axes;
mod changes;
mod check;
mod cli;
mod clock;
mod counts;
mod describing;
mod execute;
mod expand;
mod extend;
mod file;
mod gc;
mod graph;
mod key;
mod limits;
mod lineage;
mod node_report;
mod pipeline;
mod plan;
mod process;
mod publish;
mod remedy;
mod renames;
mod session;
mod sink;
mod sources;
mod stage_log;
mod stages;
mod targets;
mod verbs;
mod verdict;
mod waiting;
mod words;
mod yaml;

pub use cli::main;
pub use file::{PipelineFile, StageBlock};
pub use key::explain;
pub use pipeline::{Part, Pipeline, PipelineError};
pub use plan::{Node, Plan, PlanError, Request};

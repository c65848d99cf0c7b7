//! `nerf-sr`, the runner: pipeline.yaml → plan → run. It knows stages by their `describe` alone and artifacts by their hashes.
//!
//! * [`PipelineFile`]: a file as written. [`Pipeline`]: its blocks with those of the files that it extends, checked whole
//!   before anything runs. `targets` finds what pipeline.yaml doesn't have in `pipelines/`.
//! * [`Plan`]: stages × swept values as nodes in an order that works; what is cached, what will run, what waits. `check` looks at the whole
//!   file, `arguments` and `axes` at the command line, `expand` makes the nodes.
//! * [`Experiment`]: scenes, protocols and variants of a file, each of which sets several things.
//! * `stages`: what each stage says of itself; those that aren't known are asked.
//! * `key`: the parts of an action's key; one list feeds both the hash and `why`.
//! * `node_report`: what is known of a plan's nodes, for programs. `lineage`: two results with all that they were made of.
//! * `execute`: carries out a plan, here or by a cluster's jobs; each node under its key's lock.
//! * `sink`: hands the run's record to stages that show it (the report).

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod arguments;
mod axes;
mod changes;
mod check;
mod cli;
mod counts;
mod execute;
mod expand;
mod experiment;
mod extend;
mod file;
mod graph;
mod key;
mod left_out;
mod limits;
mod lineage;
mod node_report;
mod pipeline;
mod plan;
mod publish;
mod remedy;
mod renames;
mod session;
mod sink;
mod sources;
mod stages;
mod targets;
mod verbs;
mod waiting;
mod words;

pub use cli::main;
pub use experiment::{Choice, Experiment, Variant};
pub use file::{PipelineFile, StageBlock};
pub use key::explain;
pub use pipeline::{Part, Pipeline, PipelineError};
pub use plan::{Node, Plan, PlanError, Request};

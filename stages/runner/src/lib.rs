//! `nerf-sr`, the runner: pipeline.yaml → plan → run. It knows stages by their `describe` alone and
//! artifacts by their hashes.
//!
//! Planning has a crate of its own, `planning`. Here is what is done with a plan.
//!
//! * `node_report`: what is known of a plan's nodes, for programs. `lineage`: two results with all
//!   that they were made of.
//! * `identities`: what nodes are known by before their keys are.
//! * `execute`: carries out a plan, here or by a cluster's jobs; each node under its key's lock.
//! * `unchanged`: whether programs and inputs stay what a key was made of while a stage runs.
//! * `watch`: shows one test view of a field while the field trains.
//! * `sink`: hands the run's record (`recorded`) to stages that show it (the report), and puts what
//!   they make in its place (`publish`, `owned`, `aside`).

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod aside;
mod cli;
mod counts;
mod execute;
mod identities;
mod limits;
mod lineage;
mod node_report;
mod owned;
mod publish;
mod recorded;
mod remedy;
mod session;
mod sink;
mod unchanged;
mod verbs;
mod waiting;
mod watch;
mod words;

pub use cli::main;

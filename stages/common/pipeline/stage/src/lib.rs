//! Command line of a stage: arguments, parameters, progress, exit codes, output.
//!
//! * [`Stage`] and [`main!`]: a stage implements the trait and gets arguments, checked
//!   parameters, `describe`, progress, exit codes, interruption and an atomic output for free.
//! * [`Context`]: inputs, output and checkpoint folder of a running stage.
//! * [`Description`], [`Schema`], [`Rule`]: a stage's description, and the checks of values against
//!   it.
//! * [`Progress`], [`Event`]: progress reports for a terminal and for the runner.
//! * [`Training`], [`Context::train`]: a resumable training in steps; [`CheckpointSchedule`]: times
//!   at which a training writes checkpoints.
//! * [`stop_on_signals`], [`install_panic_hook`]: early end of a program by a signal or a panic;
//!   the runner uses them, too.
//! * [`available_memory`], [`processors`], [`check_device`]: limits of memory, the default number
//!   of threads, and the compute device.
//!
//! The crate knows neither images nor tensors nor the store. Artifacts and failures are in
//! `artifact`.
//!
//! [`main!`] expands to this example's function `main`, with the code's fingerprint:
//!
//! ```no_run
//! use stage::{Context, Output, Stage, run_stage};
//!
//! #[derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema, Default)]
//! #[serde(default, deny_unknown_fields)]
//! struct Params {
//!     /// Whom to greet.
//!     name: String,
//! }
//! struct Greet;
//! impl Stage for Greet {
//!     type Params = Params;
//!     const NAME: &'static str = "greet";
//!     const SUMMARY: &'static str = "Writes a greeting.";
//!     fn output() -> Output { Output::kind("text") }
//!     fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
//!         std::fs::write(context.output_path("greeting.txt")?, &params.name)?;
//!         Ok(())
//!     }
//! }
//! fn main() -> std::process::ExitCode {
//!     run_stage::<Greet>(env!("CARGO_PKG_VERSION"), "code-fingerprint")
//! }
//! ```

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod arguments;
mod context;
mod contract;
mod ending;
mod memory;
#[cfg(test)]
mod panic_tests;
mod parts;
mod processors;
mod progress;
mod run;
#[cfg(test)]
mod signal_tests;
mod stage;
mod staging;
mod training;

pub use arguments::check_device;
pub use context::{Context, SUMMARY_FILE};
pub use contract::{
    ContractError, Description, GivenInputs, Input, Output, PARAMETER_GROUPS, ParameterDoc,
    ParameterProblem, ParameterSection, Rule, Schema, group_parameters, plain, render_help,
};
pub use ending::{install_panic_hook, stop_on_signals, stop_signals};
pub use memory::{
    MEMORY_REMEDY, MEMORY_VARIABLE, available_memory, machine_memory, out_of_memory_message,
    remaining_memory,
};
pub use processors::{ALL_PROCESSORS, Processors, processors, start_threads};
pub use progress::{Event, Pace, Progress, ProgressMode, SLOW_VARIABLE, STOP_VARIABLE, join_parts};
pub use run::{RUNNER_VARIABLE, run_stage};
pub use stage::Stage;
pub use training::{CheckpointSchedule, Training};

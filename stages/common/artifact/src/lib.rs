//! The stage contract: what makes an executable a stage of the pipeline.
//!
//! * [`Stage`] and [`run_stage`]: a stage implements the trait and gets arguments, checked
//!   parameters, `describe`, progress, exit codes, interruption and an atomic output for free.
//! * [`Manifest`]: the `artifact.json` of an artifact (kind, and each file's path, size and
//!   blake3); its hash is the artifact's identity.
//! * [`RunRecord`]: what a sink (the report) is told of a run.
//! * [`canonical`]: the one JSON form that is ever hashed.
//!
//! No pixels, no tensors, no store: the runner uses this crate, too.
//!
//! ```no_run
//! use artifact::{Context, Description, Output, Stage, run_stage};
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

mod amounts;
mod canonical;
mod console;
mod describe;
mod device;
mod documented;
mod failure;
mod fsio;
mod help;
mod manifest;
mod memory;
mod nearest;
mod panics;
mod parameters;
mod parts;
mod printable;
mod progress;
mod renames;
mod rules;
mod run_record;
mod signals;
mod stage;
mod tagged;
mod validator;
mod values;
mod warnings;

pub use amounts::{amount, counted, sized};
pub use canonical::{canonical, hash_json};
pub use console::{print_lines, print_text, report_text};
pub use describe::{Description, DescriptionError, Input, Output};
pub use device::{DeviceError, check_device};
pub use documented::{GROUPS, ParameterSection, ParameterText, by_group};
pub use failure::{Failure, FailureExt, exit_code, one_line};
pub use fsio::{sync_folder, write_atomically, write_json};
pub use manifest::{
    Damage, FileEntry, MANIFEST_FILE, Manifest, PathError, hash_files, list_files, relative_path,
};
pub use memory::{MEMORY_REMEDY, MEMORY_VARIABLE, available_memory, machine_memory, out_of_memory};
pub use nearest::{known_names, nearest};
pub use panics::install_panic_hook;
pub use parameters::{ParameterProblem, Schema, SchemaError};
pub use printable::printable;
pub use progress::{Event, Pace, Progress, ProgressMode, STOP_VARIABLE};
pub use renames::{Named, RENAMES, Rename, renamed, renamed_in};
pub use rules::{GivenInputs, Rule, RuleError};
pub use run_record::{
    FailedPoint, RunInput, RunNode, RunRecord, RunRecordError, UnfinishedNode, folders_of, label,
};
pub use signals::stop_on_signals;
pub use stage::{Context, GivenInput, RUNNER_VARIABLE, SUMMARY_FILE, Stage, run_stage};
pub use warnings::{WARNING, warnings_of, with_warnings};

/// Seconds since 1970.
pub fn unix_time() -> u64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

//! The stage contract: what makes an executable a stage of the pipeline, and where its results are kept.
//!
//! * [`Stage`] and [`run_stage`]: a stage implements the trait and gets arguments, checked parameters, `describe`, progress,
//!   exit codes, interruption and an atomic output for free.
//! * [`Manifest`]: the `artifact.json` of an artifact (kind, and each file's path, size and blake3); its hash is the artifact's identity.
//! * [`Store`]: objects by content, actions by key, one OS lock a key.
//! * [`RunRecord`]: what a sink (the report) is told of a run.
//! * [`canonical`]: the one JSON form that is ever hashed.
//!
//! No pixels, no tensors: the runner uses this crate alone.
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

mod amounts;
mod canonical;
mod describe;
mod failure;
mod fsio;
mod manifest;
mod parameters;
mod parts;
mod printable;
mod progress;
mod run_record;
mod stage;
mod store;
mod warnings;

pub use amounts::{amount, counted};
pub use canonical::{canonical, hash_json};
pub use describe::{Description, Input, Output};
pub use failure::{Failure, FailureExt, exit_code, one_line};
pub use fsio::{write_atomically, write_json};
pub use manifest::{Damage, FileEntry, MANIFEST_FILE, Manifest, hash_folder, relative_path};
pub use parameters::{ParameterProblem, Schema};
pub use printable::printable;
pub use progress::{Event, Pace, Progress, ProgressMode};
pub use run_record::{RunInput, RunNode, RunRecord};
pub use stage::{Context, GivenInput, RUNNER_VARIABLE, SUMMARY_FILE, Stage, run_stage};
pub use store::{Attempt, KeyLock, Record, Store, StoreError};
pub use warnings::{WARNING, warnings_of, with_warnings};

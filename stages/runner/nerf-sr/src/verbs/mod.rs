//! The verbs of the command line.

mod advise;
mod diff;
mod gc;
mod graph;
mod jobs;
mod log;
mod path;
mod pin;
mod run;
mod standalone;
mod states;
mod verify;

use serde::Serialize;

pub(crate) use advise::{Limits, advise};
pub(crate) use diff::diff;
pub(crate) use gc::gc;
pub(crate) use graph::{GraphFormat, graph};
pub(crate) use jobs::{cancel, job};
pub(crate) use log::log;
pub(crate) use path::path;
pub(crate) use pin::{pin, unpin};
pub(crate) use run::run;
pub(crate) use standalone::{completions, describe, init, man};
pub(crate) use states::{plan, status, why};
pub(crate) use verify::verify;

/// Prints a value as JSON.
fn print_json(value: &impl Serialize) -> anyhow::Result<()> {
    artifact::print_lines(&serde_json::to_string_pretty(value)?);
    Ok(())
}

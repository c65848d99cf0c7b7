//! The verbs of the command line.

pub(crate) mod advise;
pub(crate) mod diff;
pub(crate) mod gc;
pub(crate) mod graph;
pub(crate) mod jobs;
pub(crate) mod log;
pub(crate) mod path;
pub(crate) mod pin;
pub(crate) mod run;
pub(crate) mod standalone;
pub(crate) mod states;
pub(crate) mod verify;

use serde::Serialize;

/// Prints a value as JSON.
fn print_json(value: &impl Serialize) -> anyhow::Result<()> {
    artifact::print_lines(&serde_json::to_string_pretty(value)?);
    Ok(())
}

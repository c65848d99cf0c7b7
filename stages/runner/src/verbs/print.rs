use std::process::ExitCode;

use serde::Serialize;

/// Prints something for programs.
pub(super) fn print_json(told: &impl Serialize) -> anyhow::Result<ExitCode> {
    artifact::print_lines(&serde_json::to_string_pretty(told)?);
    Ok(ExitCode::SUCCESS)
}

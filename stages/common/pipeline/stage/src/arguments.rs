//! Command-line arguments of a stage.

use std::fs;
use std::path::{Path, PathBuf};

use crate::contract::{Description, Schema};
use anyhow::anyhow;
use artifact::{Failure, FailureExt as _, bail_usage, known_names};
use serde_json::Value;

use crate::progress::ProgressMode;

#[derive(clap::Parser)]
#[command(subcommand_negates_reqs = true, args_conflicts_with_subcommands = true)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Option<Command>,
    /// JSON file with parameters; omitted ones have their defaults
    #[arg(long, value_name = "FILE")]
    pub(crate) params: Option<PathBuf>,
    /// Name of an input and its folder; may be repeated
    #[arg(long = "input", value_name = "NAME=DIR")]
    pub(crate) inputs: Vec<String>,
    /// Folder to create; must not exist, and appears only when complete
    #[arg(long, value_name = "DIR", required = true)]
    pub(crate) output: Option<PathBuf>,
    /// Private folder for checkpoints, which survives an interruption
    #[arg(long, value_name = "DIR")]
    pub(crate) work: Option<PathBuf>,
    /// Write the output from the latest checkpoint in --work, without further training
    #[arg(long, requires = "work")]
    pub(crate) from_checkpoint: bool,
    /// Compute device: cpu, cuda (the first GPU) or cuda:N
    #[arg(long, default_value = "cpu")]
    pub(crate) device: String,
    // Its help is `threads_help`.
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
    /// Format of progress reports
    #[arg(long, value_enum, default_value = "plain")]
    pub(crate) progress: ProgressMode,
}

#[derive(clap::Subcommand)]
pub(crate) enum Command {
    /// Print name, code fingerprint, parameters, inputs and output as JSON
    Describe,
}

/// Parses the inputs' names and folders. Fails for an unknown input and for a missing one.
pub(crate) fn input_folders<'a>(
    given: &'a [String],
    description: &Description,
) -> anyhow::Result<Vec<(&'a str, &'a Path)>> {
    let mut folders = Vec::new();
    for text in given {
        let (name, folder) = text
            .split_once('=')
            .ok_or_else(|| Failure::Usage(format!("--input {text}: expected NAME=DIR")))?;
        if !description.inputs.contains_key(name) {
            let known = known_names(name, description.inputs.keys().map(String::as_str));
            bail_usage!("--input {name}: no such input; {known}");
        }
        folders.push((name, Path::new(folder)));
    }
    for (name, input) in &description.inputs {
        if !input.optional && !folders.iter().any(|(given, _)| given == name) {
            bail_usage!("input {name} is missing; give --input {name}=DIR ({})", input.summary);
        }
    }
    Ok(folders)
}

/// Checked parameters.
pub(crate) struct Parameters {
    /// Values of all parameters.
    pub(crate) resolved: Value,
    /// Values in the form of the stage's own type.
    pub(crate) nested: Value,
    /// Name of the argument, for messages.
    pub(crate) context: String,
}

/// Reads and checks the parameters, or takes the defaults without a file.
pub(crate) fn read_params(
    file: Option<&Path>,
    description: &Description,
) -> anyhow::Result<Parameters> {
    let context = format!("--params {}", file.unwrap_or(Path::new("")).display());
    let given = match file {
        None => serde_json::Map::new(),
        Some(path) => {
            let bytes = fs::read(path).usage(&context)?;
            serde_json::from_slice(&bytes).usage(format!("{context}: expected a JSON object"))?
        }
    };
    let schema = Schema::new(&description.parameters)
        .map_err(|e| anyhow!("the stage's own parameter schema: {e}"))?;
    let resolved = schema.resolve(&given).map_err(|problems| {
        let problems: Vec<String> = problems.iter().map(ToString::to_string).collect();
        Failure::Usage(format!("{context}: {}", problems.join("; ")))
    })?;
    let nested = schema.nested(&resolved);
    Ok(Parameters { resolved, nested, context })
}

/// Checks that `--device` is `cpu`, `cuda` or `cuda:N`. The libraries that use a GPU check that it
/// exists.
pub fn check_device(name: &str) -> Result<(), Failure> {
    let is_valid = match name.strip_prefix("cuda:") {
        Some(index) => (1..=4).contains(&index.len()) && index.bytes().all(|b| b.is_ascii_digit()),
        None => ["cpu", "cuda"].contains(&name),
    };
    if !is_valid {
        bail_usage!("--device {name}: no such device; expected cpu, cuda or cuda:N");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_the_cpu_and_cuda_gpus() {
        for name in ["cpu", "cuda", "cuda:0", "cuda:12"] {
            assert!(check_device(name).is_ok(), "{name}");
        }
        for name in ["", "gpu", "CPU", "cuda:", "cuda:x", "cuda:-1", "cuda:99999", "cuda0", "cpu:0"]
        {
            assert!(check_device(name).is_err(), "{name}");
        }
    }
}

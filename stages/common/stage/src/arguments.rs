//! What a stage's command line says.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use artifact::{Failure, FailureExt as _, known_names};
use contract::{Description, Schema};
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::progress::ProgressMode;

#[derive(clap::Parser)]
#[command(subcommand_negates_reqs = true, args_conflicts_with_subcommands = true)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Option<Command>,
    /// JSON file with the parameters; those it leaves out have their defaults
    #[arg(long, value_name = "FILE")]
    pub(crate) params: Option<PathBuf>,
    /// One input, e.g. --input scene=DIR; repeat for more
    #[arg(long = "input", value_name = "NAME=DIR")]
    pub(crate) inputs: Vec<String>,
    /// Folder to make; it must not exist yet and appears only when complete
    #[arg(long, value_name = "DIR", required = true)]
    pub(crate) output: Option<PathBuf>,
    /// Private folder that survives an interruption (checkpoints)
    #[arg(long, value_name = "DIR")]
    pub(crate) work: Option<PathBuf>,
    /// Write the output from the latest checkpoint in --work, and don't train on
    #[arg(long, requires = "work")]
    pub(crate) from_checkpoint: bool,
    /// Where to compute: cpu or cuda:N
    #[arg(long, default_value = "cpu")]
    pub(crate) device: String,
    /// Threads to use; the result doesn't depend on it [default: all cores]
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
    /// How to show progress
    #[arg(long, value_enum, default_value = "plain")]
    pub(crate) progress: ProgressMode,
}

#[derive(clap::Subcommand)]
pub(crate) enum Command {
    /// Print name, code fingerprint, parameters, inputs and output as JSON
    Describe,
}

/// The inputs' names and folders: each one known, none missing.
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
            return Err(Failure::Usage(format!("--input {name}: no such input; {known}")).into());
        }
        folders.push((name, Path::new(folder)));
    }
    for (name, input) in &description.inputs {
        if !input.optional && !folders.iter().any(|(given, _)| given == name) {
            return Err(Failure::Usage(format!(
                "input {name} is missing; give --input {name}=DIR ({})",
                input.summary
            ))
            .into());
        }
    }
    Ok(folders)
}

/// The parameters from the file, checked against the schema, or the defaults: as JSON and as the
/// stage's own type.
pub(crate) fn read_params<P: DeserializeOwned>(
    file: Option<&Path>,
    description: &Description,
) -> anyhow::Result<(Value, P)> {
    let place = file.map(|f| f.display().to_string()).unwrap_or_default();
    let given = match file {
        None => serde_json::Map::new(),
        Some(path) => {
            let bytes = fs::read(path).usage(format!("--params {place}"))?;
            serde_json::from_slice(&bytes)
                .usage(format!("--params {place}: expected a JSON object"))?
        }
    };
    let schema = Schema::new(&description.parameters)
        .map_err(|e| anyhow!("the stage's own parameter schema: {e}"))?;
    let resolved = schema.resolve(&given).map_err(|problems| {
        let lines: Vec<String> = problems.iter().map(ToString::to_string).collect();
        Failure::Usage(format!("--params {place}: {}", lines.join("; ")))
    })?;
    let params = serde_path_to_error::deserialize(schema.nested(&resolved))
        .usage(format!("--params {place}"))?;
    Ok((resolved, params))
}

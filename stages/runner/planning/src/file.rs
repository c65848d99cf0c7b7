//! One pipeline file as written, with the lines of its keys for error messages.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Map, Value};
use slurm::Resources;

use crate::experiment::Experiment;
use crate::quality::Quality;

/// A pipeline file: `pipeline.yaml`, or a file of `pipelines/`.
///
/// A file that extends others inherits their blocks, and may override parts of a block: an input or
/// a parameter replaces the one of the same name; `run` or `extends` replaces both. Paths are
/// relative to the file that contains them.
#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PipelineFile {
    /// One or more pipeline files whose blocks are inherited. Blocks of one name must be equal in
    /// all of them.
    #[serde(deserialize_with = "one_or_more")]
    #[schemars(with = "OneOrMore")]
    pub extends: Vec<String>,
    /// Targets of `nerf-sr run` if the command line names none. By default, those of the first
    /// extended file.
    pub default: Vec<String>,
    /// Quality of all stages: parameters that trade speed for accuracy, unless blocks or the
    /// command line set them. By default, that of the first extended file that sets one, or else
    /// `balanced`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quality: Option<Quality>,
    /// Blocks by stage name.
    pub stages: BTreeMap<String, StageBlock>,
    /// Scenes, protocols and variants of an experiment.
    #[serde(skip_serializing_if = "Experiment::is_empty")]
    pub experiment: Experiment,
}

/// A path, or a list of paths.
#[derive(Deserialize, JsonSchema)]
#[serde(untagged, expecting = "expected the path of a pipeline file, or a list of paths")]
enum OneOrMore {
    /// One path.
    One(String),
    /// Several paths.
    More(Vec<String>),
}

fn one_or_more<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<String>, D::Error> {
    Ok(match OneOrMore::deserialize(deserializer)? {
        OneOrMore::One(path) => vec![path],
        OneOrMore::More(paths) => paths,
    })
}

/// Block of one stage.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StageBlock {
    /// Program: a path relative to the file's folder, or the name of a program next to `nerf-sr`.
    /// The default is the block's name.
    pub run: Option<String>,
    /// Block whose program and parameters are inherited. Parameters of this block override
    /// inherited ones, even those that the command line sets for the inherited block.
    pub extends: Option<String>,
    /// Inputs by name: a stage (`prep`), a subtree of its artifact (`prep/train`), or the path of a
    /// folder, which starts with `.` or `/`. `null` removes the input of an extended file's block.
    #[serde(rename = "inputs")]
    pub given_inputs: BTreeMap<String, Option<String>>,
    /// Inputs by name, with those of extended files.
    #[serde(skip)]
    pub inputs: BTreeMap<String, String>,
    /// Parameters that differ from the stage's defaults. A parameter that selects a variant may
    /// contain the variant's own: `field: {grid: {n_levels: 4}}` is `field: grid` and
    /// `n_levels: 4`.
    pub parameters: Map<String, Value>,
    /// Resources that the stage needs on a cluster.
    #[serde(skip_serializing_if = "Resources::is_empty")]
    pub resources: Resources,
    /// Parameters that the files extending this block's file override, in order.
    #[serde(skip)]
    pub overrides: Vec<Map<String, Value>>,
}

impl StageBlock {
    /// Returns the layers of parameters; a later layer overrides earlier ones.
    pub fn parameter_layers(&self) -> impl Iterator<Item = &Map<String, Value>> {
        [&self.parameters].into_iter().chain(&self.overrides)
    }

    /// Returns whether the block itself contains a part.
    fn has(&self, part: Part) -> bool {
        match part {
            Part::Block => true,
            Part::Field("run") => self.run.is_some(),
            Part::Field(_) => self.extends.is_some(),
            Part::Input(name) => self.given_inputs.contains_key(name),
            Part::Parameter(name) => self.parameters.contains_key(name),
        }
    }

    /// Overrides parts of the block with those of `other`, the block of the same name in an
    /// extending file.
    pub fn override_with(&mut self, other: &Self) {
        if other.run.is_some() || other.extends.is_some() {
            self.run.clone_from(&other.run);
            self.extends.clone_from(&other.extends);
        }
        for (name, source) in &other.given_inputs {
            match source {
                Some(source) => _ = self.inputs.insert(name.clone(), source.clone()),
                None => _ = self.inputs.remove(name),
            }
        }
        let layers = other.parameter_layers().filter(|layer| !layer.is_empty());
        self.overrides.extend(layers.cloned());
        self.resources = self.resources.overridden_by(&other.resources);
    }
}

/// Source of an input, parsed from the input's text in a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum InputSource<'a> {
    /// Folder outside the store.
    Folder(&'a Path),
    /// Artifact of another stage, or a subtree of it.
    Stage { name: &'a str, subtree: Option<&'a str> },
}

impl<'a> InputSource<'a> {
    pub(crate) fn parse(text: &'a str) -> Self {
        if text.starts_with(['/', '.', '~']) {
            return Self::Folder(Path::new(text));
        }
        match text.split_once('/') {
            Some((name, subtree)) => Self::Stage { name, subtree: Some(subtree) },
            None => Self::Stage { name: text, subtree: None },
        }
    }

    /// Returns the stage's name; `None` for a folder.
    pub(crate) fn stage(self) -> Option<&'a str> {
        match self {
            Self::Folder(_) => None,
            Self::Stage { name, .. } => Some(name),
        }
    }
}

/// Part of a block that an error refers to.
#[derive(Clone, Copy, Debug)]
pub enum Part<'a> {
    /// Whole block.
    Block,
    /// Field `run` or `extends`.
    Field(&'a str),
    /// Input of this name.
    Input(&'a str),
    /// Parameter of this name.
    Parameter(&'a str),
}

/// Error in a pipeline file.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{location}: {problem}")]
pub struct PipelineError {
    /// File and, if known, line number.
    pub location: String,
    /// Problem and remedy.
    pub problem: String,
}

impl PipelineError {
    pub(crate) fn new(path: &Path, line: Option<usize>, problem: impl Into<String>) -> Self {
        let location = match line {
            Some(line) => format!("{}:{line}", path.display()),
            None => path.display().to_string(),
        };
        Self { location, problem: problem.into() }
    }

    fn from_yaml(path: &Path, error: &serde_yaml::Error) -> Self {
        Self::new(path, error.location().map(|at| at.line()), without_line(error))
    }
}

/// Parsed pipeline file with its path and text.
#[derive(Debug)]
pub struct ParsedFile {
    /// Path for messages.
    pub path: PathBuf,
    /// Canonical path, the identity of the file.
    pub canonical_path: PathBuf,
    pub content: PipelineFile,
    text: String,
}

impl ParsedFile {
    /// Parses a pipeline file. Fails on duplicate keys, unknown keys and wrong types.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, PipelineError> {
        let text = crate::yaml_lines::decode(bytes).map_err(|line| {
            let problem = "not UTF-8 (maybe UTF-16); save it as UTF-8";
            PipelineError::new(path, Some(line), problem)
        })?;
        let content = parse_content(text, path)?;
        let canonical_path = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
        let file =
            Self { path: path.to_path_buf(), canonical_path, content, text: text.to_owned() };
        for name in file.content.stages.keys() {
            if !is_stage_name(name) {
                let problem = format!(
                    "stage {name:?}: choose a name of 1 to {MAX_NAME_BYTES} bytes without `/`, \
                    `\\`, `..`, white space and control characters that starts with neither `.` \
                    nor `-`"
                );
                return Err(file.error(&["stages", name], problem));
            }
        }
        Ok(file)
    }

    /// Returns the folder that the file's relative paths start from.
    pub fn folder(&self) -> &Path {
        self.path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }

    /// Returns whether the file itself contains a part of a stage's block.
    pub fn has(&self, stage: &str, part: Part) -> bool {
        self.content.stages.get(stage).is_some_and(|block| block.has(part))
    }

    /// Creates an error at the line of a key, given as a path through nested mappings.
    pub fn error(&self, keys: &[&str], problem: String) -> PipelineError {
        PipelineError::new(&self.path, crate::yaml_lines::line_of(&self.text, keys), problem)
    }
}

fn parse_content(text: &str, path: &Path) -> Result<PipelineFile, PipelineError> {
    // serde_yaml silently accepts duplicate keys of maps; its own `Mapping` refuses them.
    let mapping: serde_yaml::Mapping = serde_yaml::from_str(text).map_err(|e| {
        match crate::yaml_lines::line_of_duplicate(text) {
            None => PipelineError::from_yaml(path, &e),
            line => PipelineError::new(path, line, without_line(&e) + "; remove one of them"),
        }
    })?;
    let mut document = serde_yaml::Value::Mapping(mapping);
    let has_merge_keys = crate::yaml_lines::expand_merge_keys(&mut document)
        .map_err(|e| PipelineError::from_yaml(path, &e))?;
    if let Some(keys) = crate::yaml_lines::find_non_finite(&document) {
        let problem = format!("{}: expected a finite number", keys.join("."));
        return Err(PipelineError::new(path, line_of(text, &keys), problem));
    }
    if document.get("extends").is_none() && document.get("experiment").is_none() {
        for key in ["default", "stages"] {
            if document.get(key).is_none() {
                return Err(PipelineError::new(path, None, format!("missing field `{key}`")));
            }
        }
    }
    if !has_merge_keys {
        return serde_yaml::from_str(text).map_err(|e| PipelineError::from_yaml(path, &e));
    }
    // The merged document has no line numbers, but the error's keys lead to a line of the text.
    serde_path_to_error::deserialize(document).map_err(|e| {
        let keys: Vec<String> = e.path().iter().map(ToString::to_string).collect();
        let problem = format!("{}: {}", keys.join("."), e.inner());
        PipelineError::new(path, line_of(text, &keys), problem)
    })
}

/// Maximum length of a stage's name, which becomes part of file names; chosen by hand.
const MAX_NAME_BYTES: usize = 100;

/// Returns whether a stage's name can be part of file names and command lines.
fn is_stage_name(name: &str) -> bool {
    (1..=MAX_NAME_BYTES).contains(&name.len())
        && !name.starts_with(['.', '-'])
        && !name.contains("..")
        && !name.contains(|c: char| c.is_control() || c.is_whitespace() || "/\\".contains(c))
}

/// Returns the parser's message without the line, which the location contains.
fn without_line(error: &serde_yaml::Error) -> String {
    let text = error.to_string();
    text.rsplit_once(" at line ").map_or(text.clone(), |(problem, _)| problem.to_owned())
}

fn line_of(text: &str, keys: &[String]) -> Option<usize> {
    crate::yaml_lines::line_of(text, &keys.iter().map(String::as_str).collect::<Vec<_>>())
}

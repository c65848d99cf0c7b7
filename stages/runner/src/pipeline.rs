use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::yaml;

/// pipeline.yaml as written.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Pipeline {
    /// What `nerf-sr run` makes when no target is named.
    pub default: Vec<String>,
    /// The stages by name.
    pub stages: BTreeMap<String, StageBlock>,
    /// The file's text, to name lines.
    #[serde(skip)]
    text: String,
    /// Where the file is.
    #[serde(skip)]
    path: PathBuf,
}

/// One stage's block.
#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StageBlock {
    /// What to run: a path from the file's folder, or the name of a binary beside `nerf-sr`; without it: the block's name.
    pub run: Option<String>,
    /// Another stage's block: what that runs, with its parameters and what the command line gives it, save what is given here.
    pub like: Option<String>,
    /// Inputs: another stage (`prep`), a folder of its artifact (`prep/train`), or a path that begins with `.` or `/`.
    pub inputs: BTreeMap<String, String>,
    /// Parameters that differ from the stage's defaults.
    pub parameters: Map<String, Value>,
}

impl StageBlock {
    /// Whether the block itself has that parameter, or that input.
    pub(crate) fn gives(&self, is_parameter: bool, name: &str) -> bool {
        if is_parameter { self.parameters.contains_key(name) } else { self.inputs.contains_key(name) }
    }
}

/// Where an input's text leads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source<'a> {
    /// To a folder outside the store.
    Folder(&'a Path),
    /// To another stage's artifact, or a folder of it.
    Stage { name: &'a str, subtree: Option<&'a str> },
}

impl<'a> Source<'a> {
    pub(crate) fn of(text: &'a str) -> Self {
        if text.starts_with(['/', '.', '~']) {
            return Self::Folder(Path::new(text));
        }
        match text.split_once('/') {
            Some((name, folder)) => Self::Stage { name, subtree: Some(folder) },
            None => Self::Stage { name: text, subtree: None },
        }
    }

    /// The stage that it leads to.
    pub(crate) fn stage(self) -> Option<&'a str> {
        match self {
            Self::Folder(_) => None,
            Self::Stage { name, .. } => Some(name),
        }
    }
}

/// What in a block an error is about.
#[derive(Clone, Copy, Debug)]
pub enum Part<'a> {
    /// The block as a whole.
    Block,
    /// One of its own keys: `run`, `like`.
    Field(&'a str),
    /// An input.
    Input(&'a str),
    /// A parameter.
    Parameter(&'a str),
}

/// A pipeline.yaml that can't be used: file, line, what to do.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{place}: {problem}")]
pub struct PipelineError {
    /// File and, where known, line.
    pub place: String,
    /// What is wrong and what to do.
    pub problem: String,
}

/// Names longer than this make no folder's name.
const LONGEST_NAME: usize = 100;

/// What is wrong with a stage's name, which becomes a part of file names and of command lines.
fn problem_of_name(name: &str) -> Option<&'static str> {
    if name.is_empty() {
        Some("a stage's name is empty")
    } else if name.starts_with(['.', '-']) {
        Some("a stage's name begins with a letter or a digit, not with `.` or `-`")
    } else if name.contains(['/', '\\']) || name.contains("..") {
        Some("a stage's name has no `/` and no `..`")
    } else if name.chars().any(|c| c.is_control() || c.is_whitespace()) {
        Some("a stage's name has no white space and no control characters")
    } else if name.len() > LONGEST_NAME {
        Some("a stage's name has at most 100 bytes")
    } else {
        None
    }
}

impl Pipeline {
    /// Reads the file. Duplicate keys, unknown keys and types are refused here, with their line.
    pub fn read(path: &Path) -> Result<Self, PipelineError> {
        let bytes = std::fs::read(path).map_err(|e| PipelineError {
            place: path.display().to_string(),
            problem: format!("{e}; run in the folder of pipeline.yaml or name it with --pipeline"),
        })?;
        Self::parse(&bytes, path)
    }

    /// The pipeline of a file's bytes; `path` says where relative paths start, and is named in errors.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, PipelineError> {
        let fail = |line: Option<usize>, problem: String| PipelineError { place: place(path, line), problem };
        let text = yaml::decode(bytes).map_err(|(line, problem)| fail(line, problem))?;
        let located = |e: serde_yaml::Error| fail(e.location().map(|at| at.line()), without_line(&e));
        // serde_yaml takes duplicate keys of maps silently; its own `Mapping` refuses them.
        let mapping: serde_yaml::Mapping = serde_yaml::from_str(text).map_err(|e| match yaml::line_of_duplicate(text) {
            Some(line) => fail(Some(line), format!("{}; leave one of them", without_line(&e))),
            None => located(e),
        })?;
        let mut document = serde_yaml::Value::Mapping(mapping);
        let merged = yaml::merge(&mut document).map_err(located)?;
        let line_of = |keys: &[String]| yaml::line_of(text, &keys.iter().map(String::as_str).collect::<Vec<_>>());
        if let Some(keys) = yaml::not_finite(&document) {
            return Err(fail(line_of(&keys), format!("{}: a number is neither NaN nor infinite", keys.join("."))));
        }
        let mut pipeline: Self = if merged {
            serde_path_to_error::deserialize(document).map_err(|e| {
                let keys: Vec<String> = e.path().iter().map(ToString::to_string).collect();
                fail(line_of(&keys), format!("{}: {}", keys.join("."), e.inner()))
            })?
        } else {
            serde_yaml::from_str(text).map_err(located)?
        };
        (pipeline.text, pipeline.path) = (text.to_owned(), path.to_path_buf());
        for name in pipeline.stages.keys() {
            if let Some(problem) = problem_of_name(name) {
                let place = pipeline.error(name, Part::Block, "").place;
                return Err(PipelineError { place, problem: format!("stage {name:?}: {problem}") });
            }
        }
        Ok(pipeline)
    }

    /// The blocks that a stage's parameters come from, the weightiest last: the one it is like, then its own.
    pub(crate) fn layers<'a>(&'a self, stage: &'a str) -> impl Iterator<Item = &'a str> {
        self.stages[stage].like.as_deref().into_iter().chain([stage])
    }

    /// The folder that relative paths start from.
    pub fn folder(&self) -> &Path {
        self.path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }

    /// An error about a stage's block, or a part of it, with its line.
    pub fn error(&self, stage: &str, part: Part, problem: impl Into<String>) -> PipelineError {
        let inside = match part {
            Part::Block => &[][..],
            Part::Field(name) => &[name],
            Part::Input(name) => &["inputs", name],
            Part::Parameter(name) => &["parameters", name],
        };
        let line = yaml::line_of(&self.text, &[&["stages", stage], inside].concat());
        PipelineError { place: place(&self.path, line), problem: format!("stage {stage}: {}", problem.into()) }
    }

    /// An error about what stands before the stages.
    pub(crate) fn error_in_default(&self, problem: String) -> PipelineError {
        PipelineError { place: place(&self.path, yaml::line_of(&self.text, &["default"])), problem }
    }
}

/// What the parser says, less the line, which is named before it.
fn without_line(error: &serde_yaml::Error) -> String {
    let text = error.to_string();
    text.rsplit_once(" at line ").map_or(text.clone(), |(problem, _)| problem.to_owned())
}

/// File and, where known, line.
fn place(path: &Path, line: Option<usize>) -> String {
    line.map_or_else(|| path.display().to_string(), |line| format!("{}:{line}", path.display()))
}

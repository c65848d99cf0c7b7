use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

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

/// A pipeline.yaml that can't be used: file, line, what to do.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{place}: {problem}")]
pub struct PipelineError {
    /// File and, where known, line.
    pub place: String,
    /// What is wrong and what to do.
    pub problem: String,
}

impl Pipeline {
    /// Reads the file. Duplicate keys, unknown keys and types are refused here, with line and column.
    pub fn read(path: &Path) -> Result<Self, PipelineError> {
        let fail = |place: String, problem: String| PipelineError { place, problem };
        let text = std::fs::read_to_string(path).map_err(|e| {
            fail(path.display().to_string(), format!("{e}; run in the folder of pipeline.yaml or name it with --pipeline"))
        })?;
        let located = |e: serde_yaml::Error| {
            let place = match e.location() {
                Some(at) => format!("{}:{}", path.display(), at.line()),
                None => path.display().to_string(),
            };
            fail(place, e.to_string())
        };
        // serde_yaml takes duplicate keys of maps silently; its own `Mapping` refuses them.
        serde_yaml::from_str::<serde_yaml::Mapping>(&text).map_err(located)?;
        let mut pipeline: Self = serde_yaml::from_str(&text).map_err(located)?;
        (pipeline.text, pipeline.path) = (text, path.to_path_buf());
        Ok(pipeline)
    }

    /// The blocks that a stage's parameters come from, the weightiest last: the one it is like, then its own.
    pub(crate) fn layers<'a>(&'a self, stage: &'a str) -> impl Iterator<Item = &'a str> {
        self.stages[stage].like.as_deref().into_iter().chain([stage])
    }

    /// Checks what blocks say of being like others.
    pub(crate) fn check_likeness(&self) -> Result<(), PipelineError> {
        for (name, block) in &self.stages {
            let Some(other) = &block.like else { continue };
            let problem = match self.stages.get(other) {
                None => format!("like: there is no stage {other:?}"),
                Some(other_block) if other_block.like.is_some() => {
                    format!("like: {other:?} is itself like another; name that one")
                }
                Some(_) if block.run.is_some() => "run: what it runs follows from `like`; give one of them".to_owned(),
                Some(_) => continue,
            };
            return Err(self.error(name, Some("like"), problem));
        }
        Ok(())
    }

    /// The folder that relative paths start from.
    pub fn folder(&self) -> &Path {
        self.path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }

    /// An error about a stage's block, or a key in it, with its line.
    pub fn error(&self, stage: &str, key: Option<&str>, problem: impl Into<String>) -> PipelineError {
        let place = match self.line_of(stage, key) {
            Some(line) => format!("{}:{line}", self.path.display()),
            None => self.path.display().to_string(),
        };
        PipelineError { place, problem: format!("stage {stage}: {}", problem.into()) }
    }

    /// The line on which a stage's block starts, or the first line in it that sets `key`.
    fn line_of(&self, stage: &str, key: Option<&str>) -> Option<usize> {
        let sets = |line: &str, name: &str| {
            let line = line.trim_start().trim_start_matches(['{', '"', '\'']);
            line.strip_prefix(name).is_some_and(|rest| rest.trim_start_matches(['"', '\'']).starts_with(':'))
        };
        let indent = |line: &str| line.len() - line.trim_start().len();
        let lines: Vec<&str> = self.text.lines().collect();
        let stages = lines.iter().position(|l| sets(l, "stages") && indent(l) == 0)?;
        let start = stages + 1 + lines[stages + 1..].iter().position(|l| sets(l, stage))?;
        let Some(key) = key else { return Some(start + 1) };
        let inside = lines[start + 1..].iter().take_while(|l| l.trim().is_empty() || indent(l) > indent(lines[start]));
        let within = inside.enumerate().find(|(_, l)| sets(l, key) || l.contains(&format!("{key}:"))).map(|(i, _)| start + 2 + i);
        within.or(Some(start + 1))
    }
}

//! A pipeline file as written, with what is needed to name its lines.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Map, Value};
use slurm::Resources;

use crate::experiment::Experiment;
use crate::part::{Part, PipelineError};

/// A pipeline file: `pipeline.yaml`, or one of `pipelines/`.
///
/// A file that extends others has their blocks, too. For a block that both have, the file may give
/// a part alone: an input or a parameter takes the place of the one of that name, `run` or
/// `extends` the place of either. Paths are relative to the file in which they stand.
#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PipelineFile {
    /// Another pipeline file, or several, whose blocks this one has, too. Several may share blocks,
    /// but not change them.
    #[serde(deserialize_with = "one_or_more")]
    #[schemars(with = "OneOrMore")]
    pub extends: Vec<String>,
    /// What `nerf-sr run` makes when no target is named. Left out, it is that of the first extended
    /// file.
    pub default: Vec<String>,
    /// The stages by name.
    pub stages: BTreeMap<String, StageBlock>,
    /// Scenes, protocols and variants, which make the file an experiment.
    #[serde(skip_serializing_if = "is_default")]
    pub experiment: Experiment,
}

fn is_default(experiment: &Experiment) -> bool {
    *experiment == Experiment::default()
}

/// A text, or a list of them.
#[derive(Deserialize, JsonSchema)]
#[serde(untagged, expecting = "expected the path of a pipeline file, or a list of paths")]
enum OneOrMore {
    /// One.
    One(String),
    /// Several.
    More(Vec<String>),
}

fn one_or_more<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<String>, D::Error> {
    Ok(match OneOrMore::deserialize(deserializer)? {
        OneOrMore::One(path) => vec![path],
        OneOrMore::More(paths) => paths,
    })
}

/// One stage's block.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StageBlock {
    /// What to run: a path from the file's folder, or the name of a binary beside `nerf-sr`;
    /// without it: the block's name.
    pub run: Option<String>,
    /// Another block: this one runs the same program, with the parameters that the file and the
    /// command line give the other one, except those given here.
    pub extends: Option<String>,
    /// Inputs: another stage (`prep`), a folder of its artifact (`prep/train`), or a path that
    /// begins with `.` or `/`.
    pub inputs: BTreeMap<String, String>,
    /// Parameters that differ from the stage's defaults. One that selects a variant may hold that
    /// variant's own: `field: {grid: {n_levels: 4}}` is `field: grid` and `n_levels: 4`.
    pub parameters: Map<String, Value>,
    /// What it needs of a machine, where a cluster runs it.
    #[serde(skip_serializing_if = "Resources::is_empty")]
    pub resources: Resources,
    /// What files that extend this one's say of its parameters, one after the other.
    #[serde(skip)]
    pub changes: Vec<Map<String, Value>>,
}

impl StageBlock {
    /// Its parameters, those that weigh most last.
    pub fn parameter_layers(&self) -> impl Iterator<Item = &Map<String, Value>> {
        [&self.parameters].into_iter().chain(&self.changes)
    }

    /// Whether the block itself says that.
    fn says(&self, part: Part) -> bool {
        match part {
            Part::Block => true,
            Part::Field("run") => self.run.is_some(),
            Part::Field(_) => self.extends.is_some(),
            Part::Input(name) => self.inputs.contains_key(name),
            Part::Parameter(name) => self.parameters.contains_key(name),
        }
    }

    /// Takes what a block of the same name says in a file that extends this one's.
    pub fn change(&mut self, by: &Self) {
        if by.run.is_some() || by.extends.is_some() {
            (self.run, self.extends) = (by.run.clone(), by.extends.clone());
        }
        self.inputs.extend(by.inputs.clone());
        self.changes.extend(by.parameter_layers().filter(|layer| !layer.is_empty()).cloned());
        self.resources = self.resources.changed(&by.resources);
    }
}

/// A file that was read.
#[derive(Debug)]
pub struct File {
    /// As it is named in errors.
    pub path: PathBuf,
    /// By what it is known again, however it was named.
    pub id: PathBuf,
    pub written: PipelineFile,
    text: String,
}

impl File {
    /// The file of its bytes. Duplicate keys, unknown keys and types are refused here, with their
    /// line.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, PipelineError> {
        let fail = |line, problem| PipelineError { place: place(path, line), problem };
        let text = yaml_lines::decode(bytes).map_err(|e| fail(e.line, e.problem.to_owned()))?;
        let located =
            |e: serde_yaml::Error| fail(e.location().map(|at| at.line()), without_line(&e));
        // serde_yaml takes duplicate keys of maps silently; its own `Mapping` refuses them.
        let mapping: serde_yaml::Mapping =
            serde_yaml::from_str(text).map_err(|e| match yaml_lines::line_of_duplicate(text) {
                Some(line) => fail(Some(line), format!("{}; leave one of them", without_line(&e))),
                None => located(e),
            })?;
        let mut document = serde_yaml::Value::Mapping(mapping);
        let merged = yaml_lines::expand_merge_keys(&mut document).map_err(located)?;
        if let Some((keys, problem)) = problem_of(&document) {
            return Err(fail(line_of(text, &keys), problem));
        }
        let written: PipelineFile = if merged {
            serde_path_to_error::deserialize(document).map_err(|e| {
                let keys: Vec<String> = e.path().iter().map(ToString::to_string).collect();
                fail(line_of(text, &keys), format!("{}: {}", keys.join("."), e.inner()))
            })?
        } else {
            serde_yaml::from_str(text).map_err(located)?
        };
        let id = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
        let file = Self { path: path.to_path_buf(), id, written, text: text.to_owned() };
        let named =
            file.written.stages.keys().find_map(|name| Some((name, problem_of_name(name)?)));
        named.map_or(Ok(()), |(name, problem)| {
            Err(file.error(&["stages", name], format!("stage {name:?}: {problem}")))
        })?;
        Ok(file)
    }

    /// The folder that its relative paths start from.
    pub fn folder(&self) -> &Path {
        self.path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }

    /// Whether it says that of a stage.
    pub fn says(&self, stage: &str, part: Part) -> bool {
        self.written.stages.get(stage).is_some_and(|block| block.says(part))
    }

    /// An error about a key, through nested mappings, with its line.
    pub fn error(&self, keys: &[&str], problem: String) -> PipelineError {
        PipelineError { place: place(&self.path, yaml_lines::line_of(&self.text, keys)), problem }
    }
}

/// What is wrong with a file before its types are looked at: the key, and what to do.
fn problem_of(document: &serde_yaml::Value) -> Option<(Vec<String>, String)> {
    if let Some(keys) = yaml_lines::find_non_finite(document) {
        let problem = format!("{}: a number is neither NaN nor infinite", keys.join("."));
        return Some((keys, problem));
    }
    let says_more = ["extends", "experiment"].iter().any(|key| document.get(key).is_some());
    let missing = |key: &&str| document.get(key).is_none() && !says_more;
    if let Some(key) = ["default", "stages"].iter().find(|key| missing(key)) {
        return Some((Vec::new(), format!("missing field `{key}`")));
    }
    None
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

/// What the parser says, less the line, which is named before it.
fn without_line(error: &serde_yaml::Error) -> String {
    let text = error.to_string();
    text.rsplit_once(" at line ").map_or(text.clone(), |(problem, _)| problem.to_owned())
}

/// The line of a key, through nested mappings.
fn line_of(text: &str, keys: &[String]) -> Option<usize> {
    yaml_lines::line_of(text, &keys.iter().map(String::as_str).collect::<Vec<_>>())
}

/// File and, where known, line.
fn place(path: &Path, line: Option<usize>) -> String {
    line.map_or_else(|| path.display().to_string(), |line| format!("{}:{line}", path.display()))
}

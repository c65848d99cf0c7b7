use std::collections::BTreeMap;
use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::manifest::{PathError, relative_path};
use crate::parameters::{Schema, SchemaError};
use crate::rules::{Rule, RuleError};

/// What `STAGE describe` prints: all that the runner knows of a stage.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// The stage's name; also its binary's.
    pub name: String,
    /// Version for people; not part of a key.
    pub version: String,
    /// Fingerprint of the code: part of every key.
    pub code: String,
    /// One sentence: what the stage makes of what.
    pub summary: String,
    /// JSON Schema of the parameters: an object, every property with its default. `x-group` names a
    /// parameter's group; `x-default` stands for a default that is null, and is `by scene` where
    /// the inputs decide.
    pub parameters: Value,
    /// Inputs by name.
    pub inputs: BTreeMap<String, Input>,
    /// What comes out.
    pub output: Output,
    /// Names of environment variables that change the result; their values join the key.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub environment: Vec<String>,
    /// A sink shows a run (times, hashes) and is never cached; its input `run` is the run's record.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sink: bool,
    /// A sink that shows what there is, where some of it couldn't be made.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub partial: bool,
    /// Whether the stage accepts `--from-checkpoint`: then it writes its output from the latest
    /// checkpoint.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub from_checkpoint: bool,
    /// What parameters and inputs must be together.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rules: Vec<Rule>,
}

/// A description that contradicts itself: what is wrong with it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DescriptionError {
    /// Its parameter schema.
    #[error("its parameter schema is {0}")]
    Schema(#[from] SchemaError),
    /// It doesn't say its name.
    #[error("it has no name")]
    Unnamed,
    /// A folder of its output.
    #[error("its output: {0}")]
    Output(#[from] PathError),
    /// A rule.
    #[error("its rule {number}: {problem}")]
    Rule {
        /// Which, counted from 1.
        number: usize,
        /// What is wrong.
        problem: RuleError,
    },
}

impl Description {
    /// Says what is wrong with a description that has the right form: what it names must be there,
    /// and its folders inside the output.
    pub fn check(&self) -> Result<(), DescriptionError> {
        let schema = Schema::new(&self.name, &self.parameters)?;
        if self.name.is_empty() {
            return Err(DescriptionError::Unnamed);
        }
        for folder in self.output.subtrees.keys().chain(&self.output.resolved) {
            relative_path(folder)?;
        }
        for (index, rule) in self.rules.iter().enumerate() {
            rule.check(&schema.names(), &self.inputs)
                .map_err(|problem| DescriptionError::Rule { number: index + 1, problem })?;
        }
        Ok(())
    }
}

/// An input of a stage.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Kinds of artifact it accepts.
    pub kinds: Vec<String>,
    /// Whether the stage runs without it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub optional: bool,
    /// What it is, in a sentence.
    pub summary: String,
}

impl Input {
    /// An input that must be given.
    pub fn required(kinds: &[&str], summary: &str) -> Self {
        Self {
            kinds: kinds.iter().map(ToString::to_string).collect(),
            optional: false,
            summary: summary.to_owned(),
        }
    }

    /// An input that may be left out.
    pub fn optional(kinds: &[&str], summary: &str) -> Self {
        Self { optional: true, ..Self::required(kinds, summary) }
    }
}

/// The artifact a stage makes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// Its kind.
    pub kind: String,
    /// Folders of it that an input may name (`prep/train`), with their kinds.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub subtrees: BTreeMap<String, String>,
    /// A JSON file of it whose entry `resolved` has, by name, the values in use of parameters whose
    /// default depends on the inputs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resolved: Option<String>,
}

impl Output {
    /// An output without subtrees.
    pub fn kind(kind: &str) -> Self {
        Self { kind: kind.to_owned(), subtrees: BTreeMap::new(), resolved: None }
    }

    /// Adds a folder that an input may name.
    #[must_use]
    pub fn with_subtree(mut self, folder: &str, kind: &str) -> Self {
        self.subtrees.insert(folder.to_owned(), kind.to_owned());
        self
    }

    /// Names the file that has the values in use of parameters whose default depends on the inputs.
    #[must_use]
    pub fn with_resolved(mut self, file: &str) -> Self {
        self.resolved = Some(file.to_owned());
        self
    }

    /// The values in use that a finished artifact records, by the parameters' names.
    pub fn resolved(&self, artifact: &Path) -> Map<String, Value> {
        let bytes = self.resolved.as_ref().and_then(|file| std::fs::read(artifact.join(file)).ok());
        // An artifact of an older build has none.
        let file: Option<Value> = bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        file.and_then(|file| file.get("resolved")?.as_object().cloned()).unwrap_or_default()
    }
}

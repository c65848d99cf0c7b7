use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

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
    /// JSON Schema of the parameters: an object, every property with its default.
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
        Self { kinds: kinds.iter().map(ToString::to_string).collect(), optional: false, summary: summary.to_owned() }
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
}

impl Output {
    /// An output without subtrees.
    pub fn kind(kind: &str) -> Self {
        Self { kind: kind.to_owned(), subtrees: BTreeMap::new() }
    }

    /// Adds a folder that an input may name.
    #[must_use]
    pub fn with_subtree(mut self, folder: &str, kind: &str) -> Self {
        self.subtrees.insert(folder.to_owned(), kind.to_owned());
        self
    }
}

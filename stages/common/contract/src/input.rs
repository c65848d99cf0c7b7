use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

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

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A score: a number, or several that belong together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Score {
    /// One number.
    One(f64),
    /// Numbers by name.
    Several(BTreeMap<String, f64>),
}

impl Score {
    /// Numbers with their names.
    pub fn several<const N: usize>(parts: [(&str, f64); N]) -> Self {
        Self::Several(parts.map(|(name, value)| (name.to_owned(), value)).into())
    }
}

/// Scores of a view, or their means, by name.
pub type Scores = BTreeMap<String, Score>;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A figure of `metrics.json`, and how it is shown.
// The schema is that of `eval`'s figures. Another stage's may have more fields, or no direction.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct Figure {
    /// Its place among the scores: keys from the outermost on, `/` between them.
    pub path: String,
    /// What it is called, with its unit.
    pub label: String,
    /// Digits after the point.
    pub digits: usize,
    /// Whether more of it is better.
    #[schemars(with = "bool")]
    pub higher_is_better: Option<bool>,
    /// What stands where it is missing from views that have others; without it, only results that
    /// have the figure show it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub missing: Option<String>,
}

impl Figure {
    /// A figure that says which way is better.
    pub fn new(path: &str, label: &str, digits: usize, higher_is_better: bool) -> Self {
        Self {
            path: path.to_owned(),
            label: label.to_owned(),
            digits,
            higher_is_better: Some(higher_is_better),
            missing: None,
        }
    }

    /// Its number among the scores of a view, or among the means.
    pub fn of(&self, scores: &Value) -> Option<f64> {
        scores.pointer(&format!("/{}", self.path))?.as_f64()
    }

    /// A number of it as text, with its digits and without its unit.
    pub fn text(&self, value: f64) -> String {
        // A file may ask for more than the formatter takes.
        format!("{value:.*}", self.digits.min(f64::DIGITS as usize))
    }
}

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Format of a number among the scores: path, label, decimal places and direction.
// The schema describes the formats of `eval`. Formats of other stages may have additional fields,
// or lack `higher_is_better`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct ScoreFormat {
    /// Path to the number in the scores: keys separated by `/`, the outermost first.
    pub path: String,
    /// Label, with unit.
    pub label: String,
    /// Number of decimal places.
    pub digits: usize,
    /// True if higher values are better.
    #[schemars(with = "bool")]
    pub higher_is_better: Option<bool>,
    /// Text displayed in place of a missing number. Without this text, results without the number
    /// don't display the figure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub missing: Option<String>,
}

impl ScoreFormat {
    /// Creates a format with a direction.
    pub fn new(path: &str, label: &str, digits: usize, higher_is_better: bool) -> Self {
        Self {
            path: path.to_owned(),
            label: label.to_owned(),
            digits,
            higher_is_better: Some(higher_is_better),
            missing: None,
        }
    }

    /// Returns the number in the scores of a view, or in the means.
    pub fn value_in(&self, scores: &Value) -> Option<f64> {
        scores.pointer(&format!("/{}", self.path))?.as_f64()
    }

    /// Formats a value with its decimal places, without unit.
    pub fn format_value(&self, value: f64) -> String {
        // A file may request more digits than the formatter supports.
        format!("{value:.*}", self.digits.min(f64::DIGITS as usize))
    }
}

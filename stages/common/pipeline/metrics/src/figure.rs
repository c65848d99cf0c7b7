use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Figure of `metrics.json`: a number among the scores, with its label and format.
// The schema describes the figures of `eval`. Those of other stages may have more fields, or none
// for the direction.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct Figure {
    /// Path to the number in the scores: keys separated by `/`, the outermost first.
    pub path: String,
    /// Label, with unit.
    pub label: String,
    /// Number of decimal places.
    pub digits: usize,
    /// True if higher values are better.
    #[schemars(with = "bool")]
    pub higher_is_better: Option<bool>,
    /// Text displayed if the figure is missing from views that have others; without the text, only
    /// results with the figure display it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub missing: Option<String>,
}

impl Figure {
    /// Creates a figure with a direction.
    pub fn new(path: &str, label: &str, digits: usize, higher_is_better: bool) -> Self {
        Self {
            path: path.to_owned(),
            label: label.to_owned(),
            digits,
            higher_is_better: Some(higher_is_better),
            missing: None,
        }
    }

    /// Returns the figure's number in the scores of a view, or in the means.
    pub fn value_in(&self, scores: &Value) -> Option<f64> {
        scores.pointer(&format!("/{}", self.path))?.as_f64()
    }

    /// Formats a value with the figure's decimal places, without unit.
    pub fn format_value(&self, value: f64) -> String {
        // A file may request more digits than the formatter supports.
        format!("{value:.*}", self.digits.min(f64::DIGITS as usize))
    }
}

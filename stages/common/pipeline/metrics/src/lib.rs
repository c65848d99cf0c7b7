//! Types of `metrics.json`: scores of views, and the format in which they are displayed.
//!
//! * [`Metrics`]: the file as `eval` writes it, and as `eval` reads it from input `baseline`, with
//!   [`ViewScores`] and [`NearReferences`].
//! * [`Score`], [`Scores`]: numbers of one view, or means over all views, by name.
//! * [`ScoreFormat`]: path, label, decimal places and direction of a number among the scores.
//! * [`AnyMetrics`]: the file of any stage, for `report` and `table`; all fields are optional.
//!
//! `eval` computes the scores. No stage before `eval` uses this crate, so its changes don't repeat
//! training runs.
//!
//! ```
//! use metrics::{AnyMetrics, ScoreFormat, Metrics, Score, Scores};
//!
//! let written = Metrics {
//!     conventions: Default::default(),
//!     figures: vec![ScoreFormat::new("psnr", "PSNR ↑ dB", 2, true)],
//!     picture_titles: Default::default(),
//!     mean: Scores::from([("psnr".to_owned(), Score::One(31.25))]),
//!     least_gain: None,
//!     near_references: None,
//!     views: Vec::new(),
//! };
//! let read = AnyMetrics::from(serde_json::to_value(&written)?);
//! assert_eq!(read.figures(), Some(written.figures.clone()));
//! let figure = &written.figures[0];
//! let mean = figure.value_in(read.mean()).unwrap();
//! assert_eq!(figure.format_value(mean), "31.25");
//! # Ok::<(), serde_json::Error>(())
//! ```

use std::collections::BTreeMap;
use std::io;
use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Absolute error that error maps display in the brightest colour; chosen by hand.
pub const ERROR_MAP_RANGE: f64 = 0.25;

/// `metrics.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Metrics {
    /// Method of each metric as text; also the background of the scene (`background`) and the
    /// content of error maps (`error_maps`).
    pub conventions: BTreeMap<String, String>,
    /// Formats of the numbers to display, the most important first.
    pub figures: Vec<ScoreFormat>,
    /// Titles of the metrics' pictures, by metric.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub picture_titles: BTreeMap<String, String>,
    /// Means of the per-view values.
    pub mean: Scores,
    /// Smallest PSNR gain of a view over input `baseline`, in dB.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least_gain: Option<f64>,
    /// Scores of the views near an HR reference, if input `references` is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub near_references: Option<NearReferences>,
    /// Scores of all views.
    pub views: Vec<ViewScores>,
}

/// Scores of one view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ViewScores {
    /// Name of the view.
    pub name: String,
    /// Scores of the view.
    pub scores: Scores,
    /// File of the error map.
    pub error_map: String,
    /// Files of the metrics' pictures, by metric.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub pictures: BTreeMap<String, String>,
}

/// Scores of the views whose direction is within 60° of an HR reference's.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NearReferences {
    /// Number of these views.
    pub views: usize,
    /// Mean PSNR of these views in dB.
    pub psnr: f64,
}

/// Score of a metric: one number, or several related ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Score {
    /// Single number.
    One(f64),
    /// Numbers by name.
    Several(BTreeMap<String, f64>),
}

impl Score {
    /// Creates a score of several numbers with their names.
    pub fn several<const N: usize>(parts: [(&str, f64); N]) -> Self {
        Self::Several(parts.map(|(name, value)| (name.to_owned(), value)).into())
    }
}

/// Scores of a view, or means over views, by metric.
pub type Scores = BTreeMap<String, Score>;

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

/// Name of the file in an artifact of kind `metrics`.
pub const METRICS_FILE: &str = "metrics.json";

/// `metrics.json` of any stage. A user's own stage may omit any field, or write others.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AnyMetrics(Value);

impl AnyMetrics {
    /// Reads the file of an artifact; accepts JSON of any form. Errors name the file.
    pub fn read(folder: &Path) -> io::Result<Self> {
        let file = folder.join(METRICS_FILE);
        let named = |e: io::Error| io::Error::new(e.kind(), format!("{}: {e}", file.display()));
        let bytes = std::fs::read(&file).map_err(named)?;
        serde_json::from_slice(&bytes).map(Self).map_err(|e| named(e.into()))
    }

    /// Returns the formats of the scores to display; `None` if the list is missing or contains
    /// anything but a [`ScoreFormat`].
    pub fn figures(&self) -> Option<Vec<ScoreFormat>> {
        serde_json::from_value(self.0["figures"].clone()).ok()
    }

    /// Returns the names and titles of the metrics' pictures, sorted by name.
    pub fn picture_titles(&self) -> Vec<(&str, &str)> {
        let titles = self.0["picture_titles"].as_object().into_iter().flatten();
        titles.filter_map(|(name, title)| Some((name.as_str(), title.as_str()?))).collect()
    }

    /// Returns whether the views have HR ground truth; without it `eval` scores them at LR only.
    pub fn has_hr_truth(&self) -> bool {
        self.mean()["psnr"].is_number()
    }

    /// Returns the means over the views; null if missing.
    pub fn mean(&self) -> &Value {
        &self.0["mean"]
    }

    /// Returns the views; empty if the list is missing.
    pub fn views(&self) -> &[Value] {
        self.0["views"].as_array().map(Vec::as_slice).unwrap_or_default()
    }

    /// Returns the metrics' definitions as text; null if missing.
    pub fn conventions(&self) -> &Value {
        &self.0["conventions"]
    }

    /// Returns [`Metrics::least_gain`]; null if missing.
    pub fn least_gain(&self) -> &Value {
        &self.0["least_gain"]
    }

    /// Returns [`Metrics::near_references`]; null if missing.
    pub fn near_references(&self) -> &Value {
        &self.0["near_references"]
    }
}

impl From<Value> for AnyMetrics {
    fn from(value: Value) -> Self {
        Self(value)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// A user's own stage may write any JSON.
    #[test]
    fn all_fields_are_optional() {
        for value in [json!({"mean": {"mse": 0.25}, "views": {}, "more": 1}), json!([]), json!(3)] {
            let metrics = AnyMetrics::from(value.clone());
            assert_eq!(metrics.mean(), &value["mean"], "{value}");
            assert_eq!((metrics.figures(), metrics.views().len()), (None, 0), "{value}");
            assert!(metrics.picture_titles().is_empty() && !metrics.has_hr_truth(), "{value}");
            assert!(metrics.conventions().is_null() && metrics.least_gain().is_null(), "{value}");
            assert!(metrics.near_references()["psnr"].is_null(), "{value}");
        }
    }

    #[test]
    fn figures_may_have_more_fields_and_no_direction() {
        let read_figures = |figures: Value| AnyMetrics::from(json!({"figures": figures})).figures();
        let found = read_figures(json!([
            {"path": "a/b", "label": "b", "digits": 1, "colour": "red"},
            {"path": "c", "label": "c", "digits": 3, "higher_is_better": false, "missing": "no c"},
        ]));
        let found = found.unwrap();
        assert_eq!((found[0].higher_is_better, found[1].higher_is_better), (None, Some(false)));
        assert_eq!(found[1].missing.as_deref(), Some("no c"));
        let scores = json!({"a": {"b": 2.34}, "c": "none"});
        assert_eq!(
            found[0].value_in(&scores).map(|value| found[0].format_value(value)),
            Some("2.3".to_owned())
        );
        assert_eq!(found[1].value_in(&scores), None);
        assert_eq!(read_figures(json!([{"path": "a"}])), None);
    }

    #[test]
    fn an_unreadable_file_is_named_in_the_error() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(METRICS_FILE);
        let prefix = format!("{}: ", file.display());
        let problem = || AnyMetrics::read(folder.path()).unwrap_err().to_string();
        assert!(problem().starts_with(&prefix), "{}", problem());
        std::fs::write(&file, "{").unwrap();
        assert!(problem().starts_with(&prefix), "{}", problem());
        std::fs::write(&file, r#"{"mean": {"psnr": 30.5}}"#).unwrap();
        assert_eq!(AnyMetrics::read(folder.path()).unwrap().mean(), &json!({"psnr": 30.5}));
    }
}

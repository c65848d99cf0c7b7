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

mod any_metrics;
mod score_format;

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use any_metrics::{AnyMetrics, METRICS_FILE};
pub use score_format::ScoreFormat;

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

//! The types of `metrics.json`: scores of views, and how their figures are shown.
//!
//! * [`Metrics`]: the file as `eval` writes it, and as `eval` reads it from input `baseline`.
//!   [`ViewScores`] and [`NearReferences`] are parts of it.
//! * [`Score`], [`Scores`]: numbers of one view, or means over all views, by name.
//! * [`Figure`]: a number among the scores, and how it is shown.
//! * [`AnyMetrics`]: the file of any stage, for `report` and `table`. No field has to be there.
//!
//! `eval` computes the scores. No stage before `eval` uses this crate, so a change here makes no
//! training run again.
//!
//! ```
//! use metrics::{AnyMetrics, Figure, Metrics, Score, Scores};
//!
//! let written = Metrics {
//!     conventions: Default::default(),
//!     figures: vec![Figure::new("psnr", "PSNR ↑ dB", 2, true)],
//!     picture_titles: Default::default(),
//!     mean: Scores::from([("psnr".to_owned(), Score::One(31.25))]),
//!     least_gain: None,
//!     near_references: None,
//!     views: Vec::new(),
//! };
//! let read = AnyMetrics::from(serde_json::to_value(&written)?);
//! assert_eq!(read.figures(), Some(written.figures.clone()));
//! let figure = &written.figures[0];
//! let mean = figure.of(read.mean()).unwrap();
//! assert_eq!(figure.text(mean), "31.25");
//! # Ok::<(), serde_json::Error>(())
//! ```

mod any_metrics;
mod figure;
mod score;

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use any_metrics::{AnyMetrics, METRICS_FILE, MetricsError};
pub use figure::Figure;
pub use score::{Score, Scores};

/// `metrics.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Metrics {
    /// How the figures were made, in words, by metric; also what was behind the scene
    /// (`background`) and what error maps show (`error_maps`).
    pub conventions: BTreeMap<String, String>,
    /// The figures, and how they are shown, the most important first.
    pub figures: Vec<Figure>,
    /// Titles of metrics' pictures, by metric.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub picture_titles: BTreeMap<String, String>,
    /// Means of the per-view values.
    pub mean: Scores,
    /// Gain in dB of the view that fares worst over input `baseline`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least_gain: Option<f64>,
    /// Scores of the views near an HR reference, where input `references` is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub near_references: Option<NearReferences>,
    /// Every view.
    pub views: Vec<ViewScores>,
}

/// One view's scores.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ViewScores {
    /// The view.
    pub name: String,
    /// Its scores.
    pub scores: Scores,
    /// Its error map.
    pub error_map: String,
    /// Files of pictures that metrics made, by metric.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub pictures: BTreeMap<String, String>,
}

/// Scores of the views that look the way an HR reference does, within 60°.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NearReferences {
    /// Number of these views.
    pub views: usize,
    /// Their mean PSNR in dB.
    pub psnr: f64,
}

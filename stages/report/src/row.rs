use artifact::RunNode;
use serde_json::Value;

/// One result: the scores of a method's views.
pub(crate) struct Row<'a> {
    pub(crate) node: &'a RunNode,
    /// The node's place in the run.
    pub(crate) index: usize,
    /// `metrics.json`.
    pub(crate) metrics: Value,
    /// What tells it from the others.
    pub(crate) label: String,
    /// The place of its data set among those of the report.
    pub(crate) scene: usize,
    /// Seconds of training.
    pub(crate) training: f64,
    /// Seconds of rendering, refinement included.
    pub(crate) rendering: f64,
}

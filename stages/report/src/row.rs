use artifact::RunNode;
use metrics::{AnyMetrics, Figure};
use serde_json::Value;

/// One result: the scores of a method's views.
pub(crate) struct Row<'a> {
    pub(crate) node: &'a RunNode,
    /// The node's place in the run.
    pub(crate) index: usize,
    /// `metrics.json`.
    pub(crate) metrics: AnyMetrics,
    /// What tells it from the others.
    pub(crate) label: String,
    /// The place of its data set among those of the report.
    pub(crate) scene: usize,
    /// Seconds of training.
    pub(crate) training: f64,
    /// Seconds of rendering, refinement included.
    pub(crate) rendering: f64,
}

impl Row<'_> {
    /// The mean of a figure over the views.
    pub(crate) fn mean(&self, figure: &Figure) -> Option<f64> {
        figure.of(self.metrics.mean())
    }

    /// The scores of a view.
    pub(crate) fn view(&self, name: &str) -> Option<&Value> {
        self.metrics.views().iter().find(|view| view["name"] == name)
    }

    /// Number of views.
    pub(crate) fn view_count(&self) -> usize {
        self.metrics.views().len()
    }
}

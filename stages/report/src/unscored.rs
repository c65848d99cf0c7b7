//! Views that a failed run has made but not scored.

use std::path::PathBuf;

use artifact::RunRecord;

use crate::gather::views_label;

/// Views without scores.
pub(crate) struct UnscoredViews {
    pub(crate) label: String,
    /// Folder of the views.
    pub(crate) folder: PathBuf,
    /// Folder of the views' ground truth, which the scene of the views has.
    pub(crate) truth: Option<PathBuf>,
    /// Index of the data set in [`Report::scenes`](crate::gather::Report::scenes).
    pub(crate) scene: usize,
}

/// Returns the indices of finished views that an unfinished stage needs, and that no finished stage
/// has scored.
pub(crate) fn unscored_nodes(run: &RunRecord) -> Vec<usize> {
    let is_scored = |index: usize| {
        let mut scored = run.nodes.iter().filter(|node| node.kind == "metrics");
        scored.any(|node| node.inputs.values().any(|input| input.node == Some(index)))
    };
    let is_needed = |index: usize| run.unfinished.iter().any(|node| node.needs.contains(&index));
    let views = (0..run.nodes.len()).filter(|&index| run.nodes[index].kind == "views");
    views.filter(|&index| is_needed(index) && !is_scored(index)).collect()
}

impl UnscoredViews {
    /// Describes a node's views; `scene` is the index of their data set.
    pub(crate) fn new(run: &RunRecord, index: usize, scene: usize) -> Self {
        let node = &run.nodes[index];
        let ancestors = run.ancestors(index).into_iter().map(|index| &run.nodes[index]);
        let scenes = ancestors.filter(|node| node.kind == "scene");
        let mut truths = scenes.map(|node| node.folder.join("truth"));
        let truth = truths.find(|folder| folder.join(scene::VIEWS_FILE).is_file());
        let label = artifact::label(&views_label(node), &node.point);
        Self { label: format!("{label}, not scored"), folder: node.folder.clone(), truth, scene }
    }
}

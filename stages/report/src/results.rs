use std::collections::BTreeMap;
use std::path::PathBuf;

use artifact::{RunNode, RunRecord, label, warnings_of};
use metrics::AnyMetrics;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use stage::SUMMARY_FILE;

/// Row of `results.json`: scores for scripts, one row for each block that scored views at each
/// point of the sweep.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ResultRow {
    /// Block that scored the views.
    pub stage: String,
    /// Point of the sweep, such as `supersample=2`; empty without a sweep.
    pub point: String,
    /// Means over the views, as in `metrics.json`; null if the scores can't be read.
    pub mean: Value,
    /// Number of views.
    pub views: usize,
    /// All stages that the scores depend on.
    pub stages: BTreeMap<String, StageResult>,
}

/// Parameters and cost of a stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StageResult {
    /// All parameters of the stage.
    pub parameters: Map<String, Value>,
    /// Seconds that the stage took when it ran.
    pub seconds: f64,
    /// Number of threads.
    pub threads: usize,
    /// Folder of the artifact.
    pub folder: PathBuf,
}

/// Returns the warnings in the stages' summaries, each with its node's name, in the order of the
/// run.
pub(crate) fn warnings_by_node(run: &RunRecord) -> Vec<(String, String)> {
    let mut warnings = Vec::new();
    for node in &run.nodes {
        let summary = std::fs::read_to_string(node.folder.join(SUMMARY_FILE)).unwrap_or_default();
        let name = label(&node.stage, &node.point);
        warnings.extend(warnings_of(&summary).map(|text| (name.clone(), text.to_owned())));
    }
    warnings
}

/// Returns the nodes that scored views, each with its index: those with fewer stages before them
/// first, so that rendered views precede refined ones.
pub(crate) fn scored_nodes(run: &RunRecord) -> Vec<(usize, &RunNode)> {
    let mut nodes: Vec<_> =
        run.nodes.iter().enumerate().filter(|(_, node)| node.kind == "metrics").collect();
    nodes.sort_by_key(|(index, _)| run.ancestors(*index).len());
    nodes
}

/// Returns the rows of `results.json`.
pub(crate) fn results(run: &RunRecord) -> Vec<ResultRow> {
    let rows = scored_nodes(run).into_iter().map(|(index, node)| {
        // The page reports why scores can't be read.
        let metrics = AnyMetrics::read(&node.folder).unwrap_or_default();
        let stages = run.ancestors(index).into_iter().chain([index]).map(|i| {
            let node = &run.nodes[i];
            let result = StageResult {
                parameters: node.parameters.clone(),
                seconds: node.seconds,
                threads: node.threads,
                folder: node.folder.clone(),
            };
            (node.stage.clone(), result)
        });
        ResultRow {
            stage: node.stage.clone(),
            point: node.point.clone(),
            mean: metrics.mean().clone(),
            views: metrics.views().len(),
            stages: stages.collect(),
        }
    });
    rows.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn node(work: &Path, stage: &str, point: &str, summary: Option<&str>) -> RunNode {
        let folder = work.join(stage);
        std::fs::create_dir(&folder).unwrap();
        if let Some(text) = summary {
            std::fs::write(folder.join(SUMMARY_FILE), text).unwrap();
        }
        let node = serde_json::json!({
            "stage": stage, "point": point, "kind": "cameras", "key": "", "output": "",
            "folder": folder, "parameters": {},
            "inputs": {}, "started_unix": 0, "seconds": 0.0, "threads": 1
        });
        serde_json::from_value(node).unwrap()
    }

    #[test]
    fn warnings_are_read_from_summaries() {
        let folder = tempfile::tempdir().unwrap();
        let nodes = vec![
            node(
                folder.path(),
                "register",
                "seed=1",
                Some("2 of 2 cameras registered\nwarning: cameras have turned far\n"),
            ),
            node(folder.path(), "prep", "", Some("8 training views\n")),
            node(folder.path(), "train-ss", "", Some("9 rays\nwarning: one\nwarning: two\n")),
            node(folder.path(), "script", "", None),
        ];
        let found = warnings_by_node(&RunRecord { nodes, ..RunRecord::default() });
        let expected = [
            ("register [seed=1]", "cameras have turned far"),
            ("train-ss", "one"),
            ("train-ss", "two"),
        ];
        assert_eq!(found, expected.map(|(node, warning)| (node.to_owned(), warning.to_owned())));
    }
}

use std::collections::BTreeMap;
use std::path::PathBuf;

use artifact::{RunNode, RunRecord, warnings_of};
use metrics::AnyMetrics;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use stage::SUMMARY_FILE;

/// `results.json`: the page's figures for scripts, one row a point of the sweep.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ResultRow {
    /// The block that scored.
    pub stage: String,
    /// The sweep's point, e.g. `supersample=2`; empty without a sweep.
    pub point: String,
    /// Means over the views, as `metrics.json` has them.
    pub mean: Value,
    /// Number of views.
    pub views: usize,
    /// Every stage that the figures came through.
    pub stages: BTreeMap<String, StageResult>,
}

/// What a stage did for a row.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StageResult {
    /// All its parameters.
    pub parameters: Map<String, Value>,
    /// How long it took when it ran.
    pub seconds: f64,
    /// Threads it had.
    pub threads: usize,
    /// The artifact's folder.
    pub folder: PathBuf,
}

/// What each node's stage warned of in its summary, with the node's name, in the order of the run.
pub(crate) fn warnings_by_node(run: &RunRecord) -> Vec<(String, String)> {
    run.nodes.iter().flat_map(warnings_of_node).collect()
}

fn warnings_of_node(node: &RunNode) -> Vec<(String, String)> {
    let summary = std::fs::read_to_string(node.folder.join(SUMMARY_FILE)).unwrap_or_default();
    let name = if node.point.is_empty() {
        node.stage.clone()
    } else {
        format!("{} [{}]", node.stage, node.point)
    };
    warnings_of(&summary).map(|warning| (name.clone(), warning.to_owned())).collect()
}

/// The nodes that scored, each with its place in the list: what came through fewer stages first, so
/// that what is rendered stands before what is refined.
pub(crate) fn scored(run: &RunRecord) -> Vec<(usize, &RunNode)> {
    let mut scored: Vec<_> =
        run.nodes.iter().enumerate().filter(|(_, node)| node.kind == "metrics").collect();
    scored.sort_by_key(|(index, _)| run.ancestors(*index).len());
    scored
}

pub(crate) fn results(run: &RunRecord) -> Vec<ResultRow> {
    let rows = scored(run).into_iter().map(|(index, node)| {
        // The page says why scores can't be read; here they are null.
        let metrics = AnyMetrics::read(&node.folder).unwrap_or_default();
        let stages = run.ancestors(index).into_iter().chain([index]).map(|i| {
            let node = &run.nodes[i];
            let (seconds, threads) = (node.seconds, node.threads);
            let result = StageResult {
                parameters: node.parameters.clone(),
                seconds,
                threads,
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
        summary.iter().for_each(|text| std::fs::write(folder.join(SUMMARY_FILE), text).unwrap());
        let node = serde_json::json!({
            "stage": stage, "point": point, "kind": "cameras", "key": "", "output": "",
            "folder": folder, "parameters": {},
            "inputs": {}, "started_unix": 0, "seconds": 0.0, "threads": 1
        });
        serde_json::from_value(node).unwrap()
    }

    #[test]
    fn warnings_stand_in_summaries() {
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

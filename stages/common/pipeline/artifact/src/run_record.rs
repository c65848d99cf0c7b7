use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::process::Command;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::bail_bad_input;
use crate::failure::Failure;
use crate::given_input::GivenInput;

/// `run.json`: record of a run, the input of a sink.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunRecord {
    /// Folder in which pages are written; may not exist yet.
    #[serde(default, rename = "home")]
    pub pages_folder: PathBuf,
    /// Command line of the run that started the sink.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub command: Vec<String>,
    /// Data sets of the run, sorted: folders outside the store, and blocks that create data sets.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub data_sets: Vec<String>,
    /// Finished nodes that the sink displays, and their ancestors; parents precede children.
    pub nodes: Vec<RunNode>,
    /// Nodes that the sink should display but that have no artifact; only for partial sinks.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub failed: Vec<FailedPoint>,
    /// Unfinished nodes that the sink should display, and their unfinished ancestors; parents
    /// precede children.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unfinished: Vec<UnfinishedNode>,
}

/// Node that failed, or that depends on a failed one.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct UnfinishedNode {
    /// Name of the block.
    pub stage: String,
    /// Point of the sweep.
    pub point: String,
    /// Kind of the artifact that the node would create.
    pub kind: String,
    /// All parameters.
    pub parameters: Map<String, Value>,
    /// Indices of the required nodes in a list of all [`RunRecord::nodes`], then all
    /// [`RunRecord::unfinished`].
    pub needs: Vec<usize>,
    /// Message of the failure; `None` if the node didn't run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub message: Option<String>,
}

/// Node that failed, that depends on a failed one, or that was excluded.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FailedPoint {
    /// Name of the block.
    pub stage: String,
    /// Point of the sweep.
    pub point: String,
    /// Values of the sweep's or experiment's axes that apply to the node, by axis name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, String>,
    /// Reason for the exclusion; `None` if the node failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// Finished node of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunNode {
    /// Name of the block.
    pub stage: String,
    /// Point of the sweep; empty without a sweep.
    pub point: String,
    /// Values of the sweep's or experiment's axes that apply to the node, by axis name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, String>,
    /// True if the sink displays the node; false for an ancestor of displayed nodes.
    #[serde(default)]
    pub is_shown: bool,
    /// Name of the stage's program.
    #[serde(default)]
    pub program: String,
    /// True if the result was cached before the run; `None` if unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub is_cached: Option<bool>,
    /// Kind of the artifact.
    pub kind: String,
    /// Key of the action.
    pub key: String,
    /// Identity of the artifact.
    pub output: String,
    /// Folder of the artifact.
    pub folder: PathBuf,
    /// All parameters.
    pub parameters: Map<String, Value>,
    /// Final values of the parameters whose default depends on the inputs.
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    pub resolved: Map<String, Value>,
    /// Inputs by name.
    pub inputs: BTreeMap<String, RunInput>,
    /// Start time in seconds since 1970.
    pub started_unix: u64,
    /// Duration in seconds.
    pub seconds: f64,
    /// Number of threads.
    pub threads: usize,
    /// Peak resident memory of the process in bytes, if recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory: Option<u64>,
    /// Processor time of all threads in seconds, if recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub processor_seconds: Option<f64>,
    /// Name of the machine.
    #[serde(default)]
    pub host: String,
}

/// Origin of an input: another node of the run, or a folder outside the store.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RunInput {
    /// Index of the node.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub node: Option<usize>,
    /// Subtree of the artifact; `None` for the whole artifact.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub subtree: Option<String>,
    /// Folder outside the store.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub folder: Option<PathBuf>,
}

/// Formats a stage with its point: `stage [point]`.
pub fn label(stage: &str, point: &str) -> String {
    if point.is_empty() { stage.to_owned() } else { format!("{stage} [{point}]") }
}

/// Returns a sink's output folder for each node, ending in `/`: empty for a single node, otherwise
/// numbered and named by the sweep's values.
pub fn sink_folders(nodes: &[&RunNode]) -> Vec<String> {
    if nodes.len() == 1 {
        return vec![String::new()];
    }
    let mut folders = Vec::new();
    for (index, node) in nodes.iter().enumerate() {
        let text = if node.point.is_empty() { &node.stage } else { &node.point };
        let name = text
            .replace(", ", "-")
            .replace(|c: char| !c.is_alphanumeric() && !"=.-_".contains(c), "_");
        folders.push(format!("{}-{name}/", index + 1));
    }
    folders
}

impl RunRecord {
    /// Reads and checks `run.json` in a sink's input.
    pub fn read(input: &GivenInput) -> Result<Self, Failure> {
        let run: Self = input.read_json("run.json")?;
        run.check()?;
        Ok(run)
    }

    /// Checks that all nodes refer to earlier ones only.
    pub fn check(&self) -> Result<(), Failure> {
        for (index, node) in self.nodes.iter().enumerate() {
            for (name, input) in &node.inputs {
                if input.node.is_some_and(|parent| parent >= index) {
                    bail_bad_input!(
                        "run.json: {}, input {name}, requires a later node",
                        node.stage
                    );
                }
            }
        }
        for (index, node) in self.unfinished.iter().enumerate() {
            if node.needs.iter().any(|&needed| needed >= self.nodes.len() + index) {
                bail_bad_input!("run.json: {} requires a later node", node.stage);
            }
        }
        Ok(())
    }

    /// Returns the git commit of the pages' folder, with `-dirty` if files differ from it; `None`
    /// outside a git repository.
    pub fn commit(&self) -> Option<String> {
        let folder = self.pages_folder.ancestors().find(|folder| folder.is_dir())?;
        let describe = ["describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"];
        let git = Command::new("git").arg("-C").arg(folder).args(describe).output().ok()?;
        let commit = String::from_utf8_lossy(&git.stdout).trim().to_owned();
        (git.status.success() && !commit.is_empty()).then_some(commit)
    }

    /// Returns the folder of an input.
    pub fn folder_of(&self, input: &RunInput) -> PathBuf {
        match (input.node, &input.subtree) {
            (Some(node), Some(subtree)) => self.nodes[node].folder.join(subtree),
            (Some(node), None) => self.nodes[node].folder.clone(),
            (None, _) => input.folder.clone().unwrap_or_default(),
        }
    }

    /// Returns the indices of a node and all its ancestors, sorted.
    pub fn ancestors(&self, node: usize) -> Vec<usize> {
        let mut found = BTreeSet::from([node]);
        for index in (0..=node).rev() {
            if found.contains(&index) {
                found.extend(self.nodes[index].inputs.values().filter_map(|input| input.node));
            }
        }
        found.into_iter().collect()
    }

    /// Returns the nodes of training and of rendering among a node and its ancestors, sorted.
    /// Nodes of training are the fields and refiners, and the views that one of them depends on.
    /// Nodes of rendering are all other views, refined ones included.
    pub fn training_and_rendering(&self, node: usize) -> [Vec<usize>; 2] {
        let mut trained = self.ancestors(node);
        trained.retain(|&i| ["field", "refiner"].contains(&self.nodes[i].kind.as_str()));
        let needed: BTreeSet<usize> = trained.iter().flat_map(|&i| self.ancestors(i)).collect();
        let mut all = self.ancestors(node);
        all.retain(|i| self.nodes[*i].kind == "views" || trained.contains(i));
        let (training, rendering) = all.into_iter().partition(|i| needed.contains(i));
        [training, rendering]
    }

    /// Lists the data sets that a node depends on: their folders, or the blocks that made them.
    pub fn data_set(&self, node: usize) -> String {
        let mut found = BTreeSet::new();
        for node in self.ancestors(node).into_iter().map(|i| &self.nodes[i]) {
            if !["dataset", "scene"].contains(&node.kind.as_str()) {
                continue;
            }
            let folders: Vec<_> =
                node.inputs.values().filter_map(|input| input.folder.as_ref()).collect();
            if node.kind == "dataset" && folders.is_empty() {
                found.insert(node.stage.clone());
            }
            found.extend(folders.iter().map(|folder| folder.display().to_string()));
        }
        found.into_iter().collect::<Vec<_>>().join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(point: &str) -> RunNode {
        serde_json::from_value(serde_json::json!({
            "stage": "train-ss", "point": point, "kind": "field", "key": "", "output": "",
            "folder": "", "parameters": {}, "inputs": {}, "started_unix": 0, "seconds": 0.0,
            "threads": 1,
        }))
        .unwrap()
    }

    #[test]
    fn folders_of_a_sweep_are_numbered_and_named() {
        let nodes = [node("rays=3, scale=2"), node("data=a/../b"), node("")];
        assert_eq!(
            sink_folders(&nodes.each_ref()),
            ["1-rays=3-scale=2/", "2-data=a_.._b/", "3-train-ss/"]
        );
        assert_eq!(sink_folders(&[&nodes[0]]), [""]);
    }

    /// Renders of references count as rendering, although they aren't the scored views. Views that
    /// a refiner was trained on count as training.
    #[test]
    fn views_for_a_training_are_training() {
        let node = |stage: &str, kind: &str, inputs: &[(&str, usize)]| {
            let mut node = node("");
            (node.stage, node.kind) = (stage.to_owned(), kind.to_owned());
            let of_node = |&(name, i): &(&str, usize)| {
                (name.to_owned(), RunInput { node: Some(i), ..RunInput::default() })
            };
            node.inputs = inputs.iter().map(of_node).collect();
            node
        };
        let mut nodes = vec![
            node("photographs", "dataset", &[]),
            node("prep", "scene", &[("dataset", 0)]),
            node("train-ss", "field", &[("scene", 1)]),
            node("downscaled-views", "views", &[("field", 2)]),
            node("train-refine", "refiner", &[("views", 3)]),
            node("reference-views", "views", &[("field", 2)]),
            node("render-depth", "views", &[("field", 2)]),
            node("refine", "views", &[("views", 6), ("reference-views", 5), ("refiner", 4)]),
            node("eval", "metrics", &[("views", 7)]),
        ];
        let run = RunRecord { nodes: nodes.clone(), ..RunRecord::default() };
        assert_eq!(run.training_and_rendering(8), [vec![2, 3, 4], vec![5, 6, 7]]);
        assert_eq!(run.data_set(8), "photographs");
        let folder = RunInput { folder: Some("data/lego".into()), ..RunInput::default() };
        nodes[0].inputs.insert("folder".to_owned(), folder);
        assert_eq!(RunRecord { nodes, ..run }.data_set(8), "data/lego");
    }
}

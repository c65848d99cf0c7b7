use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Command;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// `run.json`: what a sink is told of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunRecord {
    /// The folder in which pages are written; it may have yet to be made.
    #[serde(default)]
    pub home: PathBuf,
    /// The command line of the run that had the sink called.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub command: Vec<String>,
    /// The data sets that it is about, sorted: folders outside the store, and blocks that make data
    /// sets.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub data_sets: Vec<String>,
    /// Every node that what is shown was made of; parents come before their children.
    pub nodes: Vec<RunNode>,
    /// What should be shown and isn't there, where the sink shows what there is.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub failed: Vec<FailedPoint>,
    /// The nodes on the way to these that aren't done; parents come before their children.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unfinished: Vec<UnfinishedNode>,
}

/// A node that failed, or that waits for one that did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct UnfinishedNode {
    /// Name of the stage's block.
    pub stage: String,
    /// The sweep's point.
    pub point: String,
    /// Kind of the artifact that it would make.
    pub kind: String,
    /// All parameters.
    pub parameters: Map<String, Value>,
    /// The nodes that it needs: places in [`RunRecord::nodes`], and after these in
    /// [`RunRecord::unfinished`].
    pub needs: Vec<usize>,
    /// What it said when it failed; nothing where it didn't run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub message: Option<String>,
}

/// A node that failed, that waits for one that did, or that was left out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FailedPoint {
    /// Name of the stage's block.
    pub stage: String,
    /// The sweep's point.
    pub point: String,
    /// The values of the sweep's or experiment's axes that reach it, by the axes' names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, String>,
    /// Why it was left out; nothing where it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// One finished node of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunNode {
    /// Name of the stage's block.
    pub stage: String,
    /// The sweep's point; empty without a sweep.
    pub point: String,
    /// The values of the sweep's or experiment's axes that reach it, by the axes' names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, String>,
    /// Whether the sink shows it; else something that is shown was made of it.
    #[serde(default)]
    pub is_shown: bool,
    /// Name of the stage's program.
    #[serde(default)]
    pub program: String,
    /// Whether the run found it in the cache; nothing where that isn't known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub is_cached: Option<bool>,
    /// Kind of its artifact.
    pub kind: String,
    /// The action's key.
    pub key: String,
    /// The artifact's identity.
    pub output: String,
    /// The artifact's folder.
    pub folder: PathBuf,
    /// All parameters.
    pub parameters: Map<String, Value>,
    /// Values in use of the parameters whose default depends on the inputs.
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    pub resolved: Map<String, Value>,
    /// Inputs by name.
    pub inputs: BTreeMap<String, RunInput>,
    /// When it started, seconds since 1970.
    pub started_unix: u64,
    /// How long it took.
    pub seconds: f64,
    /// Threads it had.
    pub threads: usize,
    /// Peak resident memory of its process, in bytes, where the record has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory: Option<u64>,
    /// Processor time of all its threads, in seconds, where the record has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub processor_seconds: Option<f64>,
    /// Where it ran.
    #[serde(default)]
    pub host: String,
}

/// Where an input came from: another node of the list, or a folder outside the store.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RunInput {
    /// The node's place in the list.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub node: Option<usize>,
    /// The folder of its artifact that is meant, where it isn't all of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub subtree: Option<String>,
    /// The folder outside the store.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub folder: Option<PathBuf>,
}

/// A stage and a sweep's point, as people read it.
pub fn label(stage: &str, point: &str) -> String {
    if point.is_empty() { stage.to_owned() } else { format!("{stage} [{point}]") }
}

/// A node that needs one that doesn't come before it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("run.json: {stage}{} needs a node that doesn't come before it", named(.input.as_deref()))]
pub struct RunRecordError {
    stage: String,
    /// By which input; none of a node that isn't done.
    input: Option<String>,
}

fn named(input: Option<&str>) -> String {
    input.map_or_else(String::new, |input| format!(", input {input},"))
}

/// Folders for what a sink makes of each of some nodes, with `/` at the end: none for a single one,
/// else numbered and named by the sweep's values, as far as a folder can have them in its name.
pub fn folders_of(nodes: &[&RunNode]) -> Vec<String> {
    if nodes.len() == 1 {
        return vec![String::new()];
    }
    (1..).zip(nodes).map(|(number, node)| format!("{number}-{}/", folder_name(node))).collect()
}

fn folder_name(node: &RunNode) -> String {
    let text = if node.point.is_empty() { &node.stage } else { &node.point };
    let plain = |c: char| if c.is_alphanumeric() || "=.-_".contains(c) { c } else { '_' };
    text.replace(", ", "-").chars().map(plain).collect()
}

impl RunRecord {
    /// Says what is wrong with a list whose inputs don't name earlier nodes.
    pub fn check(&self) -> Result<(), RunRecordError> {
        for (index, node) in self.nodes.iter().enumerate() {
            if let Some((name, _)) =
                node.inputs.iter().find(|(_, input)| input.node.is_some_and(|n| n >= index))
            {
                return Err(RunRecordError {
                    stage: node.stage.clone(),
                    input: Some(name.clone()),
                });
            }
        }
        for (index, node) in self.unfinished.iter().enumerate() {
            if node.needs.iter().any(|&needed| needed >= self.nodes.len() + index) {
                return Err(RunRecordError { stage: node.stage.clone(), input: None });
            }
        }
        Ok(())
    }

    /// The commit of the tree in which pages are written, `-dirty` where it differs; nothing where
    /// the tree isn't under git.
    pub fn commit(&self) -> Option<String> {
        let folder = self.home.ancestors().find(|folder| folder.is_dir())?;
        let describe = ["describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"];
        let git = Command::new("git").arg("-C").arg(folder).args(describe).output().ok()?;
        let said = String::from_utf8_lossy(&git.stdout).trim().to_owned();
        Some(said).filter(|said| git.status.success() && !said.is_empty())
    }

    /// The folder that an input names.
    pub fn folder_of(&self, input: &RunInput) -> PathBuf {
        match (input.node, &input.subtree) {
            (Some(node), Some(subtree)) => self.nodes[node].folder.join(subtree),
            (Some(node), None) => self.nodes[node].folder.clone(),
            (None, _) => input.folder.clone().unwrap_or_default(),
        }
    }

    /// The nodes that a node was made of, itself included, in order.
    pub fn ancestors(&self, of: usize) -> Vec<usize> {
        let mut wanted = vec![false; self.nodes.len()];
        wanted[of] = true;
        for i in (0..self.nodes.len()).rev() {
            if wanted[i] {
                self.nodes[i]
                    .inputs
                    .values()
                    .filter_map(|input| input.node)
                    .for_each(|p| wanted[p] = true);
            }
        }
        (0..self.nodes.len()).filter(|&i| wanted[i]).collect()
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
    fn a_sweeps_folders_are_numbered_and_named() {
        let nodes = [node("rays=3, scale=2"), node("data=a/../b"), node("")];
        assert_eq!(
            folders_of(&nodes.each_ref()),
            ["1-rays=3-scale=2/", "2-data=a_.._b/", "3-train-ss/"]
        );
        assert_eq!(folders_of(&[&nodes[0]]), [""]);
    }
}

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Deserialize;
use serde_json::{Map, Value};

/// `run.json`, as the runner writes it (schemas/run.json).
#[derive(Clone, Debug, Deserialize)]
pub struct Run {
    /// The nodes; parents come first.
    pub nodes: Vec<RunNode>,
}

/// One finished node.
#[derive(Clone, Debug, Deserialize)]
pub struct RunNode {
    /// Name of the stage's block.
    pub stage: String,
    /// The sweep's point.
    pub point: String,
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
    /// Inputs by name.
    pub inputs: BTreeMap<String, Source>,
    /// How long it took.
    pub seconds: f64,
    /// Threads it had.
    pub threads: usize,
}

/// Where an input came from.
#[derive(Clone, Debug, Deserialize)]
pub struct Source {
    /// Another node.
    pub node: Option<usize>,
    /// A folder of its artifact.
    pub subtree: Option<String>,
    /// A folder outside the store.
    pub folder: Option<PathBuf>,
}

impl Run {
    /// The folder that an input of a node names.
    pub fn folder_of(&self, source: &Source) -> PathBuf {
        match (source.node, &source.subtree) {
            (Some(node), Some(subtree)) => self.nodes[node].folder.join(subtree),
            (Some(node), None) => self.nodes[node].folder.clone(),
            (None, _) => source.folder.clone().unwrap_or_default(),
        }
    }

    /// All nodes that a node was made of, itself included, in the run's order.
    pub fn ancestors(&self, index: usize) -> Vec<usize> {
        let mut wanted = vec![false; self.nodes.len()];
        wanted[index] = true;
        for i in (0..=index).rev().filter(|&i| i < self.nodes.len()) {
            if wanted[i] {
                self.nodes[i].inputs.values().filter_map(|s| s.node).for_each(|p| wanted[p] = true);
            }
        }
        (0..self.nodes.len()).filter(|&i| wanted[i]).collect()
    }
}

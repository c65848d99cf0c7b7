use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use artifact::{FailedPoint, RunInput, hash_json, label};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use slurm::Resources;
use stage::GivenInputs;
use store::{PartialKey, Record};

use crate::stages::StageProgram;

/// Nodes (stages × swept values) and sinks to run.
#[derive(Default)]
pub struct Plan {
    /// Nodes; each comes after its parents.
    pub nodes: Vec<Node>,
    /// Sinks among the targets.
    pub sinks: Vec<Sink>,
    /// Notes to print: overridden and repeated arguments, blocks that are left out.
    pub notes: Vec<String>,
    /// Devices of the stages.
    pub devices: Devices,
    /// Resources by stage, as given in the file.
    pub resources: BTreeMap<String, Resources>,
}

/// Devices of the stages.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Devices {
    /// Device given on the command line.
    pub given: String,
    /// True if stages with GPUs among their resources use `cuda:0`.
    pub by_resources: bool,
}

/// Planned action: a stage at one point of the sweep. `P` refers to the program.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Node<P = Arc<StageProgram>> {
    /// Name of the stage's block.
    pub stage: String,
    /// Swept values that reach the node, such as `supersample=2`; empty without a sweep. The first
    /// point's values if several points share the node.
    pub point: String,
    /// Values of the named axes that reach the node, by the axis's name.
    pub values: BTreeMap<String, String>,
    /// All parameters, including defaults.
    pub parameters: Value,
    /// Inputs, sorted by name.
    pub inputs: Vec<NodeInput>,
    /// Program of the stage.
    pub program: P,
}

/// Input of a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeInput {
    /// Name of the input.
    pub name: String,
    /// Origin of the input.
    pub from: Origin,
}

/// Origin of an input.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// Artifact of another node, or a subtree of it.
    Node {
        /// Index of the node in the plan.
        index: usize,
        /// Subtree of the artifact; `None` for the whole artifact.
        subtree: Option<String>,
    },
    /// Folder outside the store.
    Folder(PathBuf),
}

/// Planned sink: a stage that presents a run. `P` refers to the program.
#[derive(Clone, Serialize, Deserialize)]
pub struct Sink<P = Arc<StageProgram>> {
    /// Name of the stage's block.
    pub stage: String,
    /// Program of the stage.
    pub program: P,
    /// All parameters, including defaults.
    pub parameters: Value,
    /// Points to show, each after the points of the stages that it depends on.
    #[serde(rename = "shows")]
    pub points: Vec<ShownPoint>,
    /// Points that can't be shown because a required file is missing.
    pub left_out: Vec<FailedPoint>,
}

/// Point of a stage that a sink shows. Points with equal parameters and inputs share a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShownPoint {
    /// Index of the node.
    pub node: usize,
    /// Swept values that reach the point, such as `supersample=2`; empty without a sweep.
    pub point: String,
    /// Values of the named axes that reach the point, by the axis's name.
    pub values: BTreeMap<String, String>,
}

/// State of a node before a run.
#[derive(Debug, Clone)]
pub enum State {
    /// A record with the node's key exists.
    Cached(Box<Record>),
    /// The node's inputs are known, and no record has its key.
    WillRun {
        /// All parts of the key.
        key_parts: Map<String, Value>,
    },
    /// The key depends on nodes that must run first.
    Waits {
        /// Indices of these nodes.
        on: Vec<usize>,
    },
}

impl<P> Node<P> {
    /// Replaces the reference to the program.
    pub(crate) fn with_program<Q>(self, program: Q) -> Node<Q> {
        let Self { stage, point, values, parameters, inputs, .. } = self;
        Node { stage, point, values, parameters, inputs, program }
    }
}

impl<P> Sink<P> {
    /// Replaces the reference to the program.
    pub(crate) fn with_program<Q>(self, program: Q) -> Sink<Q> {
        let Self { stage, parameters, points, left_out, .. } = self;
        Sink { stage, program, parameters, points, left_out }
    }
}

impl Node {
    /// Returns stage and point as text.
    pub fn label(&self) -> String {
        label(&self.stage, &self.point)
    }

    /// Returns the part of the node's key that is known while inputs are unknown.
    pub fn partial_key(&self) -> PartialKey {
        PartialKey {
            program: self.program.description.name.clone(),
            parameters: self.parameters.as_object().cloned().unwrap_or_default(),
        }
    }

    /// Returns the parameters whose defaults depend on the scene, with the values that the artifact
    /// records. Values are null if the artifact doesn't exist yet.
    pub fn scene_defaults(&self, artifact: &Path) -> Map<String, Value> {
        let output = &self.program.description.output;
        if output.resolved.is_none() {
            return Map::new();
        }
        let mut recorded = output.resolved(artifact);
        let names = self.program.schema.by_scene(&self.parameters).into_iter();
        names.map(|name| (name.to_owned(), recorded.remove(name).unwrap_or_default())).collect()
    }

    /// Returns the indices of the nodes that produce the inputs.
    pub fn parents(&self) -> impl Iterator<Item = usize> + '_ {
        self.inputs.iter().filter_map(NodeInput::node)
    }

    /// Returns the inputs, each with the parameters of the node that produces the input; `None` for
    /// a folder. `nodes` are all nodes of the plan.
    pub(crate) fn given_inputs(&self, nodes: &[Self]) -> GivenInputs {
        let inputs = self.inputs.iter();
        inputs
            .map(|input| (input.name.clone(), input.node().map(|i| nodes[i].parameters.clone())))
            .collect()
    }

    /// Returns the inputs for the record of a run. `index_in_record` converts a node's index in the
    /// plan to its index in the record.
    pub fn run_inputs(
        &self,
        index_in_record: impl Fn(usize) -> Option<usize>,
    ) -> BTreeMap<String, RunInput> {
        let mut inputs = BTreeMap::new();
        for NodeInput { name, from } in &self.inputs {
            let input = match from {
                Origin::Node { index, subtree } => RunInput {
                    node: index_in_record(*index),
                    subtree: subtree.clone(),
                    folder: None,
                },
                Origin::Folder(folder) => {
                    RunInput { folder: Some(folder.clone()), ..RunInput::default() }
                }
            };
            inputs.insert(name.clone(), input);
        }
        inputs
    }
}

impl Sink {
    /// Returns the indices of the nodes to show, sorted.
    pub fn nodes(&self) -> BTreeSet<usize> {
        self.points.iter().map(|shown| shown.node).collect()
    }
}

impl NodeInput {
    /// Returns the index of the node that produces the input; `None` for a folder.
    pub fn node(&self) -> Option<usize> {
        match self.from {
            Origin::Node { index, .. } => Some(index),
            Origin::Folder(_) => None,
        }
    }
}

impl State {
    /// Returns the name of the state.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Cached(_) => "cached",
            Self::WillRun { .. } => "will run",
            Self::Waits { .. } => "waits",
        }
    }

    /// Returns the record of a cached node.
    pub fn into_record(self) -> Option<Record> {
        match self {
            Self::Cached(record) => Some(*record),
            Self::WillRun { .. } | Self::Waits { .. } => None,
        }
    }

    /// Returns the key, if it is known.
    pub fn key(&self) -> Option<String> {
        match self {
            Self::Cached(record) => Some(record.key()),
            Self::WillRun { key_parts } => Some(hash_json(key_parts)),
            Self::Waits { .. } => None,
        }
    }
}

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use artifact::{FailedPoint, RunInput, hash_json, label};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use slurm::Resources;
use store::{Record, Waiting};

use crate::stages::StageProgram;

/// Stages × swept values, in an order in which every node comes after what it needs.
#[derive(Default)]
pub struct Plan {
    /// The nodes.
    pub nodes: Vec<Node>,
    /// Sinks that are wanted: name, program, parameters, and the nodes they show (with what those
    /// are made of).
    pub sinks: Vec<Sink>,
    /// What to tell of the command line: what is overridden there, and what is given twice.
    pub notes: Vec<String>,
    /// Where stages compute.
    pub devices: Devices,
    /// What each stage needs of a machine, where the file says so.
    pub resources: BTreeMap<String, Resources>,
}

/// Where stages compute.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Devices {
    /// As the command line says.
    pub given: String,
    /// Whether a stage that needs GPUs computes on the first of its own.
    pub by_resources: bool,
}

/// One action to be: a stage at one point of the sweep.
#[derive(Clone, Debug)]
pub struct Node {
    /// Name of the stage's block.
    pub stage: String,
    /// The sweep's values that reach it, e.g. `supersample=2`; empty without a sweep.
    pub point: String,
    /// The values of the axes that reach it and have a name, by that.
    pub values: BTreeMap<String, String>,
    /// All parameters, defaults filled in.
    pub parameters: Value,
    /// Inputs, sorted by name.
    pub inputs: Vec<NodeInput>,
    /// The stage's program.
    pub program: Arc<StageProgram>,
}

/// An input of a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeInput {
    /// Its name.
    pub name: String,
    /// Where it comes from.
    pub from: Origin,
}

/// Where an input comes from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// Another node's artifact, or a folder of it.
    Node {
        /// The node.
        index: usize,
        /// The folder of its artifact that is meant, where that isn't all.
        subtree: Option<String>,
    },
    /// A folder outside the store.
    Folder(PathBuf),
}

/// A stage that shows a run.
pub struct Sink {
    /// Name of the stage's block.
    pub stage: String,
    /// The stage's program.
    pub program: Arc<StageProgram>,
    /// All parameters, defaults filled in.
    pub parameters: Value,
    /// The nodes that it shows.
    pub shows: Vec<usize>,
    /// What it would show, if that had been there to make it of.
    pub left_out: Vec<FailedPoint>,
}

/// The state of a node before a run.
#[derive(Debug, Clone)]
pub enum State {
    /// Done before, with this record.
    Cached(Box<Record>),
    /// Its inputs are known, its key has no record.
    WillRun {
        /// All parts of its key.
        key_parts: Map<String, Value>,
    },
    /// It can't be known before these have run.
    Waits {
        /// Nodes.
        on: Vec<usize>,
    },
}

impl Node {
    /// Stage and point, as people read it.
    pub fn label(&self) -> String {
        label(&self.stage, &self.point)
    }

    /// What a record of it looks like, while its inputs aren't known.
    pub fn waiting(&self) -> Waiting {
        Waiting {
            program: self.program.description.name.clone(),
            parameters: self.parameters.as_object().cloned().unwrap_or_default(),
        }
    }

    /// The parameters that the scene decides, with the values that a finished artifact records;
    /// null before that.
    pub fn by_scene(&self, artifact: &Path) -> Map<String, Value> {
        let output = &self.program.description.output;
        if output.resolved.is_none() {
            return Map::new();
        }
        let mut recorded = output.resolved(artifact);
        let names = self.program.schema.by_scene(&self.parameters);
        names
            .into_iter()
            .map(|name| (name.to_owned(), recorded.remove(name).unwrap_or_default()))
            .collect()
    }

    /// The nodes it needs.
    pub fn parents(&self) -> impl Iterator<Item = usize> + '_ {
        self.inputs.iter().filter_map(NodeInput::node)
    }
}

impl Node {
    /// Its inputs as a record names them; `number` gives another node's place in the record.
    pub fn run_inputs(
        &self,
        number: impl Fn(usize) -> Option<usize>,
    ) -> BTreeMap<String, RunInput> {
        self.inputs
            .iter()
            .map(|input| (input.name.clone(), input.from.run_input(&number)))
            .collect()
    }
}

impl Origin {
    /// As a record names it.
    fn run_input(&self, number: impl Fn(usize) -> Option<usize>) -> RunInput {
        match self {
            Self::Node { index, subtree } => {
                RunInput { node: number(*index), subtree: subtree.clone(), folder: None }
            }
            Self::Folder(folder) => {
                RunInput { folder: Some(folder.clone()), ..RunInput::default() }
            }
        }
    }
}

impl NodeInput {
    /// The node that makes it.
    pub fn node(&self) -> Option<usize> {
        match self.from {
            Origin::Node { index, .. } => Some(index),
            Origin::Folder(_) => None,
        }
    }
}

impl State {
    /// In a word.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Cached(_) => "cached",
            Self::WillRun { .. } => "will run",
            Self::Waits { .. } => "waits",
        }
    }

    /// The record, where it is done.
    pub fn record(self) -> Option<Record> {
        match self {
            Self::Cached(record) => Some(*record),
            Self::WillRun { .. } | Self::Waits { .. } => None,
        }
    }

    /// The key, where it is known.
    pub fn key(&self) -> Option<String> {
        match self {
            Self::Cached(record) => Some(record.key()),
            Self::WillRun { key_parts } => Some(hash_json(key_parts)),
            Self::Waits { .. } => None,
        }
    }
}

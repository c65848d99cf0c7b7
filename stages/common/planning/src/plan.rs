use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use artifact::{Description, FailedPoint, Record, RunInput, Store, Waiting, hash_json, label};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use slurm::Resources;
use stage_call::Interrupted;

use crate::axes::Scope;
use crate::check::{self, closure, needs};
use crate::expand::Expansion;
use crate::experiment::Selection;
use crate::key;
use crate::pipeline::{Pipeline, PipelineError};
use crate::renames::known_blocks;
use crate::stages::{Asking, Programs, StageProgram};

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

/// What is asked for on the command line.
#[derive(Clone, Debug, Default)]
pub struct Request {
    /// Stages to make; empty: the file's default.
    pub targets: Vec<String>,
    /// `name=value[,value…]`, the name with or without its stage.
    pub parameters: Vec<String>,
    /// `input=DIR[,DIR…]`, likewise.
    pub inputs: Vec<String>,
    /// What of an experiment is wanted.
    pub choice: Selection,
}

/// Why there is no plan.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The file is wrong.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The command line is wrong.
    #[error("{0}")]
    Usage(String),
    /// A source folder is wrong.
    #[error("{0}")]
    Source(String),
    /// A signal came while stages were asked what they are.
    #[error("interrupted")]
    Interrupted,
}

impl From<Interrupted> for PlanError {
    fn from(_: Interrupted) -> Self {
        Self::Interrupted
    }
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
        let source = |from: &Origin| match from {
            Origin::Node { index, subtree } => {
                RunInput { node: number(*index), subtree: subtree.clone(), folder: None }
            }
            Origin::Folder(folder) => {
                RunInput { folder: Some(folder.clone()), ..RunInput::default() }
            }
        };
        self.inputs.iter().map(|input| (input.name.clone(), source(&input.from))).collect()
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

impl Plan {
    /// Checks the whole file, then expands what is asked for.
    pub fn new(
        pipeline: &Pipeline,
        store: &Store,
        request: &Request,
        asking: Asking,
    ) -> Result<Self, PlanError> {
        let goal = Goal::new(pipeline, request)?;
        let programs = Programs::ask(pipeline, store, &goal.needed, asking)?;
        goal.plan(pipeline, &programs, request)
    }

    /// The plan where programs would describe themselves so: by the name of their file, or the path
    /// that `run` gives. Nothing is started and no file is read.
    pub fn from_descriptions(
        pipeline: &Pipeline,
        descriptions: &BTreeMap<String, Description>,
        request: &Request,
    ) -> Result<Self, PlanError> {
        Goal::new(pipeline, request)?.plan(pipeline, &Programs::of(pipeline, descriptions), request)
    }

    /// Where a stage computes.
    pub fn device(&self, stage: &str) -> &str {
        let has_gpu = self.resources.get(stage).is_some_and(Resources::has_gpu);
        if self.devices.by_resources && has_gpu { "cuda:0" } else { &self.devices.given }
    }

    /// What is known of each node before a run.
    pub fn states(&self, store: &Store) -> Result<Vec<State>, PlanError> {
        let mut states: Vec<State> = Vec::with_capacity(self.nodes.len());
        for node in &self.nodes {
            let on: BTreeSet<usize> =
                node.parents().filter(|&p| !matches!(states[p], State::Cached(_))).collect();
            if !on.is_empty() {
                states.push(State::Waits { on: on.into_iter().collect() });
                continue;
            }
            let outputs = |index: usize| match &states[index] {
                State::Cached(record) => record.output.clone(),
                _ => unreachable!("a node whose parents aren't cached waits"),
            };
            let hashes = input_hashes(node, store, outputs)?;
            let key_parts = key::parts(node, &hashes, self.device(&node.stage));
            states.push(match store.hit(&hash_json(&key_parts)) {
                Some(record) => State::Cached(Box::new(record)),
                None => State::WillRun { key_parts },
            });
        }
        Ok(states)
    }
}

/// What is to be made.
struct Goal<'a> {
    targets: &'a [String],
    /// The stages that the targets come to by the file alone.
    needed: BTreeSet<String>,
}

impl<'a> Goal<'a> {
    fn new(pipeline: &'a Pipeline, request: &'a Request) -> Result<Self, PlanError> {
        check::names(pipeline)?;
        let targets = if request.targets.is_empty() { &pipeline.default } else { &request.targets };
        if let Some(target) = targets.iter().find(|target| !pipeline.stages.contains_key(*target)) {
            let known = known_blocks(target, pipeline.stages.keys().map(String::as_str));
            return Err(PlanError::Usage(format!("no stage {target:?}; {known}")));
        }
        let needed = closure(targets, |stage| needs(pipeline, stage).map(str::to_owned).collect());
        Ok(Self { targets, needed })
    }

    fn plan(
        &self,
        pipeline: &Pipeline,
        programs: &Programs,
        request: &Request,
    ) -> Result<Plan, PlanError> {
        check::blocks(pipeline, programs)?;
        let order = check::order(pipeline)?;
        let (axes, mut notes) = Scope { pipeline, programs, needed: &self.needed }.axes(request)?;
        let plan = Expansion::new(pipeline, programs, &axes, &request.choice)?
            .expand(&order, self.targets)?;
        notes.extend(plan.notes);
        let resources = self.needed.iter().map(|stage| (stage.clone(), pipeline.resources(stage)));
        Ok(Plan {
            notes,
            resources: resources.filter(|(_, needs)| !needs.is_empty()).collect(),
            ..plan
        })
    }
}

/// Content hashes of a node's inputs, given its parents' outputs.
pub fn input_hashes(
    node: &Node,
    store: &Store,
    output_of: impl Fn(usize) -> String,
) -> Result<Vec<(String, String)>, PlanError> {
    let hash = |input: &NodeInput| match &input.from {
        Origin::Node { index, subtree: None } => Ok(output_of(*index)),
        Origin::Node { index, subtree: Some(folder) } => {
            let manifest =
                store.manifest(&output_of(*index)).map_err(|e| PlanError::Source(e.to_string()))?;
            Ok(manifest.subtree(folder).identity())
        }
        Origin::Folder(folder) => source_hash(store, node, &input.name, folder),
    };
    node.inputs.iter().map(|input| Ok((input.name.clone(), hash(input)?))).collect()
}

/// Content hash of a folder outside the store, an input of a node.
pub fn source_hash(
    store: &Store,
    node: &Node,
    input: &str,
    folder: &Path,
) -> Result<String, PlanError> {
    let problem = |e| PlanError::Source(format!("stage {}: input {input}: {e}", node.stage));
    crate::sources::hash_source(store, folder).map_err(problem)
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;

#[cfg(test)]
#[path = "experiment_tests.rs"]
mod experiment_tests;

#[cfg(test)]
#[path = "variant_tests.rs"]
mod variant_tests;

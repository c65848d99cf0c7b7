//! A plan as a file: what is queued stays what was submitted, whatever becomes of pipeline.yaml
//! meanwhile.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use artifact::FailedPoint;
use contract::Description;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use slurm::Resources;

use crate::node::{Devices, Node, NodeInput, Origin, Plan, Sink};
use crate::stages::{ProgramError, StageProgram};

/// A plan without what can be made again from the rest.
#[derive(Serialize, Deserialize)]
pub struct Frozen {
    /// Where pages go.
    pub out: PathBuf,
    devices: Devices,
    resources: BTreeMap<String, Resources>,
    programs: BTreeMap<PathBuf, Description>,
    nodes: Vec<FrozenNode>,
    sinks: Vec<FrozenSink>,
}

#[derive(Serialize, Deserialize)]
struct FrozenNode {
    stage: String,
    point: String,
    values: BTreeMap<String, String>,
    parameters: Value,
    inputs: Vec<NodeInput>,
    program: PathBuf,
}

#[derive(Serialize, Deserialize)]
struct FrozenSink {
    stage: String,
    parameters: Value,
    shows: Vec<usize>,
    left_out: Vec<FailedPoint>,
    program: PathBuf,
}

/// Why a frozen plan can't be used.
#[derive(Debug, thiserror::Error)]
pub enum FrozenError {
    /// The file can't be read.
    #[error("{path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It has another form.
    #[error("{path}: another nerf-sr wrote it ({source}); submit it again")]
    Form {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: serde_json::Error,
    },
    /// There is no such task.
    #[error("the submission has no task {0}")]
    Task(usize),
    /// A program isn't described as it should be.
    #[error(transparent)]
    Program(#[from] ProgramError),
}

impl Frozen {
    /// The plan as it is written; pages go to a folder.
    pub fn new(plan: &Plan, out: &Path) -> Self {
        let programs = plan
            .nodes
            .iter()
            .map(|node| &node.program)
            .chain(plan.sinks.iter().map(|sink| &sink.program));
        let nodes = plan.nodes.iter().map(|node| FrozenNode {
            stage: node.stage.clone(),
            point: node.point.clone(),
            values: node.values.clone(),
            parameters: node.parameters.clone(),
            inputs: node.inputs.clone(),
            program: node.program.path.clone(),
        });
        let sinks = plan.sinks.iter().map(|sink| FrozenSink {
            stage: sink.stage.clone(),
            parameters: sink.parameters.clone(),
            shows: sink.shows.clone(),
            left_out: sink.left_out.clone(),
            program: sink.program.path.clone(),
        });
        Self {
            out: out.to_path_buf(),
            devices: plan.devices.clone(),
            resources: plan.resources.clone(),
            programs: programs
                .map(|program| (program.path.clone(), program.description.clone()))
                .collect(),
            nodes: nodes.collect(),
            sinks: sinks.collect(),
        }
    }

    /// Reads a file that a submission wrote.
    pub fn read(path: &Path) -> Result<Self, FrozenError> {
        let bytes = std::fs::read(path)
            .map_err(|source| FrozenError::Read { path: path.to_path_buf(), source })?;
        serde_json::from_slice(&bytes)
            .map_err(|source| FrozenError::Form { path: path.to_path_buf(), source })
    }

    /// The plan of one task: the nodes that it needs, and itself at the end. Sinks are counted
    /// after the nodes.
    pub fn part(&self, number: usize) -> Result<Plan, FrozenError> {
        let absent = || FrozenError::Task(number);
        let sink = number
            .checked_sub(self.nodes.len())
            .map(|index| self.sinks.get(index).ok_or_else(absent))
            .transpose()?;
        let mut wanted: BTreeSet<usize> =
            sink.map_or_else(|| [number].into(), |sink| sink.shows.iter().copied().collect());
        for index in (0..self.nodes.len()).rev() {
            if wanted.contains(&index) {
                wanted.extend(self.nodes[index].inputs.iter().filter_map(NodeInput::node));
            }
        }
        let position: BTreeMap<usize, usize> =
            wanted.iter().enumerate().map(|(at, &index)| (index, at)).collect();
        let mut programs = BTreeMap::new();
        let mut nodes = Vec::with_capacity(wanted.len());
        for node in wanted.iter().map(|&index| &self.nodes[index]) {
            let FrozenNode { stage, point, values, parameters, inputs, program } = node;
            let (stage, point, values, parameters) =
                (stage.clone(), point.clone(), values.clone(), parameters.clone());
            let inputs = inputs.iter().map(|input| input.moved(&position)).collect();
            nodes.push(Node {
                stage,
                point,
                values,
                parameters,
                inputs,
                program: self.program(program, &mut programs)?,
            });
        }
        let mut sinks = Vec::new();
        if let Some(FrozenSink { stage, parameters, shows, left_out, program }) = sink {
            let (stage, parameters, left_out) =
                (stage.clone(), parameters.clone(), left_out.clone());
            let shows = shows.iter().map(|index| position[index]).collect();
            sinks.push(Sink {
                stage,
                parameters,
                shows,
                left_out,
                program: self.program(program, &mut programs)?,
            });
        }
        Ok(Plan {
            nodes,
            sinks,
            notes: Vec::new(),
            devices: self.devices.clone(),
            resources: self.resources.clone(),
        })
    }

    fn program<'a>(
        &'a self,
        path: &'a Path,
        known: &mut BTreeMap<&'a Path, Arc<StageProgram>>,
    ) -> Result<Arc<StageProgram>, FrozenError> {
        if let Some(program) = known.get(path) {
            return Ok(Arc::clone(program));
        }
        let absent = || ProgramError::Undescribed(path.to_path_buf());
        let description = self.programs.get(path).ok_or_else(absent)?;
        let program = Arc::new(StageProgram::new(path, description.clone())?);
        known.insert(path, Arc::clone(&program));
        Ok(program)
    }
}

impl NodeInput {
    /// The same input where nodes have other places.
    fn moved(&self, position: &BTreeMap<usize, usize>) -> Self {
        let from = match &self.from {
            Origin::Node { index, subtree } => {
                Origin::Node { index: position[index], subtree: subtree.clone() }
            }
            Origin::Folder(folder) => Origin::Folder(folder.clone()),
        };
        Self { name: self.name.clone(), from }
    }
}

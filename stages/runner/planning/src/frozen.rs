//! Plan as a file: queued jobs run the plan that was submitted, even if pipeline.yaml has changed
//! (docs/design/032).

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use slurm::Resources;
use stage::Description;

use crate::node::{Devices, Node, NodeInput, Origin, Plan, Sink};
use crate::stage_call::ProgramError;
use crate::stages::StageProgram;

/// Serialisable plan.
#[derive(Serialize, Deserialize)]
pub struct FrozenPlan {
    /// Folder of pages.
    pub out: PathBuf,
    devices: Devices,
    resources: BTreeMap<String, Resources>,
    programs: BTreeMap<PathBuf, Description>,
    nodes: Vec<Node<PathBuf>>,
    sinks: Vec<Sink<PathBuf>>,
}

impl FrozenPlan {
    /// Freezes a plan. `out` is the folder of pages.
    pub fn new(plan: &Plan, out: &Path) -> Self {
        let of_nodes = plan.nodes.iter().map(|node| &node.program);
        let programs = of_nodes.chain(plan.sinks.iter().map(|sink| &sink.program));
        let nodes = plan.nodes.iter().map(|n| n.clone().with_program(n.program.path.clone()));
        let sinks = plan.sinks.iter().map(|s| s.clone().with_program(s.program.path.clone()));
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

    /// Reads the plan of a submission.
    pub fn read(path: &Path) -> Result<Self, ProgramError> {
        let name = path.display();
        let bytes =
            std::fs::read(path).map_err(|problem| ProgramError(format!("{name}: {problem}")))?;
        serde_json::from_slice(&bytes).map_err(|problem| {
            let problem = format!("written by another version of nerf-sr ({problem})");
            ProgramError(format!("{name}: {problem}; submit again"))
        })
    }

    /// Returns the plan of one task: the node or sink of this number, with all nodes that it needs.
    /// Sinks are numbered after the nodes.
    pub fn task_plan(&self, number: usize) -> Result<Plan, ProgramError> {
        let mut needed = BTreeSet::new();
        let mut sink = None;
        if number < self.nodes.len() {
            needed.insert(number);
        } else {
            let found = self.sinks.get(number - self.nodes.len());
            let found = found
                .ok_or_else(|| ProgramError(format!("the submission has no task {number}")))?;
            needed.extend(found.points.iter().map(|shown| shown.node));
            sink = Some(found.clone());
        }
        for index in (0..self.nodes.len()).rev() {
            if needed.contains(&index) {
                needed.extend(self.nodes[index].inputs.iter().filter_map(NodeInput::node));
            }
        }
        let mut new_index = BTreeMap::new();
        let mut programs = BTreeMap::new();
        let mut nodes = Vec::with_capacity(needed.len());
        for old_index in needed {
            let mut node = self.nodes[old_index].clone();
            for input in &mut node.inputs {
                if let Origin::Node { index, .. } = &mut input.from {
                    *index = new_index[index];
                }
            }
            let program = self.program(&node.program, &mut programs)?;
            new_index.insert(old_index, nodes.len());
            nodes.push(node.with_program(program));
        }
        let mut sinks = Vec::new();
        if let Some(mut sink) = sink {
            for shown in &mut sink.points {
                shown.node = new_index[&shown.node];
            }
            let program = self.program(&sink.program, &mut programs)?;
            sinks.push(sink.with_program(program));
        }
        Ok(Plan {
            nodes,
            sinks,
            notes: Vec::new(),
            devices: self.devices.clone(),
            resources: self.resources.clone(),
        })
    }

    /// Returns a program, the same one for all nodes of its path.
    fn program(
        &self,
        path: &Path,
        known: &mut BTreeMap<PathBuf, Arc<StageProgram>>,
    ) -> Result<Arc<StageProgram>, ProgramError> {
        if let Some(program) = known.get(path) {
            return Ok(Arc::clone(program));
        }
        let Some(description) = self.programs.get(path) else {
            return Err(ProgramError::undescribed(path));
        };
        let program = Arc::new(StageProgram::new(path, description.clone())?);
        known.insert(path.to_path_buf(), Arc::clone(&program));
        Ok(program)
    }
}

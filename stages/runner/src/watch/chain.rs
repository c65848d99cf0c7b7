use std::path::PathBuf;
use std::sync::Arc;

use planning::{Node, Origin, Plan, StageProgram};
use serde_json::Value;

/// The stages of a plan that show a node's checkpoint: one renders it, the other scores that.
pub(crate) struct Chain {
    pub(super) render: Step,
    pub(super) score: Step,
}

/// One of them, by the contract. Inputs that may be left out are left out.
pub(super) struct Step {
    pub(super) program: Arc<StageProgram>,
    pub(super) parameters: Value,
    pub(super) device: String,
    /// The input that the step before makes.
    pub(super) fed: String,
    /// The other inputs, with their folders.
    pub(super) inputs: Vec<(String, PathBuf)>,
}

impl Chain {
    /// The first two stages that make views of the node's artifact and scores of those, where all
    /// else that they need is there; `folder_of` says where.
    pub(crate) fn find(
        plan: &Plan,
        node: usize,
        folder_of: &dyn Fn(&Origin) -> Option<PathBuf>,
    ) -> Option<Self> {
        (0..plan.nodes.len()).find_map(|index| {
            let render = Step::new(plan, index, node, "views", folder_of)?;
            let score = (0..plan.nodes.len())
                .find_map(|next| Step::new(plan, next, index, "metrics", folder_of))?;
            Some(Self { render, score })
        })
    }
}

impl Step {
    /// A node that makes a kind of artifact of another's.
    fn new(
        plan: &Plan,
        index: usize,
        before: usize,
        kind: &str,
        folder_of: &dyn Fn(&Origin) -> Option<PathBuf>,
    ) -> Option<Self> {
        let node: &Node = &plan.nodes[index];
        let description = &node.program.description;
        let made = Origin::Node { index: before, subtree: None };
        let fed = node.inputs.iter().find(|input| input.from == made)?.name.clone();
        if description.output.kind != kind {
            return None;
        }
        let others = node.inputs.iter().filter(|input| {
            input.name != fed && description.inputs.get(&input.name).is_some_and(|i| !i.optional)
        });
        let inputs: Option<Vec<(String, PathBuf)>> =
            others.map(|input| Some((input.name.clone(), folder_of(&input.from)?))).collect();
        Some(Self {
            program: Arc::clone(&node.program),
            parameters: node.parameters.clone(),
            device: plan.device(&node.stage).to_owned(),
            fed,
            inputs: inputs?,
        })
    }
}

use std::path::PathBuf;
use std::sync::Arc;

use planning::{Origin, Plan, StageProgram};
use serde_json::Value;

/// The two blocks of a plan that render a checkpoint's field and score the view.
pub(crate) struct Chain {
    pub(super) render: Link,
    pub(super) score: Link,
}

/// One block of a chain, without its optional inputs.
pub(super) struct Link {
    pub(super) program: Arc<StageProgram>,
    pub(super) parameters: Value,
    pub(super) device: String,
    /// Name of the input that gets the previous block's output.
    pub(super) chained_input: String,
    /// Names and folders of the other inputs.
    pub(super) inputs: Vec<(String, PathBuf)>,
}

impl Chain {
    /// Finds the first block that renders a node's field, and a block that scores those views. The
    /// blocks' other required inputs must exist; `folder_of` returns their folders.
    pub(crate) fn find(
        plan: &Plan,
        node: usize,
        folder_of: &dyn Fn(&Origin) -> Option<PathBuf>,
    ) -> Option<Self> {
        (0..plan.nodes.len()).find_map(|index| {
            let render = Link::new(plan, index, node, "views", folder_of)?;
            let score = (0..plan.nodes.len())
                .find_map(|next| Link::new(plan, next, index, "metrics", folder_of))?;
            Some(Self { render, score })
        })
    }
}

impl Link {
    /// Creates the link of node `index` if node `before` is one of its inputs and `kind` is its
    /// output's kind.
    fn new(
        plan: &Plan,
        index: usize,
        before: usize,
        kind: &str,
        folder_of: &dyn Fn(&Origin) -> Option<PathBuf>,
    ) -> Option<Self> {
        let node = &plan.nodes[index];
        let description = &node.program.description;
        if description.output.kind != kind {
            return None;
        }
        let output = Origin::Node { index: before, subtree: None };
        let chained_input = &node.inputs.iter().find(|input| input.from == output)?.name;
        let mut inputs = Vec::new();
        for input in &node.inputs {
            if input.name != *chained_input && !description.inputs[&input.name].optional {
                inputs.push((input.name.clone(), folder_of(&input.from)?));
            }
        }
        Some(Self {
            program: Arc::clone(&node.program),
            parameters: node.parameters.clone(),
            device: plan.device(&node.stage).to_owned(),
            chained_input: chained_input.clone(),
            inputs,
        })
    }
}

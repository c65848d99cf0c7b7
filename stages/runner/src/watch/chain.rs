use std::path::PathBuf;
use std::sync::Arc;

use planning::{NodeInput, Origin, Plan, StageProgram};
use serde_json::Value;

/// The two blocks of a plan that render a checkpoint's field and score the view.
pub(crate) struct Chain {
    pub(super) render: Link,
    pub(super) score: Link,
}

/// One block of a chain. Its optional inputs are omitted.
pub(super) struct Link {
    pub(super) program: Arc<StageProgram>,
    pub(super) parameters: Value,
    pub(super) device: String,
    /// Name of the input that takes the previous block's output.
    pub(super) fed: String,
    /// The other inputs, with their folders.
    pub(super) inputs: Vec<(String, PathBuf)>,
}

impl Chain {
    /// Finds the first block that renders a node's field, and a block that scores those views.
    /// Their other required inputs must exist; `folder_of` gives the folders.
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
    /// Node `index`, if it takes node `before` and makes an artifact of this kind.
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
        let made = Origin::Node { index: before, subtree: None };
        let fed = node.inputs.iter().find(|input| input.from == made)?.name.clone();
        let is_optional = |input: &&NodeInput| description.inputs[&input.name].optional;
        let others = node.inputs.iter().filter(|input| input.name != fed && !is_optional(input));
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

use std::path::PathBuf;

use planning::{Node, Origin, Plan};

/// The two blocks of a plan that render a checkpoint's field and score the view.
pub(crate) struct Chain<'a> {
    pub(super) render: Link<'a>,
    pub(super) score: Link<'a>,
}

/// One block of a chain, without its optional inputs.
pub(super) struct Link<'a> {
    pub(super) node: &'a Node,
    pub(super) device: &'a str,
    /// Name of the input that gets the previous block's output.
    pub(super) chained_input: &'a str,
    /// Names and folders of the other inputs.
    pub(super) inputs: Vec<(&'a str, PathBuf)>,
}

impl<'a> Chain<'a> {
    /// Finds the first block that renders a node's field, and a block that scores those views. The
    /// blocks' other required inputs must exist; `folder_of` returns their folders.
    pub(crate) fn find(
        plan: &'a Plan,
        node: usize,
        folder_of: &dyn Fn(&Origin) -> Option<PathBuf>,
    ) -> Option<Self> {
        // Creates the link of node `index` if node `before` is one of its inputs and `kind` is its
        // output's kind.
        let link = |index: usize, before: usize, kind: &str| {
            let node = &plan.nodes[index];
            let description = &node.program.description;
            let output = Origin::Node { index: before, subtree: None };
            let chained = node.inputs.iter().find(|input| input.from == output);
            let chained_input = chained.filter(|_| description.output.kind == kind)?.name.as_str();
            let mut inputs = Vec::new();
            for input in &node.inputs {
                if input.name != chained_input && !description.inputs[&input.name].optional {
                    inputs.push((input.name.as_str(), folder_of(&input.from)?));
                }
            }
            Some(Link { node, device: plan.device(&node.stage), chained_input, inputs })
        };
        let indices = 0..plan.nodes.len();
        indices.clone().find_map(|index| {
            let render = link(index, node, "views")?;
            let score = indices.clone().find_map(|next| link(next, index, "metrics"))?;
            Some(Self { render, score })
        })
    }
}

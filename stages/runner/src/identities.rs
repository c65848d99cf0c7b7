use std::sync::atomic::AtomicBool;

use artifact::hash_json;
use planning::{Origin, Plan, PlanError, read_source};
use store::Store;

/// By what nodes are known before their keys are: a key's parts, with what a parent is in the place
/// of what it made. Ends soon after `stop` is set.
pub(crate) fn identities(
    plan: &Plan,
    store: &Store,
    stop: Option<&AtomicBool>,
) -> Result<Vec<String>, PlanError> {
    let mut identities: Vec<String> = Vec::with_capacity(plan.nodes.len());
    for node in &plan.nodes {
        let mut inputs = Vec::new();
        for input in &node.inputs {
            let from = match &input.from {
                Origin::Node { index, subtree } => {
                    format!("{}/{}", identities[*index], subtree.as_deref().unwrap_or_default())
                }
                Origin::Folder(folder) => {
                    read_source(store, node, &input.name, folder, stop)?.content_hash()
                }
            };
            inputs.push((input.name.clone(), from));
        }
        identities.push(hash_json(&planning::key_parts(node, &inputs, plan.device(&node.stage))));
    }
    Ok(identities)
}

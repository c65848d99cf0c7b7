use std::sync::atomic::AtomicBool;

use artifact::hash_json;
use planning::{Origin, Plan, PlanError, read_source};
use store::Store;

/// Computes identities of nodes whose keys may not be known yet: hashes of the key's parts, with
/// parents' identities instead of their outputs (docs/design/032). Fails soon after `stop` is set.
pub(crate) fn node_identities(
    plan: &Plan,
    store: &Store,
    stop: Option<&AtomicBool>,
) -> Result<Vec<String>, PlanError> {
    let mut identities: Vec<String> = Vec::with_capacity(plan.nodes.len());
    for node in &plan.nodes {
        let mut inputs = Vec::new();
        for input in &node.inputs {
            let content = match &input.from {
                Origin::Node { index, subtree } => {
                    format!("{}/{}", identities[*index], subtree.as_deref().unwrap_or_default())
                }
                Origin::Folder(folder) => {
                    read_source(store, node, &input.name, folder, stop)?.content_hash()
                }
            };
            inputs.push((input.name.clone(), content));
        }
        identities.push(hash_json(&planning::key_parts(node, &inputs, plan.device(&node.stage))));
    }
    Ok(identities)
}

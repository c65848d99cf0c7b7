use artifact::hash_json;
use planning::{Origin, Plan, PlanError, source_hash};
use store::Store;

/// By what nodes are known before their keys are: a key's parts, with what a parent is in the place
/// of what it made.
pub(crate) fn identities(plan: &Plan, store: &Store) -> Result<Vec<String>, PlanError> {
    let mut identities: Vec<String> = Vec::with_capacity(plan.nodes.len());
    for node in &plan.nodes {
        let mut inputs = Vec::new();
        for input in &node.inputs {
            let from = match &input.from {
                Origin::Node { index, subtree } => {
                    format!("{}/{}", identities[*index], subtree.as_deref().unwrap_or_default())
                }
                Origin::Folder(folder) => source_hash(store, node, &input.name, folder)?,
            };
            inputs.push((input.name.clone(), from));
        }
        identities.push(hash_json(&planning::parts(node, &inputs, plan.device(&node.stage))));
    }
    Ok(identities)
}

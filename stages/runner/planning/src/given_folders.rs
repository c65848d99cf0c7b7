//! Checks, before any stage runs, the input folders that are outside the store.

use std::collections::BTreeMap;
use std::path::PathBuf;

use stage::GivenInputs;

use crate::node::{Node, Origin, Plan};
use crate::request::PlanError;
use crate::sources::{SourceError, check_folder};

impl Plan {
    /// Checks that all folders outside the store exist, and that they contain the files that rules
    /// of the stages require, such as a network's weights.
    pub fn check_folders(&self) -> Result<(), PlanError> {
        for node in &self.nodes {
            let failure = |input: &str, problem| PlanError::Source {
                stage: node.stage.clone(),
                input: input.to_owned(),
                problem,
            };
            let mut folders: BTreeMap<String, PathBuf> = BTreeMap::new();
            for input in &node.inputs {
                let Origin::Folder(folder) = &input.from else { continue };
                check_folder(folder).map_err(|problem| failure(&input.name, problem))?;
                folders.insert(input.name.clone(), folder.clone());
            }
            let inputs = given_inputs(node, &self.nodes);
            let description = &node.program.description;
            let missing = description.missing_files(&node.parameters, &inputs, &folders);
            if let Some((input, problem)) = missing {
                let folder = folders[input].clone();
                return Err(failure(input, SourceError::Folder { folder, problem }));
            }
        }
        Ok(())
    }
}

/// Returns a node's inputs, each with the parameters of the node that produces the input; `None`
/// for a folder.
pub(crate) fn given_inputs(node: &Node, nodes: &[Node]) -> GivenInputs {
    let mut inputs = GivenInputs::new();
    for input in &node.inputs {
        let parameters = input.node().map(|index| nodes[index].parameters.clone());
        inputs.insert(input.name.clone(), parameters);
    }
    inputs
}

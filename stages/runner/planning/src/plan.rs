use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use artifact::hash_json;
use slurm::Resources;
use stage::Description;
use store::{Record, Store, StoreError};

use crate::axes::Scope;
use crate::check;
use crate::expand::Expansion;
use crate::experiment_axes;
use crate::key::key_parts;
use crate::node::{Node, NodeInput, Origin, Plan, State};
use crate::pipeline::Pipeline;
use crate::request::{PlanError, Request};
use crate::sources::{Source, SourceError, check_folder};
use crate::stages::{Describing, Programs};

impl Plan {
    /// Checks the whole pipeline, then expands the targets to nodes.
    pub fn new(
        pipeline: &Pipeline,
        store: &Store,
        request: &Request,
        describing: Describing,
    ) -> Result<Self, PlanError> {
        let goal = Goal::new(pipeline, request)?;
        let programs = Programs::find(pipeline, store, &goal.needed, describing)?;
        goal.plan(pipeline, &programs, request)
    }

    /// Creates a plan from given descriptions, keyed by the program's name or its path in `run`.
    /// Starts no program and reads no file.
    pub fn from_descriptions(
        pipeline: &Pipeline,
        descriptions: &BTreeMap<String, Description>,
        request: &Request,
    ) -> Result<Self, PlanError> {
        Goal::new(pipeline, request)?.plan(
            pipeline,
            &Programs::from_descriptions(pipeline, descriptions),
            request,
        )
    }

    /// Returns the device of a stage.
    pub fn device(&self, stage: &str) -> &str {
        let has_gpu = self.resources.get(stage).is_some_and(Resources::has_gpu);
        if self.devices.by_resources && has_gpu { "cuda:0" } else { &self.devices.given }
    }

    /// Checks that all folders outside the store exist, and that they contain the files that rules
    /// of the stages require, such as a network's weights.
    pub fn check_folders(&self) -> Result<(), PlanError> {
        for node in &self.nodes {
            let mut folders: BTreeMap<String, PathBuf> = BTreeMap::new();
            for input in &node.inputs {
                let Origin::Folder(folder) = &input.from else { continue };
                check_folder(folder).map_err(|e| source_error(node, &input.name, e))?;
                folders.insert(input.name.clone(), folder.clone());
            }
            let inputs = node.given_inputs(&self.nodes);
            let description = &node.program.description;
            let missing = description.missing_files(&node.parameters, &inputs, &folders);
            if let Some((input, problem)) = missing {
                let folder = folders[input].clone();
                return Err(source_error(node, input, SourceError::Folder { folder, problem }));
            }
        }
        Ok(())
    }

    /// Returns the state of each node before a run. Fails with [`PlanError::Interrupted`] soon
    /// after `stop` is set.
    pub fn states(
        &self,
        store: &Store,
        stop: Option<&AtomicBool>,
    ) -> Result<Vec<State>, PlanError> {
        let mut states: Vec<State> = Vec::with_capacity(self.nodes.len());
        for node in &self.nodes {
            let unfinished_parents: BTreeSet<usize> =
                node.parents().filter(|&p| !matches!(states[p], State::Cached(_))).collect();
            if !unfinished_parents.is_empty() {
                states.push(State::Waits { on: unfinished_parents.into_iter().collect() });
                continue;
            }
            let inputs = hash_inputs(node, store, stop, |index| cached_output(&states[index]))?;
            let key_parts = key_parts(node, &inputs.hashes, self.device(&node.stage));
            states.push(match store.hit(&hash_json(&key_parts))? {
                Some(record) => State::Cached(Box::new(record)),
                None => State::WillRun { key_parts },
            });
        }
        Ok(states)
    }
}

fn cached_output(state: &State) -> String {
    match state {
        State::Cached(record) => record.output.clone(),
        _ => unreachable!("a node waits unless all parents are cached"),
    }
}

/// Targets, with the stages that they need.
struct Goal<'a> {
    targets: &'a [String],
    /// Targets and their transitive dependencies in the file.
    needed: BTreeSet<String>,
}

impl<'a> Goal<'a> {
    fn new(pipeline: &'a Pipeline, request: &'a Request) -> Result<Self, PlanError> {
        check::check_names(pipeline)?;
        let targets = if request.targets.is_empty() { &pipeline.default } else { &request.targets };
        if let Some(target) = targets.iter().find(|target| !pipeline.stages.contains_key(*target)) {
            let known = check::known_stages(pipeline, target);
            return Err(PlanError::Usage(format!("no stage {target:?}; {known}")));
        }
        let needed = check::dependencies(targets, |stage| {
            check::input_stages(pipeline, stage).map(str::to_owned).collect()
        });
        Ok(Self { targets, needed })
    }

    fn plan(
        &self,
        pipeline: &Pipeline,
        programs: &Programs,
        request: &Request,
    ) -> Result<Plan, PlanError> {
        check::check_blocks(pipeline, programs)?;
        let order = check::topological_order(pipeline)?;
        let scope = Scope { pipeline, programs, needed: &self.needed };
        let (axes, mut notes) = scope.axes(request, experiment_axes::axes(&scope, request)?)?;
        let plan = Expansion::new(pipeline, programs, &axes, &request.selection)?
            .expand(&order, self.targets)?;
        notes.extend(plan.notes);
        let resources = self.needed.iter().map(|stage| (stage.clone(), pipeline.resources(stage)));
        let resources = resources.filter(|(_, resources)| !resources.is_empty()).collect();
        Ok(Plan { notes, resources, ..plan })
    }
}

/// Returns records of the artifacts that nodes read as folders of the store, not as other nodes'
/// outputs.
pub fn stored_inputs<'a>(
    nodes: impl IntoIterator<Item = &'a Node>,
    store: &Store,
) -> Result<Vec<Record>, StoreError> {
    let inputs = nodes.into_iter().flat_map(|node| &node.inputs);
    let folders: BTreeSet<&PathBuf> = inputs
        .filter_map(|input| match &input.from {
            Origin::Folder(folder) => Some(folder),
            Origin::Node { .. } => None,
        })
        .collect();
    let records = folders.into_iter().map(|folder| store.record_of_folder(folder));
    records.filter_map(Result::transpose).collect()
}

/// Content hashes of a node's inputs, and those inputs that are folders outside the store.
pub struct HashedInputs {
    /// Content hashes by input name.
    pub hashes: Vec<(String, String)>,
    /// Folders outside the store by input name.
    pub sources: BTreeMap<String, Source>,
}

/// Hashes a node's inputs. `output_of` returns the identity of a parent's artifact. Fails with
/// [`PlanError::Interrupted`] soon after `stop` is set.
pub fn hash_inputs(
    node: &Node,
    store: &Store,
    stop: Option<&AtomicBool>,
    output_of: impl Fn(usize) -> String,
) -> Result<HashedInputs, PlanError> {
    let mut found = HashedInputs { hashes: Vec::new(), sources: BTreeMap::new() };
    for NodeInput { name, from } in &node.inputs {
        let hash = match from {
            Origin::Node { index, subtree: None } => output_of(*index),
            Origin::Node { index, subtree: Some(folder) } => {
                let manifest = store.manifest(&output_of(*index)).map_err(PlanError::Artifact)?;
                manifest.subtree(folder).identity()
            }
            Origin::Folder(folder) => {
                let source = read_source(store, node, name, folder, stop)?;
                let content = source.content_hash();
                found.sources.insert(name.clone(), source);
                content
            }
        };
        found.hashes.push((name.clone(), hash));
    }
    Ok(found)
}

/// Reads the folder of a node's input. Fails with [`PlanError::Interrupted`] soon after `stop` is
/// set.
pub fn read_source(
    store: &Store,
    node: &Node,
    input: &str,
    folder: &Path,
    stop: Option<&AtomicBool>,
) -> Result<Source, PlanError> {
    Source::read(store, folder, stop).map_err(|problem| source_error(node, input, problem))
}

fn source_error(node: &Node, input: &str, problem: SourceError) -> PlanError {
    let (stage, input) = (node.stage.clone(), input.to_owned());
    match problem {
        SourceError::Interrupted => PlanError::Interrupted,
        problem => PlanError::Source { stage, input, problem },
    }
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;

#[cfg(test)]
#[path = "experiment_tests.rs"]
mod experiment_tests;

#[cfg(test)]
#[path = "variant_tests.rs"]
mod variant_tests;

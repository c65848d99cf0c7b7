//! Estimates of the processor time that stages will take (docs/design/048).
//!
//! * `costs`: models of the stages, from numbers of rays and pixels.
//! * `scene`: number and size of the images, from an artifact of `prep` or from the data set.
//!
//! An earlier run of the stage on equal inputs corrects the model's estimate for the machine and
//! the scene.

mod costs;
mod scene;

use std::collections::BTreeMap;

use planning::{Node, Origin, Plan, State};
use serde_json::{Map, Value};
use store::{Record, Store};

use costs::{Work, processor_seconds};
use scene::SceneImages;

/// Prefixes of parts of keys.
const PARAMETER_PART: &str = "parameter ";
const INPUT_PART: &str = "input ";

/// Estimates for the nodes of a plan.
pub(crate) struct Estimates<'a> {
    plan: &'a Plan,
    states: &'a [State],
    records: Vec<Record>,
    /// Images by index of the node of `prep`.
    scenes: BTreeMap<usize, SceneImages>,
}

impl<'a> Estimates<'a> {
    /// Collects what is known of the scenes of a plan. `records` are those of earlier runs.
    pub(crate) fn new(
        plan: &'a Plan,
        states: &'a [State],
        records: Vec<Record>,
        store: &Store,
    ) -> Self {
        let mut scenes = BTreeMap::new();
        for (index, node) in plan.nodes.iter().enumerate() {
            if node.program.description.name == "prep"
                && let Some(images) = scene_images(plan, &states[index], node, store)
            {
                scenes.insert(index, images);
            }
        }
        Self { plan, states, records, scenes }
    }

    /// Returns the images of each scene of the plan.
    pub(crate) fn scenes(&self) -> impl Iterator<Item = &SceneImages> {
        self.scenes.values()
    }

    /// Returns the expected processor seconds of a node; `None` for stages without a model, and for
    /// scenes that aren't known yet.
    pub(crate) fn processor_seconds(&self, index: usize) -> Option<f64> {
        let node = &self.plan.nodes[index];
        let program = &node.program.description.name;
        let work = self.work(node)?;
        let expected = processor_seconds(program, &node.parameters, &work)?;
        let correction = match &self.states[index] {
            State::WillRun { key_parts } => self.correction(node, key_parts, &work),
            _ => None,
        };
        Some(expected * correction.unwrap_or(1.0))
    }

    /// Returns what a node's time depends on.
    fn work(&self, node: &Node) -> Option<Work> {
        let images_input = match node.program.description.name.as_str() {
            "train-ss" => "scene",
            "render-depth" => "cameras",
            "eval" => "truth",
            _ => return None,
        };
        let (index, subtree) = parent(node, images_input)?;
        let scene = self.scenes.get(&index)?;
        let fields = match parent(node, "field") {
            Some((field, _)) => self.plan.nodes[field].parameters["ensemble"].as_u64().unwrap_or(1),
            None => 1,
        };
        Some(Work {
            kind: scene.kind,
            images: scene.images(subtree?)?,
            fields,
            is_fine_tuning: node.inputs.iter().any(|input| input.name == "init"),
        })
    }

    /// Returns the measured time of the newest run of a stage on equal inputs, over the model's.
    fn correction(&self, node: &Node, key_parts: &Map<String, Value>, work: &Work) -> Option<f64> {
        let has_equal_inputs = |record: &&Record| {
            let mut inputs = key_parts.iter().filter(|(part, _)| part.starts_with(INPUT_PART));
            record.stage == node.stage
                && record.processor_seconds.is_some()
                && inputs.all(|(part, hash)| record.key_parts.get(part) == Some(hash))
        };
        let record = self
            .records
            .iter()
            .filter(has_equal_inputs)
            .max_by_key(|record| record.started_unix)?;
        let parameters: Map<String, Value> = record
            .key_parts
            .iter()
            .filter_map(|(part, value)| {
                Some((part.strip_prefix(PARAMETER_PART)?.to_owned(), value.clone()))
            })
            .collect();
        let program = &node.program.description.name;
        let expected = processor_seconds(program, &Value::Object(parameters), work)?;
        Some(record.processor_seconds? / expected)
    }
}

/// Returns the index of the node that produces an input, and the input's subtree.
fn parent<'n>(node: &'n Node, input: &str) -> Option<(usize, Option<&'n str>)> {
    let input = node.inputs.iter().find(|other| other.name == input)?;
    match &input.from {
        Origin::Node { index, subtree } => Some((*index, subtree.as_deref())),
        Origin::Folder(_) => None,
    }
}

/// Returns the images that a node of `prep` has made or will make.
fn scene_images(plan: &Plan, state: &State, prep: &Node, store: &Store) -> Option<SceneImages> {
    if let State::Cached(record) = state {
        return SceneImages::of_artifact(&store.object(&record.output));
    }
    let dataset = prep.inputs.iter().find(|input| input.name == "dataset")?;
    match &dataset.from {
        Origin::Folder(folder) => SceneImages::of_dataset(folder, &prep.parameters),
        Origin::Node { index, .. } => {
            let demo = &plan.nodes[*index];
            SceneImages::of_demo(&demo.parameters, &prep.parameters)
        }
    }
}

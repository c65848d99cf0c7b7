//! Estimates of the processor time and peak memory of stages (docs/design/048).
//!
//! * `costs`: models of the stages, from numbers of rays and pixels, and the speed of this machine,
//!   by a short measurement on all cores.
//! * `work`, `scene`: number and size of the images, from an artifact of `prep`, from the data set,
//!   or of the frames along a `camera-path`.
//! * `text`: estimates as text, before and after a run.
//!
//! The nearest earlier run of the stage on this machine corrects the model's estimate.

mod costs;
mod scene;
mod text;
mod work;

use std::collections::BTreeMap;
use std::path::Path;

use planning::{Node, Origin, Plan, State, nearest_record};
use serde_json::{Map, Value, json};
use store::{ModelCost, Record, Store, host_name};

pub(crate) use text::{check_memory, comparison_text, run_text, total_comparison_text};

use costs::{min_memory, model_cost, slowness};
pub(crate) use scene::Datasets;
use scene::{SceneImages, computed_frames, recorded_frames};
use work::{Images, Work};

/// Minimum processor seconds of an earlier run that corrects an estimate, and maximum factor
/// between the model's times of the two runs: shorter runs depend on other costs. Both are chosen
/// by hand.
const MIN_RECORD_SECONDS: f64 = 1.0;
const MAX_TIME_FACTOR: f64 = 10.0;
/// Maximum factor by which an earlier run corrects the estimated memory; chosen by hand.
const MAX_CORRECTION: f64 = 4.0;

/// Expected cost of a node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Estimate {
    /// Processor seconds on this machine.
    pub(crate) processor_seconds: f64,
    /// Peak memory in bytes.
    pub(crate) memory: u64,
    /// Memory below which the stage fails.
    pub(crate) min_memory: u64,
    /// Cost by the model alone, for the record.
    pub(crate) model: ModelCost,
}

/// Estimates for the nodes of a plan that aren't cached.
#[derive(Clone, Debug, Default)]
pub(crate) struct Estimates {
    /// Estimates by node index; none for cached nodes, stages without a model, and scenes that
    /// aren't known yet.
    pub(crate) nodes: BTreeMap<usize, Estimate>,
    /// Number of nodes that aren't cached and have no estimate.
    pub(crate) unknown: usize,
    /// Descriptions of the plan's scenes.
    pub(crate) scenes: Vec<String>,
}

/// Estimates nodes of a plan.
pub(crate) struct Estimator<'a> {
    plan: &'a Plan,
    /// Images by index of the node of `prep`.
    scenes: BTreeMap<usize, SceneImages>,
    /// Earlier runs on this machine with a model's cost.
    records: Vec<Record>,
    /// Number of threads of a stage.
    threads: u64,
}

impl<'a> Estimator<'a> {
    /// Reads what estimates depend on: scenes and earlier runs. If all nodes are cached, nothing is
    /// read. `datasets` keeps data sets for other plans.
    pub(crate) fn new(
        plan: &'a Plan,
        states: &[State],
        store: &Store,
        datasets: &mut Datasets,
    ) -> Self {
        let threads = stage::processors().count as u64;
        let mut estimator = Self { plan, scenes: BTreeMap::new(), records: Vec::new(), threads };
        if states.iter().all(is_cached) {
            return estimator;
        }
        for (index, node) in plan.nodes.iter().enumerate() {
            if is_prep(node)
                && let Some(images) = scene_images(plan, &states[index], node, store, datasets)
            {
                estimator.scenes.insert(index, images);
            }
        }
        let host = host_name();
        // Without readable records, the models' estimates are not corrected.
        estimator.records = store.records().unwrap_or_default();
        estimator.records.retain(|record| record.host == host && record.model.is_some());
        estimator
    }

    /// Estimates all nodes that aren't cached.
    pub(crate) fn estimates(&self, states: &[State]) -> Estimates {
        let missing = states.iter().enumerate().filter(|(_, state)| !is_cached(state));
        let estimate = |(index, state): (usize, &State)| {
            let key_parts = match state {
                State::WillRun { key_parts } => Some(key_parts),
                _ => None,
            };
            Some((index, self.estimate(index, key_parts)?))
        };
        let nodes: BTreeMap<usize, Estimate> = missing.clone().filter_map(estimate).collect();
        let unknown = missing.count() - nodes.len();
        let scenes = self.scenes.values().map(SceneImages::summary).collect();
        Estimates { nodes, unknown, scenes }
    }

    /// Reads the scene that a node has made, if that is a node of `prep`. Before, its background
    /// was a guess.
    pub(crate) fn read_scene(&mut self, index: usize, artifact: &Path) {
        if is_prep(&self.plan.nodes[index])
            && let Some(images) = SceneImages::of_artifact(artifact)
        {
            self.scenes.insert(index, images);
        }
    }

    /// Estimates a node. `key_parts` are missing until its inputs are known.
    pub(crate) fn estimate(
        &self,
        index: usize,
        key_parts: Option<&Map<String, Value>>,
    ) -> Option<Estimate> {
        let node = &self.plan.nodes[index];
        let program = &node.program.description.name;
        let work = self.work(node)?;
        let model = model_cost(program, &node.parameters, &work)?;
        let earlier =
            self.nearest(node, key_parts, model).and_then(|record| corrections(record, model));
        let (time, memory) = earlier.unwrap_or_else(|| (slowness(), 1.0));
        let min_memory = min_memory(program, &node.parameters, &work)?;
        Some(Estimate {
            processor_seconds: time * model.processor_seconds,
            memory: (memory * model.peak_memory as f64) as u64,
            min_memory: (memory.min(1.0) * min_memory as f64) as u64,
            model,
        })
    }

    /// Returns the record of the nearest earlier run of a stage's program that has about the same
    /// size.
    fn nearest(
        &self,
        node: &Node,
        key_parts: Option<&Map<String, Value>>,
        model: ModelCost,
    ) -> Option<&Record> {
        let program = node.program.description.name.as_str();
        let known_parts = key_parts.cloned().unwrap_or_else(|| partial_key_parts(node));
        let similar = self.records.iter().filter(|record| is_similar(record, program, model));
        nearest_record(&known_parts, similar)
    }

    /// Returns what a node's cost depends on.
    fn work(&self, node: &Node) -> Option<Work> {
        let program = node.program.description.name.as_str();
        let has_input = |name: &str| node.inputs.iter().any(|input| input.name == name);
        match program {
            "demo-scene" => {
                let scene = SceneImages::of_demo(&node.parameters, &Value::Null)?;
                return Some(Work::of_demo(&scene, self.threads));
            }
            "camera-path" => return Some(Work::default()),
            _ => {}
        }
        let (index, images) = match program {
            "prep" => {
                let found = self.plan.nodes.iter().position(|other| std::ptr::eq(other, node))?;
                (found, self.scenes.get(&found)?.photographs)
            }
            _ => self.images(node)?,
        };
        let scene = self.scenes.get(&index)?;
        let training = match program {
            "train-ss" => Some(node),
            _ => parent(node, "field").map(|(index, _)| &self.plan.nodes[index]),
        };
        let lr_images = training.and_then(|training| self.images(training)).map(|(_, lr)| lr);
        let lr_width = lr_images.unwrap_or_default().largest_size.0;
        let references = has_input("references").then(|| scene.images("references")).flatten();
        let max_references = node.parameters["max_references"].as_u64().unwrap_or(u64::MAX);
        let references = references.map(|images| images.limited(max_references));
        let refiner = parent(node, "refiner").map(|(index, _)| &self.plan.nodes[index]);
        Some(Work {
            kind: scene.kind,
            pixels_across: scene.widths_across * lr_width as f64,
            has_box_kernel: scene.has_box_kernel,
            images,
            references: references.unwrap_or_default(),
            refiner: refiner.map(|refiner| refiner.parameters.clone()),
            preparation_bytes: scene.preparation_bytes,
            field: training.map(|training| training.parameters.clone()),
            is_fine_tuning: has_input("init"),
            computes_lpips: has_input("weights"),
            has_libtorch: node.program.description.libtorch,
            threads: self.threads,
        })
    }

    /// Returns the node of `prep` and the images that a stage reads or renders.
    fn images(&self, node: &Node) -> Option<(usize, Images)> {
        let input = match node.program.description.name.as_str() {
            "train-ss" => "scene",
            "render-depth" | "export" => "cameras",
            "eval" => "truth",
            "train-refine" | "refine" => "views",
            _ => return None,
        };
        let (index, subtree) = parent(node, input)?;
        let parent = &self.plan.nodes[index];
        let (index, mut images) = match self.scenes.get(&index) {
            Some(scene) => (index, scene.images(subtree?)?),
            None if parent.program.description.name == "camera-path" => self.frames(parent)?,
            // Views are as many and as large as the cameras that they were rendered from.
            None => return self.images(parent).filter(|_| input == "views"),
        };
        if node.program.description.name == "render-depth" {
            images = images.with_size(&node.parameters);
        }
        Some((index, images))
    }

    /// Returns the node of `prep` and the frames of a `camera-path`.
    fn frames(&self, path: &Node) -> Option<(usize, Images)> {
        let (index, _) = parent(path, "cameras")?;
        let recorded = path.inputs.iter().find(|input| input.name == "path");
        let frames = match recorded.map(|input| &input.from) {
            None => computed_frames(&path.parameters, self.scenes.get(&index)?),
            Some(Origin::Folder(folder)) => recorded_frames(&path.parameters, folder),
            Some(Origin::Node { .. }) => None,
        };
        Some((index, frames?))
    }
}

/// True for a run of a program that has about the same size, and the same kind of scene: the
/// models' errors for objects don't predict those for opaque scenes.
fn is_similar(record: &Record, program: &str, model: ModelCost) -> bool {
    let Some(other) = record.model else { return false };
    let factor = other.processor_seconds / model.processor_seconds;
    record.key_parts.get("stage").and_then(Value::as_str) == Some(program)
        && record.processor_seconds.is_some_and(|seconds| seconds >= MIN_RECORD_SECONDS)
        && (1.0 / MAX_TIME_FACTOR..MAX_TIME_FACTOR).contains(&factor)
        && other.scene == model.scene
}

/// Returns the parts of a node's key that are known while inputs are unknown: the program and the
/// parameters.
fn partial_key_parts(node: &Node) -> Map<String, Value> {
    let partial = node.partial_key();
    let parameters = partial.parameters.into_iter();
    let mut parts: Map<String, Value> =
        parameters.map(|(name, value)| (format!("parameter {name}"), value)).collect();
    parts.insert("stage".to_owned(), json!(partial.program));
    parts
}

/// Returns the factors by which the model's time and memory are corrected after an earlier run.
fn corrections(record: &Record, model: ModelCost) -> Option<(f64, f64)> {
    let other = record.model?;
    let time = record.processor_seconds? / other.processor_seconds;
    let (measured, expected) = (record.peak_memory? as f64, other.peak_memory as f64);
    let mut memory = measured / expected;
    if memory < 1.0 {
        // A smaller program, such as one without libtorch, saves no more in a larger training.
        memory = memory.max(1.0 - (expected - measured) / model.peak_memory as f64);
    }
    // The time's factor has no limit, because it contains the speed of the machine.
    Some((time, memory.clamp(1.0 / MAX_CORRECTION, MAX_CORRECTION)))
}

/// Returns the index of the node that produces an input, and the input's subtree.
fn parent<'n>(node: &'n Node, input: &str) -> Option<(usize, Option<&'n str>)> {
    let input = node.inputs.iter().find(|other| other.name == input)?;
    match &input.from {
        Origin::Node { index, subtree } => Some((*index, subtree.as_deref())),
        Origin::Folder(_) => None,
    }
}

fn is_cached(state: &State) -> bool {
    matches!(state, State::Cached(_))
}

fn is_prep(node: &Node) -> bool {
    node.program.description.name == "prep"
}

/// Returns the images that a node of `prep` has made or will make.
fn scene_images(
    plan: &Plan,
    state: &State,
    prep: &Node,
    store: &Store,
    datasets: &mut Datasets,
) -> Option<SceneImages> {
    if let State::Cached(record) = state {
        return SceneImages::of_artifact(&store.object(&record.output));
    }
    let dataset = prep.inputs.iter().find(|input| input.name == "dataset")?;
    match &dataset.from {
        Origin::Folder(folder) => SceneImages::of_dataset(datasets.get(folder)?, &prep.parameters),
        Origin::Node { index, .. } => {
            let demo = &plan.nodes[*index];
            SceneImages::of_demo(&demo.parameters, &prep.parameters)
        }
    }
}

#[cfg(test)]
mod tests {
    use store::SceneKind;

    use super::*;

    #[test]
    fn an_earlier_run_corrects_the_model() {
        let model = ModelCost { processor_seconds: 10.0, peak_memory: 1000, scene: None };
        let record = |seconds, memory| Record {
            processor_seconds: Some(seconds),
            peak_memory: Some(memory),
            model: Some(model),
            ..Record::default()
        };
        assert_eq!(corrections(&record(15.0, 500), model), Some((1.5, 0.5)));
        assert_eq!(corrections(&record(100.0, 9000), model), Some((10.0, MAX_CORRECTION)));
        assert_eq!(corrections(&Record { model: None, ..record(15.0, 500) }, model), None);
        let with_memory = |peak_memory| ModelCost { peak_memory, ..model };
        assert_eq!(corrections(&record(15.0, 500), with_memory(2000)), Some((1.5, 0.75)));
        assert_eq!(corrections(&record(15.0, 500), with_memory(600)), Some((1.5, 0.5)));
    }

    #[test]
    fn runs_of_equal_programs_scenes_and_sizes_are_similar() {
        let cost = |processor_seconds, scene| ModelCost {
            processor_seconds,
            scene: Some(scene),
            ..ModelCost::default()
        };
        let record = Record {
            key_parts: [("stage".to_owned(), json!("render-depth"))].into_iter().collect(),
            processor_seconds: Some(10.0),
            model: Some(cost(20.0, SceneKind::Frustum)),
            ..Record::default()
        };
        let is_similar = |program, model| is_similar(&record, program, model);
        assert!(is_similar("render-depth", cost(30.0, SceneKind::Frustum)));
        assert!(
            !is_similar("render-depth", cost(30.0, SceneKind::Unbounded)),
            "another kind of scene"
        );
        assert!(!is_similar("render-depth", cost(300.0, SceneKind::Frustum)), "another size");
        assert!(!is_similar("train-ss", cost(30.0, SceneKind::Frustum)), "another program");
    }
}

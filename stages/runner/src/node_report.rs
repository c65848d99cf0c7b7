//! What is known of a plan's nodes, for programs: the JSON of `plan`, `why` and `status`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use artifact::{RunInput, hash_json};
use planning::{Change, Plan, State};
use serde::Serialize;
use serde_json::{Map, Value};
use slurm::Job;
use store::{Record, StoreError};

use crate::session::Session;

/// A plan's nodes, each after those that it needs, and its sinks.
#[derive(Debug, Serialize)]
pub(crate) struct PlanReport {
    pub(crate) nodes: Vec<NodeReport>,
    pub(crate) sinks: Vec<SinkReport>,
}

/// A sink.
#[derive(Debug, Serialize)]
pub(crate) struct SinkReport {
    pub(crate) stage: String,
    /// The nodes that it shows, by number.
    pub(crate) shows: Vec<usize>,
}

/// A node: a stage at one point of a sweep.
#[derive(Debug, Serialize)]
pub(crate) struct NodeReport {
    /// By which other nodes name it.
    pub(crate) number: usize,
    pub(crate) stage: String,
    pub(crate) point: String,
    /// `cached`, `will run` or `waits`.
    pub(crate) state: &'static str,
    /// All parameters, by name.
    pub(crate) parameters: Map<String, Value>,
    /// Parameters that the scene decides: the values in use, null until they are known.
    #[serde(skip_serializing_if = "Map::is_empty")]
    pub(crate) by_scene: Map<String, Value>,
    /// Inputs by name: the number of another node, or a folder.
    pub(crate) inputs: BTreeMap<String, RunInput>,
    /// The action's key, once its inputs are known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) key: Option<String>,
    /// The finished artifact.
    #[serde(flatten)]
    pub(crate) artifact: Option<ArtifactReport>,
    /// Nodes, by number, that must run before its key is known.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) waits_on: Vec<usize>,
    /// Whether an earlier run left a checkpoint.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(crate) has_checkpoint: bool,
    /// The cluster's job that is to make it, where one is queued or running. `status` alone asks.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) job: Option<Job>,
    /// What differs from the nearest earlier run of the stage; absent where it never ran, or wasn't
    /// asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) changes: Option<Vec<Change>>,
}

/// A finished artifact.
#[derive(Debug, Serialize)]
pub(crate) struct ArtifactReport {
    pub(crate) output: String,
    pub(crate) folder: PathBuf,
    pub(crate) bytes: u64,
    pub(crate) started_unix: u64,
    pub(crate) seconds: f64,
    pub(crate) threads: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) peak_memory: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) processor_seconds: Option<f64>,
}

impl PlanReport {
    /// With records, what differs from earlier runs, too.
    pub(crate) fn new(
        session: &Session,
        plan: &Plan,
        states: &[State],
        records: &[Record],
    ) -> Result<Self, StoreError> {
        let mut nodes = Vec::with_capacity(plan.nodes.len());
        for number in 0..plan.nodes.len() {
            nodes.push(NodeReport::new(session, plan, (number, &states[number]), records)?);
        }
        let sinks = plan
            .sinks
            .iter()
            .map(|sink| SinkReport { stage: sink.stage.clone(), shows: sink.shows.clone() });
        Ok(Self { nodes, sinks: sinks.collect() })
    }

    /// The nodes of a stage alone, or of the stages that a sink shows.
    pub(crate) fn only(mut self, stage: &str) -> Self {
        self.sinks.retain(|sink| sink.stage == stage);
        let shown: Vec<usize> = self.sinks.iter().flat_map(|sink| sink.shows.clone()).collect();
        self.nodes.retain(|node| shown.contains(&node.number) || node.stage == stage);
        self
    }
}

impl NodeReport {
    fn new(
        session: &Session,
        plan: &Plan,
        (number, state): (usize, &State),
        records: &[Record],
    ) -> Result<Self, StoreError> {
        let (store, node) = (&session.store, &plan.nodes[number]);
        let mut report = Self {
            number,
            stage: node.stage.clone(),
            point: node.point.clone(),
            state: state.name(),
            parameters: node.parameters.as_object().cloned().unwrap_or_default(),
            by_scene: Map::new(),
            inputs: node.run_inputs(Some),
            key: None,
            artifact: None,
            waits_on: Vec::new(),
            has_checkpoint: false,
            job: None,
            changes: None,
        };
        let mut folder = PathBuf::new();
        match state {
            State::Cached(record) => {
                folder = store.object(&record.output);
                report.key = Some(record.key());
                report.artifact = Some(ArtifactReport {
                    output: record.output.clone(),
                    folder: folder.clone(),
                    bytes: store.manifest(&record.output).map_or(0, |manifest| manifest.size()),
                    started_unix: record.started_unix,
                    seconds: record.seconds,
                    threads: record.threads,
                    peak_memory: record.peak_memory,
                    processor_seconds: record.processor_seconds,
                });
            }
            State::WillRun { key_parts } => {
                let key = hash_json(key_parts);
                report.has_checkpoint = store.has_checkpoint(&key)?;
                report.changes = planning::nearest_changes(key_parts, &node.stage, records);
                report.key = Some(key);
            }
            State::Waits { on } => report.waits_on.clone_from(on),
        }
        report.by_scene = node.by_scene(&folder);
        Ok(report)
    }
}

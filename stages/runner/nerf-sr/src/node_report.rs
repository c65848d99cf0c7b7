//! JSON of `plan`, `why` and `status`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use artifact::{RunInput, hash_json};
use planning::{Change, State};
use serde::Serialize;
use serde_json::{Map, Value};
use slurm::Job;
use store::{Record, StoreError};

use crate::planned::Planned;

/// A plan's nodes, each after its parents, and its sinks.
#[derive(Debug, Serialize)]
pub(crate) struct PlanReport {
    pub(crate) nodes: Vec<NodeReport>,
    pub(crate) sinks: Vec<SinkReport>,
}

/// A sink.
#[derive(Debug, Serialize)]
pub(crate) struct SinkReport {
    pub(crate) stage: String,
    /// Numbers of the nodes that the sink shows.
    pub(crate) shows: Vec<usize>,
}

/// A node: a stage at one point of a sweep.
#[derive(Debug, Default, Serialize)]
pub(crate) struct NodeReport {
    /// Number by which other nodes refer to this one.
    pub(crate) number: usize,
    pub(crate) stage: String,
    pub(crate) point: String,
    /// `cached`, `will run` or `waits`.
    pub(crate) state: &'static str,
    /// All parameters by name.
    pub(crate) parameters: Map<String, Value>,
    /// Parameters that the scene decides, with the values in use; null until they are known.
    #[serde(skip_serializing_if = "Map::is_empty")]
    pub(crate) by_scene: Map<String, Value>,
    /// Inputs by name: another node's number, or a folder.
    pub(crate) inputs: BTreeMap<String, RunInput>,
    /// Key of the action; absent until its inputs are known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) key: Option<String>,
    /// Artifact of a cached node.
    #[serde(flatten)]
    pub(crate) artifact: Option<ArtifactReport>,
    /// Numbers of the nodes that must run before the key is known.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) waits_on: Vec<usize>,
    /// True if an interrupted run left a checkpoint.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(crate) has_checkpoint: bool,
    /// Queued or running job of a cluster; only `status` reports it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) job: Option<Job>,
    /// Differences from the stage's earlier run with the nearest key; absent if there is none, or
    /// if no records were given.
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
    /// Creates the report. With records, the nodes' `changes` are filled in.
    pub(crate) fn new(planned: &Planned<'_>, records: &[Record]) -> Result<Self, StoreError> {
        let nodes = 0..planned.states.len();
        let nodes = nodes.map(|number| NodeReport::new(planned, number, records));
        let sinks = planned.plan.sinks.iter().map(|sink| SinkReport {
            stage: sink.stage.clone(),
            shows: sink.nodes().into_iter().collect(),
        });
        Ok(Self { nodes: nodes.collect::<Result<_, _>>()?, sinks: sinks.collect() })
    }

    /// Keeps the nodes of a stage, or those that a sink shows.
    pub(crate) fn for_stage(mut self, stage: &str) -> Self {
        self.sinks.retain(|sink| sink.stage == stage);
        let shown: Vec<usize> = self.sinks.iter().flat_map(|sink| sink.shows.clone()).collect();
        self.nodes.retain(|node| shown.contains(&node.number) || node.stage == stage);
        self
    }
}

impl NodeReport {
    fn new(planned: &Planned<'_>, number: usize, records: &[Record]) -> Result<Self, StoreError> {
        let (node, state) = (&planned.plan.nodes[number], &planned.states[number]);
        let mut report = Self {
            number,
            stage: node.stage.clone(),
            point: node.point.clone(),
            state: state.name(),
            parameters: node.parameters.as_object().cloned().unwrap_or_default(),
            by_scene: planned.scene_defaults(number),
            inputs: node.run_inputs(Some),
            key: state.key(),
            ..Self::default()
        };
        match state {
            State::Cached(record) => {
                let manifest = planned.store.manifest(&record.output);
                report.artifact = Some(ArtifactReport {
                    output: record.output.clone(),
                    folder: planned.store.object(&record.output),
                    bytes: manifest.map_or(0, |manifest| manifest.size()),
                    started_unix: record.started_unix,
                    seconds: record.seconds,
                    threads: record.threads,
                    peak_memory: record.peak_memory,
                    processor_seconds: record.processor_seconds,
                });
            }
            State::WillRun { key_parts } => {
                report.has_checkpoint = planned.store.has_checkpoint(&hash_json(key_parts))?;
                report.changes = planning::nearest_changes(key_parts, &node.stage, records);
            }
            State::Waits { on } => report.waits_on.clone_from(on),
        }
        Ok(report)
    }
}

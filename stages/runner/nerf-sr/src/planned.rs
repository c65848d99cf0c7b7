//! A plan with the states of its nodes, and these as text and as JSON.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use artifact::{RunInput, format_duration, hash_json, unix_time};
use planning::{Change, Plan, Sink, State, short_hash};
use serde::Serialize;
use serde_json::{Map, Value};
use slurm::Job;
use store::{Record, Store, StoreError};

use crate::estimates::{Datasets, Estimates, Estimator};

/// A plan with the states of its nodes.
pub(crate) struct Planned<'a> {
    pub(crate) store: &'a Store,
    pub(crate) plan: Plan,
    pub(crate) states: Vec<State>,
}

impl Planned<'_> {
    /// Estimates the nodes that aren't cached.
    pub(crate) fn estimates(&self, datasets: &mut Datasets) -> Estimates {
        let estimator = Estimator::new(&self.plan, &self.states, self.store, datasets);
        estimator.estimates(&self.states)
    }

    /// Finds the nodes that will run and on which a waiting node depends, directly or not.
    pub(crate) fn blocking_nodes(&self, index: usize) -> BTreeSet<usize> {
        let mut found = BTreeSet::new();
        let mut open = vec![index];
        while let Some(index) = open.pop() {
            let State::Waits { on } = &self.states[index] else { continue };
            open.extend(on);
            found.extend(
                on.iter().filter(|parent| matches!(self.states[**parent], State::WillRun { .. })),
            );
        }
        found
    }

    /// Describes a node's state. With records, explains why the node will run.
    pub(crate) fn state_text(&self, index: usize, records: Option<&[Record]>) -> String {
        match (&self.states[index], records) {
            (State::Cached(record), _) => {
                let age = age_text(record.started_unix);
                format!("cached ({age}, took {})", format_duration(record.seconds))
            }
            (State::Waits { on }, _) => {
                let names: Vec<String> =
                    on.iter().map(|&parent| self.plan.nodes[parent].label()).collect();
                format!("waits for {}; stays cached if results don't change", names.join(", "))
            }
            (State::WillRun { .. }, None) => "will run".to_owned(),
            (State::WillRun { key_parts }, Some(records)) => {
                match planning::explain(key_parts, &self.plan.nodes[index].stage, records) {
                    None => "will run: no earlier run of this stage".to_owned(),
                    Some(changes) if changes.is_empty() => self.missing_text(key_parts),
                    Some(changes) => format!("will run: {}", changes.join("; ")),
                }
            }
        }
    }

    /// Describes the state of a node that will run, although a record has its key.
    fn missing_text(&self, key_parts: &Map<String, Value>) -> String {
        match self.store.record(&hash_json(key_parts)) {
            Ok(Some(record)) => {
                let output = short_hash(&record.output);
                format!("will run: its artifact {output} is missing or incomplete")
            }
            _ => "will run".to_owned(),
        }
    }

    /// Returns the parameters that the scene decides, with their values if the node is cached.
    pub(crate) fn scene_defaults(&self, index: usize) -> Map<String, Value> {
        let artifact = match &self.states[index] {
            State::Cached(record) => self.store.object(&record.output),
            _ => PathBuf::new(),
        };
        self.plan.nodes[index].scene_defaults(&artifact)
    }

    /// Lists [`Self::scene_defaults`].
    pub(crate) fn by_scene_text(&self, index: usize) -> Option<String> {
        let mut entries = Vec::new();
        for (name, value) in self.scene_defaults(index) {
            entries.push(match value {
                Value::Null => name,
                Value::String(text) => format!("{name}={text}"),
                value => format!("{name}={value}"),
            });
        }
        (!entries.is_empty()).then(|| format!("by scene: {}", entries.join(", ")))
    }

    /// Describes a sink's nodes and when a run writes the sink's page. The text doesn't depend on
    /// an existing page, because only `run` knows the folder of pages.
    pub(crate) fn sink_text(&self, sink: &Sink) -> String {
        let nodes = sink.nodes();
        let mut names: Vec<&str> =
            nodes.iter().map(|&index| self.plan.nodes[index].stage.as_str()).collect();
        names.dedup();
        let is_cached = nodes.iter().all(|&index| matches!(self.states[index], State::Cached(_)));
        let when = if is_cached {
            "all cached: a run writes the page only if it doesn't exist"
        } else {
            "a run writes the page again if results change"
        };
        format!("shows {}; {when}", names.join(", "))
    }
}

/// Returns the time that has passed since a time: `5 s ago`.
pub(crate) fn age_text(unix: u64) -> String {
    match unix_time().saturating_sub(unix) {
        s if s < 120 => format!("{s} s ago"),
        s if s < 7200 => format!("{} min ago", s / 60),
        s if s < 172_800 => format!("{} h ago", s / 3600),
        s => format!("{} days ago", s / 86_400),
    }
}

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

//! What a sink is told of a run.

use std::collections::BTreeSet;
use std::path::Path;

use artifact::{FailedPoint, RunNode, RunRecord, UnfinishedNode};
use planning::{Node, Origin, Plan, Sink};
use serde_json::Map;
use stage_call::StageFailure;
use store::{Record, Store};

/// How a run went.
pub(crate) struct Course<'a> {
    /// Each node's record, where it is done.
    pub(crate) records: &'a [Option<Record>],
    /// Nodes that ran; none where that isn't known.
    pub(crate) ran: Option<&'a BTreeSet<usize>>,
    /// Nodes that failed, and how.
    pub(crate) failures: &'a [(usize, StageFailure)],
    /// The command line.
    pub(crate) command: &'a [String],
}

impl<'a> Course<'a> {
    /// All that is known before anything runs.
    pub(crate) fn before(records: &'a [Option<Record>]) -> Self {
        Self { records, ran: None, failures: &[], command: &[] }
    }
}

/// The record of the nodes that a sink shows and all they were made of; none where some of that
/// isn't there, unless the sink shows what there is. Nothing of an artifact is read for it, so the
/// values that scenes decide are missing, and so is what differs between two runs that come to the
/// same ([`with_details`]).
pub(crate) fn record(
    plan: &Plan,
    sink: &Sink,
    course: &Course<'_>,
    store: &Store,
    out: &Path,
) -> Option<RunRecord> {
    let mut is_whole: Vec<bool> = Vec::with_capacity(plan.nodes.len());
    for (node, record) in plan.nodes.iter().zip(course.records) {
        is_whole.push(record.is_some() && node.parents().all(|parent| is_whole[parent]));
    }
    let (shown, missing): (Vec<usize>, Vec<usize>) =
        sink.shows.iter().partition(|&&index| is_whole[index]);
    if !missing.is_empty() && !sink.program.description.partial {
        return None;
    }
    let (done, undone): (Vec<usize>, Vec<usize>) =
        needed(plan, sink).into_iter().partition(|&index| is_whole[index]);
    let nodes = done.iter().filter_map(|&index| {
        let record = course.records[index].as_ref()?;
        Some(run_node(&plan.nodes[index], record, &done, shown.contains(&index), store))
    });
    let nodes = nodes.collect();
    let unfinished =
        undone.iter().map(|&index| unfinished_node(plan, index, &done, &undone, course)).collect();
    let failed = missing.into_iter().map(|index| &plan.nodes[index]);
    let failed = failed.map(|node| FailedPoint {
        stage: node.stage.clone(),
        point: node.point.clone(),
        values: node.values.clone(),
        reason: None,
    });
    // Other sinks don't know of results that aren't there.
    let left_out = sink.left_out.iter().filter(|_| sink.program.description.partial).cloned();
    let failed = failed.chain(left_out).collect();
    // A name that isn't UTF-8 has no place in JSON; without it a table has no commit.
    let home =
        std::path::absolute(out).ok().filter(|home| home.to_str().is_some()).unwrap_or_default();
    let data_sets = data_sets(plan, sink);
    Some(RunRecord { home, command: Vec::new(), data_sets, nodes, failed, unfinished })
}

/// The nodes that a sink shows, and all they are made of, in the plan's order.
fn needed(plan: &Plan, sink: &Sink) -> BTreeSet<usize> {
    let mut needed: BTreeSet<usize> = sink.shows.iter().copied().collect();
    for index in (0..plan.nodes.len()).rev() {
        if needed.contains(&index) {
            needed.extend(plan.nodes[index].parents());
        }
    }
    needed
}

fn run_node(
    node: &Node,
    record: &Record,
    done: &[usize],
    is_shown: bool,
    store: &Store,
) -> RunNode {
    RunNode {
        stage: node.stage.clone(),
        point: node.point.clone(),
        values: node.values.clone(),
        is_shown,
        program: node.program.description.name.clone(),
        is_cached: None,
        kind: node.program.description.output.kind.clone(),
        key: record.key(),
        output: record.output.clone(),
        resolved: Map::new(),
        folder: store.object(&record.output),
        parameters: node.parameters.as_object().cloned().unwrap_or_default(),
        inputs: node.run_inputs(|parent| done.iter().position(|&index| index == parent)),
        started_unix: record.started_unix,
        seconds: record.seconds,
        threads: record.threads,
        peak_memory: record.peak_memory,
        processor_seconds: record.processor_seconds,
        host: record.host.clone(),
    }
}

fn unfinished_node(
    plan: &Plan,
    index: usize,
    done: &[usize],
    undone: &[usize],
    course: &Course<'_>,
) -> UnfinishedNode {
    let node = &plan.nodes[index];
    let place = |parent: usize| done.iter().chain(undone).position(|&other| other == parent);
    let failure = course.failures.iter().find(|(failed, _)| *failed == index);
    UnfinishedNode {
        stage: node.stage.clone(),
        point: node.point.clone(),
        kind: node.program.description.output.kind.clone(),
        parameters: node.parameters.as_object().cloned().unwrap_or_default(),
        needs: node.parents().filter_map(place).collect(),
        message: failure.map(|(_, failure)| failure.message.clone()),
    }
}

/// The data sets that what a sink shows is made of: folders, and blocks that make data sets.
pub(crate) fn data_sets(plan: &Plan, sink: &Sink) -> Vec<String> {
    let mut found = BTreeSet::new();
    for node in needed(plan, sink).into_iter().map(|index| &plan.nodes[index]) {
        let kind = node.program.description.output.kind.as_str();
        let folders: Vec<String> = node
            .inputs
            .iter()
            .filter_map(|input| match &input.from {
                Origin::Folder(folder) => Some(folder.display().to_string()),
                Origin::Node { .. } => None,
            })
            .collect();
        match kind {
            "dataset" if folders.is_empty() => _ = found.insert(node.stage.clone()),
            "dataset" | "scene" => found.extend(folders),
            _ => {}
        }
    }
    found.into_iter().collect()
}

/// Adds the values that scenes decide, from the artifacts, and how this run went.
pub(crate) fn with_details(mut record: RunRecord, plan: &Plan, course: &Course<'_>) -> RunRecord {
    for node in &mut record.nodes {
        let is_planned =
            |planned: &Node| planned.stage == node.stage && planned.point == node.point;
        let Some(index) = plan.nodes.iter().position(is_planned) else { continue };
        node.resolved = plan.nodes[index].by_scene(&node.folder);
        node.is_cached = course.ran.map(|ran| !ran.contains(&index));
    }
    record.command = course.command.to_vec();
    record
}

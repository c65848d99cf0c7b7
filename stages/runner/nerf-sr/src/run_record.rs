//! Record of a run, as a sink gets it.

use std::collections::BTreeSet;

use artifact::{FailedPoint, RunNode, RunRecord, UnfinishedNode};
use planning::stage_call::StageFailure;
use planning::{Node, Origin, Plan, ShownPoint, Sink};
use serde_json::Map;
use store::{Record, Store};

use crate::session::Run;

/// Progress of a run. The default lacks the entries of `records`.
#[derive(Default)]
pub(crate) struct RunProgress {
    /// Records by node index, with an entry for each node of the plan; `None` if the node isn't
    /// done.
    pub(crate) records: Vec<Option<Record>>,
    /// Nodes that ran; `None` if unknown.
    pub(crate) ran: Option<BTreeSet<usize>>,
    /// Nodes that failed.
    pub(crate) failures: Vec<(usize, StageFailure)>,
    /// Command line of the run.
    pub(crate) command: Vec<String>,
}

/// Returns the record of the nodes that a sink shows and of their ancestors, and the indices of the
/// recorded nodes in the plan. `None` if one of them isn't done, unless the sink can show a part of
/// a run. No artifact is read: values that the scene decides are missing, and so is everything that
/// differs between two runs with equal results; [`add_details`] adds both.
pub(crate) fn run_record(
    run: &Run<'_>,
    sink: &Sink,
    progress: &RunProgress,
) -> Option<(RunRecord, Vec<usize>)> {
    let plan = run.plan;
    let mut is_complete: Vec<bool> = Vec::with_capacity(plan.nodes.len());
    for (index, node) in plan.nodes.iter().enumerate() {
        let is_done = progress.records[index].is_some();
        is_complete.push(is_done && node.parents().all(|parent| is_complete[parent]));
    }
    let (shown, missing): (Vec<&ShownPoint>, Vec<&ShownPoint>) =
        sink.points.iter().partition(|shown| is_complete[shown.node]);
    let can_be_partial = sink.program.description.partial;
    if !missing.is_empty() && !can_be_partial {
        return None;
    }
    let (done, undone): (Vec<usize>, Vec<usize>) =
        with_ancestors(plan, sink.nodes()).into_iter().partition(|&index| is_complete[index]);
    let recorded = recorded_nodes(&done, &shown);
    let done: Vec<usize> = recorded.iter().map(|(index, _)| *index).collect();
    let mut nodes = Vec::with_capacity(done.len());
    for (index, shown) in recorded {
        let record = progress.records[index].as_ref()?;
        nodes.push(run_node(&plan.nodes[index], record, &done, shown, run.store));
    }
    let numbers = [&done[..], &undone].concat();
    let unfinished = undone
        .iter()
        .map(|&index| unfinished_node(&plan.nodes[index], index, &numbers, progress))
        .collect();
    let mut failed = Vec::with_capacity(missing.len());
    for ShownPoint { node, point, values } in missing {
        failed.push(FailedPoint {
            stage: plan.nodes[*node].stage.clone(),
            point: point.clone(),
            values: values.clone(),
            reason: None,
        });
    }
    // Sinks that show only complete runs don't know of missing results.
    if can_be_partial {
        failed.extend_from_slice(&sink.left_out);
    }
    // JSON can't contain a path that isn't UTF-8. Without the path, pages and tables don't name the
    // folder's git commit.
    let pages_folder = std::path::absolute(run.out)
        .ok()
        .filter(|folder| folder.to_str().is_some())
        .unwrap_or_default();
    let data_sets = data_sets(plan, sink.nodes());
    let command = Vec::new();
    Some((RunRecord { pages_folder, command, data_sets, nodes, failed, unfinished }, done))
}

/// Returns nodes and their ancestors, in the plan's order.
fn with_ancestors(plan: &Plan, nodes: BTreeSet<usize>) -> BTreeSet<usize> {
    let mut found = nodes;
    for index in (0..plan.nodes.len()).rev() {
        if found.contains(&index) {
            found.extend(plan.nodes[index].parents());
        }
    }
    found
}

/// Returns the nodes of a record, parents before children: `done` in the plan's order, with a shown
/// node once for each of its points.
fn recorded_nodes<'a>(
    done: &[usize],
    shown: &[&'a ShownPoint],
) -> Vec<(usize, Option<&'a ShownPoint>)> {
    let are_shown: BTreeSet<usize> = shown.iter().map(|shown| shown.node).collect();
    let mut ancestors = done.iter().copied().filter(|index| !are_shown.contains(index)).peekable();
    let mut recorded = Vec::with_capacity(done.len());
    for &shown in shown {
        while let Some(ancestor) = ancestors.next_if(|&index| index < shown.node) {
            recorded.push((ancestor, None));
        }
        recorded.push((shown.node, Some(shown)));
    }
    recorded.extend(ancestors.map(|index| (index, None)));
    recorded
}

fn run_node(
    node: &Node,
    record: &Record,
    done: &[usize],
    shown: Option<&ShownPoint>,
    store: &Store,
) -> RunNode {
    let (point, values) =
        shown.map_or((&node.point, &node.values), |shown| (&shown.point, &shown.values));
    RunNode {
        stage: node.stage.clone(),
        point: point.clone(),
        values: values.clone(),
        is_shown: shown.is_some(),
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

/// Returns the record of an unfinished node. `numbers` are the indices of all nodes in a record:
/// done ones first.
fn unfinished_node(
    node: &Node,
    index: usize,
    numbers: &[usize],
    progress: &RunProgress,
) -> UnfinishedNode {
    let failure = progress.failures.iter().find(|(failed, _)| *failed == index);
    UnfinishedNode {
        stage: node.stage.clone(),
        point: node.point.clone(),
        kind: node.program.description.output.kind.clone(),
        parameters: node.parameters.as_object().cloned().unwrap_or_default(),
        needs: node
            .parents()
            .filter_map(|parent| numbers.iter().position(|&other| other == parent))
            .collect(),
        message: failure.map(|(_, failure)| failure.message.clone()),
    }
}

/// Returns the data sets from which nodes are computed: folders, and blocks that create data sets.
fn data_sets(plan: &Plan, nodes: BTreeSet<usize>) -> Vec<String> {
    let mut found = BTreeSet::new();
    for node in with_ancestors(plan, nodes).into_iter().map(|index| &plan.nodes[index]) {
        let folders = node.inputs.iter().filter_map(|input| match &input.from {
            Origin::Folder(folder) => Some(folder.display().to_string()),
            Origin::Node { .. } => None,
        });
        let folders: Vec<String> = folders.collect();
        match node.program.description.output.kind.as_str() {
            "dataset" if folders.is_empty() => _ = found.insert(node.stage.clone()),
            "dataset" | "scene" => found.extend(folders),
            _ => {}
        }
    }
    found.into_iter().collect()
}

/// Returns the shown results, each as its data sets, stage and point. `nodes` are the
/// indices of the recorded nodes in the plan.
pub(crate) fn shown_results(record: &RunRecord, plan: &Plan, nodes: &[usize]) -> BTreeSet<String> {
    let shown = record.nodes.iter().zip(nodes).filter(|(node, _)| node.is_shown);
    let results = shown.map(|(node, index)| {
        let data_sets = data_sets(plan, BTreeSet::from([*index])).join(", ");
        format!("{data_sets}: {}", artifact::label(&node.stage, &node.point))
    });
    results.collect()
}

/// Adds the values that the scene decides, read from the artifacts, and this run's own data.
/// `indices` are those of the recorded nodes.
pub(crate) fn add_details(
    record: &mut RunRecord,
    plan: &Plan,
    indices: &[usize],
    progress: &RunProgress,
) {
    for (node, index) in record.nodes.iter_mut().zip(indices) {
        node.resolved = plan.nodes[*index].scene_defaults(&node.folder);
        node.is_cached = progress.ran.as_ref().map(|ran| !ran.contains(index));
    }
    record.command = progress.command.clone();
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    /// A node is recorded once for each of its shown points, in their order, after its ancestors.
    #[test]
    fn shown_nodes_are_recorded_by_point() {
        let shown = [1, 2, 1, 4, 2].map(|node| ShownPoint {
            node,
            point: String::new(),
            values: BTreeMap::new(),
        });
        let recorded = recorded_nodes(&[0, 1, 2, 3, 4, 5], &shown.each_ref());
        let nodes: Vec<(usize, bool)> =
            recorded.into_iter().map(|(node, shown)| (node, shown.is_some())).collect();
        let expected = [
            (0, false),
            (1, true),
            (2, true),
            (1, true),
            (3, false),
            (4, true),
            (2, true),
            (5, false),
        ];
        assert_eq!(nodes, expected);
    }
}

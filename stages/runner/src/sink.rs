//! Sinks show a run: they get its record and write a folder beside pipeline.yaml. They are never
//! cached, but a sink that has shown this very record already isn't called again.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use artifact::{
    FailedPoint, MANIFEST_FILE, Manifest, Record, RunFile, RunNode, RunRecord, Store, hash_json,
    write_json,
};
use planning::{Plan, Sink};
use serde_json::{Map, json};
use stage_call::{Call, Display, StageFailure};

use crate::publish;

/// The record of the nodes that a sink shows and all they were made of; none where some of that
/// isn't there, unless the sink shows what there is. Nothing of an artifact is read for it, so the
/// values that scenes decide are missing ([`resolve`]).
fn record(
    plan: &Plan,
    sink: &Sink,
    records: &[Option<Record>],
    store: &Store,
    out: &Path,
) -> Option<RunRecord> {
    let mut is_whole: Vec<bool> = Vec::with_capacity(plan.nodes.len());
    for (node, record) in plan.nodes.iter().zip(records) {
        is_whole.push(record.is_some() && node.parents().all(|parent| is_whole[parent]));
    }
    let (shown, missing): (Vec<usize>, Vec<usize>) =
        sink.shows.iter().partition(|&&index| is_whole[index]);
    if !missing.is_empty() && !sink.program.description.partial {
        return None;
    }
    let mut wanted: BTreeSet<usize> = shown.iter().copied().collect();
    for index in (0..plan.nodes.len()).rev() {
        if wanted.contains(&index) {
            wanted.extend(plan.nodes[index].parents());
        }
    }
    let position = |index: usize| wanted.iter().position(|&i| i == index);
    let nodes = wanted.iter().filter_map(|&index| {
        let (node, record) = (&plan.nodes[index], records[index].as_ref()?);
        let folder = store.object(&record.output);
        Some(RunNode {
            stage: node.stage.clone(),
            point: node.point.clone(),
            values: node.values.clone(),
            is_shown: shown.contains(&index),
            kind: node.program.description.output.kind.clone(),
            key: record.key(),
            output: record.output.clone(),
            resolved: Map::new(),
            folder,
            parameters: node.parameters.as_object().cloned().unwrap_or_default(),
            inputs: node.run_inputs(position),
            started_unix: record.started_unix,
            seconds: record.seconds,
            threads: record.threads,
            peak_memory: record.peak_memory,
            processor_seconds: record.processor_seconds,
            host: record.host.clone(),
        })
    });
    let nodes = nodes.collect();
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
    Some(RunRecord { home, nodes, failed })
}

/// Adds the values that scenes decide, from the artifacts.
fn resolve(record: RunRecord, plan: &Plan) -> RunRecord {
    let of_node = |node: RunNode| {
        let planned = plan
            .nodes
            .iter()
            .find(|planned| planned.stage == node.stage && planned.point == node.point);
        RunNode {
            resolved: planned.map(|planned| planned.by_scene(&node.folder)).unwrap_or_default(),
            ..node
        }
    };
    RunRecord { nodes: record.nodes.into_iter().map(of_node).collect(), ..record }
}

/// By what a page is known to show a record: what scenes decide follows from the rest.
fn identity(sink: &Sink, record: &RunRecord) -> String {
    hash_json(&json!({"record": record, "code": sink.program.description.code,
            "parameters": sink.parameters}))
}

/// Whether a sink's page shows these records already.
pub(crate) fn is_shown(
    plan: &Plan,
    sink: &Sink,
    records: &[Option<Record>],
    store: &Store,
    out: &Path,
) -> bool {
    let record = record(plan, sink, records, store, out);
    record.is_some_and(|record| publish::shows(&out.join(&sink.stage), &identity(sink, &record)))
}

/// What became of a sink.
pub(crate) enum Shown {
    /// It ran and wrote this folder.
    Written(PathBuf),
    /// The folder shows this record already.
    UpToDate(PathBuf),
    /// Something it shows isn't there.
    Missing,
}

/// What all sinks of a run have in common.
pub(crate) struct Showing<'a> {
    pub(crate) plan: &'a Plan,
    pub(crate) store: &'a Store,
    pub(crate) run: &'a RunFile,
    /// Where pages go.
    pub(crate) out: &'a Path,
    pub(crate) threads: usize,
    pub(crate) stop: &'a AtomicBool,
}

/// Calls a sink; it writes `out/STAGE`.
pub(crate) fn show(
    showing: &Showing<'_>,
    sink: &Sink,
    records: &[Option<Record>],
) -> Result<Shown, StageFailure> {
    let Showing { plan, store, run, out, threads, stop } = *showing;
    let fail = |path: &Path, e: &dyn std::fmt::Display| StageFailure {
        code: 1,
        message: format!("{}: {e}", path.display()),
    };
    let Some(record) = record(plan, sink, records, store, out) else { return Ok(Shown::Missing) };
    let target = out.join(&sink.stage);
    let identity = identity(sink, &record);
    if publish::shows(&target, &identity) {
        return Ok(Shown::UpToDate(target));
    }
    let record = resolve(record, plan);
    let scratch = store.scratch(run.id()).join(&sink.stage);
    let (folder, params, output) =
        (scratch.join("run"), scratch.join("params.json"), scratch.join("output"));
    std::fs::create_dir_all(&folder)
        .and_then(|()| write_json(&folder.join("run.json"), &record))
        .and_then(|()| write_json(&params, &sink.parameters))
        .map_err(|e| fail(&scratch, &e))?;
    let display = Display::new();
    let view = display.start(&sink.stage);
    let inputs = [("run".to_owned(), folder)];
    let call = Call {
        label: &sink.stage,
        program: &sink.program.path,
        description: &sink.program.description,
        params: &params,
        inputs: &inputs,
        hashes: &[],
        output: &output,
        work: None,
        device: plan.device(&sink.stage),
        threads,
        lock: None,
    };
    let result = call.run(&scratch.join("log"), &view, stop);
    view.end();
    result?;
    let kind = &sink.program.description.output.kind;
    let manifest = output.join(MANIFEST_FILE);
    if !manifest.exists() {
        let found = Manifest::of_folder(kind, &output).map_err(|e| fail(&output, &e))?;
        write_json(&manifest, &found).map_err(|e| fail(&manifest, &e))?;
    }
    std::fs::write(output.join(publish::MARK), identity).map_err(|e| fail(&output, &e))?;
    let target = publish::publish(&output, out, &sink.stage, kind, stop)?;
    // A sink's leftovers have no value.
    std::fs::remove_dir_all(&scratch).ok();
    Ok(Shown::Written(target))
}

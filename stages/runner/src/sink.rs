//! Sinks show a run: they get its record and write a folder beside pipeline.yaml. They are never
//! cached, but a sink that has shown this very record already isn't called again.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use artifact::{MANIFEST_FILE, Manifest, RunRecord, hash_json, plain_files, write_json};
use planning::{Plan, Sink};
use serde_json::json;
use stage_call::{Call, Display, StageFailure};
use store::{Record, RunFile, Store};

use crate::aside::Mark;
use crate::publish;
use crate::recorded::{Course, record, with_details};
use crate::unchanged::ConfirmedProgram;

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
    let record = record(plan, sink, &Course::before(records), store, out);
    record.is_some_and(|record| publish::shows(&out.join(&sink.stage), &identity(sink, &record)))
}

/// What became of a sink.
pub(crate) enum Shown {
    /// It ran and wrote this folder. Pages that show something else were put aside.
    Written { folder: PathBuf, aside: Vec<PathBuf> },
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
    course: &Course<'_>,
) -> Result<Shown, StageFailure> {
    let Showing { plan, store, run, out, threads, stop } = *showing;
    let Some(record) = record(plan, sink, course, store, out) else { return Ok(Shown::Missing) };
    let target = out.join(&sink.stage);
    let identity = identity(sink, &record);
    if publish::shows(&target, &identity) {
        return Ok(Shown::UpToDate(target));
    }
    let record = with_details(record, plan, course);
    let scratch = store.scratch(run.id()).join(&sink.stage);
    let (folder, params, output) =
        (scratch.join("run"), scratch.join("params.json"), scratch.join("output"));
    std::fs::create_dir_all(&folder)
        .and_then(|()| write_json(&folder.join("run.json"), &record))
        .and_then(|()| write_json(&params, &sink.parameters))
        .map_err(|e| StageFailure::at(&scratch, &e))?;
    let program = ConfirmedProgram::new(&sink.program, store, stop)?;
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
        from_checkpoint: false,
        device: plan.device(&sink.stage),
        threads,
        lock: None,
    };
    let result = call.run(&scratch.join("log"), &view, stop);
    view.end();
    result?;
    program.confirm_again()?;
    plain_files(&output)
        .map_err(|problem| StageFailure { code: 1, message: problem.to_string() })?;
    let kind = &sink.program.description.output.kind;
    let manifest = output.join(MANIFEST_FILE);
    if !manifest.exists() {
        let found =
            Manifest::of_folder(kind, &output).map_err(|e| StageFailure::at(&output, &e))?;
        write_json(&manifest, &found).map_err(|e| StageFailure::at(&manifest, &e))?;
    }
    let mark = Mark {
        identity,
        is_whole: record.failed.iter().all(|point| point.reason.is_some()),
        data_sets: record.data_sets,
    };
    mark.write(&output).map_err(|e| StageFailure::at(&output, &e))?;
    let published = publish::publish(&output, out, &sink.stage, kind, stop)?;
    // A sink's leftovers have no value.
    std::fs::remove_dir_all(&scratch).ok();
    Ok(Shown::Written { folder: published.folder, aside: published.aside })
}

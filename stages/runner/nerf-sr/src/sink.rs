//! Sinks show a run: each gets the run's record and writes a folder of its own. Sinks are never
//! cached, but a sink whose page shows the same record already isn't called again.

use std::collections::BTreeMap;
use std::path::Path;

use artifact::{
    MANIFEST_FILE, Manifest, RunRecord, format_count, format_size, hash_json, list_output_files,
    print_line, write_json,
};
use planning::stage_call::{Call, Display, StageFailure};
use planning::{Sink, environment_parts};
use serde_json::{Map, Value, json};
use store::StoreError;

use crate::page::PageMark;
use crate::publish::{has_current_page, publish};
use crate::run_record::{RunProgress, add_details, run_record, shown_results};
use crate::session::Run;
use crate::unchanged::call_confirmed;

/// Returns the identity of a sink's page: a hash of the record, the sink's code, parameters and
/// environment variables. Values that the scene decides follow from these, so they aren't hashed.
fn page_identity(sink: &Sink, record: &RunRecord) -> String {
    let mut parts = sink_parts(sink);
    parts.insert("record".to_owned(), json!(record));
    hash_json(&parts)
}

/// Returns what may change a sink's page, apart from the run that it shows, by name.
pub(crate) fn sink_parts(sink: &Sink) -> Map<String, Value> {
    let mut parts = environment_parts(&sink.program.description);
    parts.insert("code".to_owned(), json!(sink.program.description.code));
    parts.insert("parameters".to_owned(), sink.parameters.clone());
    parts
}

/// True if a sink's page already shows the run's records.
pub(crate) fn is_up_to_date(run: &Run<'_>, sink: &Sink, progress: &RunProgress) -> bool {
    let record = run_record(run, sink, progress);
    record.is_some_and(|(record, _)| {
        has_current_page(&run.out.join(&sink.stage), &page_identity(sink, &record))
    })
}

/// Returns the path of the page in a sink's folder, or the folder if it has no page.
fn page_path(folder: &Path) -> String {
    let page = folder.join("index.html");
    if page.exists() { page.display().to_string() } else { folder.display().to_string() }
}

/// Returns path and size of each file and folder that a sink without a page has written.
fn listing(folder: &Path) -> Vec<String> {
    let has_page = folder.join("index.html").exists();
    let Some(manifest) = Manifest::read(folder).ok().filter(|_| !has_page) else {
        return Vec::new();
    };
    let mut entries: BTreeMap<&str, (usize, u64)> = BTreeMap::new();
    for file in &manifest.files {
        // Files of a subfolder are counted together.
        let end = file.path.find('/').map_or(file.path.len(), |slash| slash + 1);
        let (count, bytes) = entries.entry(&file.path[..end]).or_default();
        *count += 1;
        *bytes += file.size;
    }
    let lines = entries.into_iter().map(|(name, (count, bytes))| {
        let count = if name.ends_with('/') {
            format!("{}, ", format_count(count, "file"))
        } else {
            String::new()
        };
        format!("{}, {count}{}", folder.join(name).display(), format_size(bytes))
    });
    lines.collect()
}

/// Calls a sink, publishes its page as `out/STAGE`, and prints its path and the new paths of
/// earlier pages. Returns whether a page was written: not if a node that the sink shows has no
/// record, or if the folder already shows this record.
pub(crate) fn run_sink(
    run: &Run<'_>,
    sink: &Sink,
    threads: usize,
    progress: &RunProgress,
) -> anyhow::Result<bool> {
    let Some((mut record, indices)) = run_record(run, sink, progress) else {
        print_line!("{}: nothing to show", sink.stage);
        return Ok(false);
    };
    let stage = &sink.stage;
    let target = run.out.join(stage);
    let identity = page_identity(sink, &record);
    if has_current_page(&target, &identity) {
        print_line!("{stage}: {} (up to date)", page_path(&target));
        return Ok(false);
    }
    add_details(&mut record, run.plan, &indices, progress);
    let scratch = run.store.scratch(run.file.id()).join(stage);
    let output = scratch.join("output");
    call_confirmed(&sink.program, run.store, run.stop, || {
        call(run, sink, threads, &record, &scratch, &output)
    })?;
    if output.symlink_metadata().is_err() {
        return Err(StoreError::missing_output().into());
    }
    list_output_files(&output)?;
    let kind = &sink.program.description.output.kind;
    let manifest = output.join(MANIFEST_FILE);
    if !manifest.exists() {
        let found =
            Manifest::of_folder(kind, &output).map_err(|e| StageFailure::at(&output, &e))?;
        write_json(&manifest, &found).map_err(|e| StageFailure::at(&manifest, &e))?;
    }
    let results = Some(shown_results(&record, run.plan, &indices));
    let mark = PageMark { identity, results, data_sets: record.data_sets };
    mark.write(&output).map_err(|e| StageFailure::at(&output, &e))?;
    let archived = publish(&output, &target, kind, run.stop)?;
    // Leftovers of a sink have no value.
    std::fs::remove_dir_all(&scratch).ok();
    for folder in archived {
        print_line!("{stage}: moved the earlier page to {}", page_path(&folder));
    }
    print_line!("{stage}: {}", page_path(&target));
    for entry in listing(&target) {
        print_line!("{stage}: {entry}");
    }
    Ok(true)
}

/// Calls a sink's program, which reads `run.json` and writes `output`.
fn call(
    run: &Run<'_>,
    sink: &Sink,
    threads: usize,
    record: &RunRecord,
    scratch: &Path,
    output: &Path,
) -> anyhow::Result<()> {
    let folder = scratch.join("run");
    let params = scratch.join("params.json");
    std::fs::create_dir_all(&folder)
        .and_then(|()| write_json(&folder.join("run.json"), record))
        .and_then(|()| write_json(&params, &sink.parameters))
        .map_err(|e| StageFailure::at(scratch, &e))?;
    let display = Display::default();
    let view = display.start(&sink.stage);
    let call = Call {
        label: &sink.stage,
        program: &sink.program.path,
        description: &sink.program.description,
        params: &params,
        inputs: &[("run".to_owned(), folder)],
        hashes: &[],
        output,
        work: None,
        from_checkpoint: false,
        device: run.plan.device(&sink.stage),
        threads,
        lock: None,
    };
    let (_, result) = call.run(&scratch.join("log"), &view, run.stop);
    view.end();
    result?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use planning::{Pipeline, Plan, Request};

    use super::*;

    /// Returns the identity of the page of a sink that declares some environment variables.
    fn identity(environment: &[&str]) -> String {
        let text = "default: [page]\nstages: {page: {}}";
        let pipeline = Pipeline::parse(text.as_bytes(), Path::new("pipeline.yaml")).unwrap();
        let description =
            serde_json::from_value(json!({"name": "page", "version": "", "code": "c",
            "summary": "", "parameters": {}, "inputs": {}, "output": {"kind": "page"},
            "sink": true, "environment": environment}));
        let descriptions = BTreeMap::from([("page".to_owned(), description.unwrap())]);
        let request = Request { targets: vec!["page".to_owned()], ..Request::default() };
        let plan = Plan::from_descriptions(&pipeline, &descriptions, &request).unwrap();
        page_identity(&plan.sinks[0], &RunRecord::default())
    }

    #[test]
    fn a_sinks_variables_are_part_of_its_pages_identity() {
        let parts = json!({"record": RunRecord::default(), "code": "c", "parameters": {}});
        assert_eq!(identity(&[]), hash_json(&parts));
        assert_ne!(identity(&["PATH"]), identity(&["NERF_SR_UNSET"]));
    }
}

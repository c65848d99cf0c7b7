//! Parts of a pipeline that a plan leaves out: unselected inputs of sinks, and blocks whose files
//! are missing.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use artifact::known_names;
use serde_json::Value;
use stage::plain;

use crate::check::{input_stages, known_stages};
use crate::experiment::Selection;
use crate::file::InputSource;
use crate::pipeline::Pipeline;
use crate::request::PlanError;

/// Returns the stages that a sink shows: the inputs that `--show` selects. Without `--show`, those
/// that the file's `show` selects, or all if `show` names no input of this sink.
pub(crate) fn shown_stages<'a>(
    pipeline: &'a Pipeline,
    sink: &str,
    selection: &Selection,
) -> Vec<&'a str> {
    let is_explicit = !selection.show.is_empty();
    let show = if is_explicit { &selection.show } else { &pipeline.experiment.show };
    let mut selected = Vec::new();
    let mut all = Vec::new();
    for (name, source) in &pipeline.stages[sink].inputs {
        let Some(stage) = InputSource::parse(source).stage() else { continue };
        all.push(stage);
        if show.iter().any(|shown| shown == name || shown == stage) {
            selected.push(stage);
        }
    }
    // The file's `show` may name only inputs of other sinks.
    if is_explicit || !selected.is_empty() { selected } else { all }
}

/// Checks that each name of `--show` is an input of a target sink, and that each target sink has
/// one of these inputs.
pub(crate) fn check_show(
    pipeline: &Pipeline,
    sinks: &[&str],
    selection: &Selection,
) -> Result<(), PlanError> {
    if selection.show.is_empty() {
        return Ok(());
    }
    if sinks.is_empty() {
        let problem = "--show selects results on pages and in tables, but no target shows \
            results; add a target that does, such as report";
        return Err(PlanError::Usage(problem.to_owned()));
    }
    let names = sinks.iter().flat_map(|sink| {
        let inputs = pipeline.stages[*sink].inputs.keys().map(String::as_str);
        inputs.chain(input_stages(pipeline, sink))
    });
    let known: BTreeSet<&str> = names.collect();
    if let Some(name) = selection.show.iter().find(|name| !known.contains(name.as_str())) {
        let problem = format!(
            "--show {name}: not an input of {}; {}",
            sinks.join(", "),
            known_names(name, known)
        );
        return Err(PlanError::Usage(problem));
    }
    if let Some(sink) = sinks.iter().find(|sink| shown_stages(pipeline, sink, selection).is_empty())
    {
        let show = selection.show.join(",");
        let problem = format!(
            "--show {show}: {sink} has none of these inputs; remove {sink} from the targets"
        );
        return Err(PlanError::Usage(problem));
    }
    Ok(())
}

/// Files of an experiment without which blocks are left out.
#[derive(Debug, Default)]
pub(crate) struct RequiredFiles {
    /// Folder of the data sets.
    pub(crate) data: PathBuf,
    /// Paths inside `data` by block, with names of parameters in braces.
    paths: BTreeMap<String, String>,
}

impl RequiredFiles {
    pub(crate) fn new(pipeline: &Pipeline, selection: &Selection) -> Result<Self, PlanError> {
        let paths = pipeline.experiment.needs.clone();
        if let Some(name) = paths.keys().find(|name| !pipeline.stages.contains_key(*name)) {
            let known = known_stages(pipeline, name);
            let problem = format!("experiment: needs {name}: no such stage; {known}");
            return Err(PlanError::Usage(problem));
        }
        Ok(Self { data: pipeline.experiment.data_folder(selection), paths })
    }

    /// Returns the reason for leaving out a block; `None` if its file exists or it needs none.
    pub(crate) fn reason_to_leave_out(&self, stage: &str, parameters: &Value) -> Option<String> {
        let mut path = self.paths.get(stage)?.clone();
        for (name, value) in parameters.as_object().into_iter().flatten() {
            path = path.replace(&format!("{{{name}}}"), &plain(value));
        }
        (!self.data.join(&path).is_file()).then(|| format!("no {path}"))
    }
}

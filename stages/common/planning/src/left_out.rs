//! What isn't made: inputs of sinks that nobody wants to see, and blocks whose files aren't there.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use artifact::known_names;
use contract::plain;
use serde_json::Value;

use crate::check::needs;
use crate::experiment::Selection;
use crate::part::Source;
use crate::pipeline::Pipeline;
use crate::request::PlanError;

/// The stages that a sink shows, of those that its block names.
pub(crate) fn shown<'a>(pipeline: &'a Pipeline, sink: &str, choice: &Selection) -> Vec<&'a str> {
    let inputs = pipeline.stages[sink]
        .inputs
        .iter()
        .filter_map(|(name, source)| Some((name, Source::of(source).stage()?)));
    let wanted = if choice.show.is_empty() { &pipeline.experiment.show } else { &choice.show };
    let chosen: Vec<&str> = inputs
        .clone()
        .filter(|(name, stage)| wanted.iter().any(|wanted| wanted == *name || wanted == stage))
        .map(|(_, stage)| stage)
        .collect();
    // A file's own choice needn't be meant for this sink.
    let shows_all = choice.show.is_empty() && chosen.is_empty();
    if shows_all { inputs.map(|(_, stage)| stage).collect() } else { chosen }
}

/// Checks that sinks have the inputs that are wanted of them.
pub(crate) fn check_shown(
    pipeline: &Pipeline,
    sinks: &[&str],
    choice: &Selection,
) -> Result<(), PlanError> {
    if choice.show.is_empty() {
        return Ok(());
    }
    if sinks.is_empty() {
        let problem = "--show chooses what a sink shows, and no target is one; name one as \
            target, such as report";
        return Err(PlanError::Usage(problem.to_owned()));
    }
    let names = sinks.iter().flat_map(|sink| {
        pipeline.stages[*sink].inputs.keys().map(String::as_str).chain(needs(pipeline, sink))
    });
    let known: BTreeSet<&str> = names.collect();
    if let Some(name) = choice.show.iter().find(|name| !known.contains(name.as_str())) {
        let problem = format!(
            "--show {name}: {} has no such input; {}",
            sinks.join(", "),
            known_names(name, known)
        );
        return Err(PlanError::Usage(problem));
    }
    match sinks.iter().find(|sink| shown(pipeline, sink, choice).is_empty()) {
        Some(sink) => Err(PlanError::Usage(format!(
            "--show {}: {sink} has none of these; leave it out",
            choice.show.join(",")
        ))),
        None => Ok(()),
    }
}

/// Files without which blocks aren't made.
#[derive(Debug, Default)]
pub(crate) struct Files {
    pub(crate) data: PathBuf,
    /// Paths in `data` by block, with names of parameters in braces.
    of: BTreeMap<String, String>,
}

impl Files {
    pub(crate) fn new(pipeline: &Pipeline, choice: &Selection) -> Result<Self, PlanError> {
        let of = pipeline.experiment.needs.clone();
        if let Some(name) = of.keys().find(|name| !pipeline.stages.contains_key(*name)) {
            let known = known_names(name, pipeline.stages.keys().map(String::as_str));
            return Err(PlanError::Usage(format!(
                "experiment: needs {name}: no such stage; {known}"
            )));
        }
        Ok(Self { data: pipeline.experiment.data(choice), of })
    }

    /// What to say of a block whose file isn't there.
    pub(crate) fn missing(&self, stage: &str, parameters: &Value) -> Option<String> {
        let mut path = self.of.get(stage)?.clone();
        for (name, value) in parameters.as_object().into_iter().flatten() {
            let text = plain(value);
            path = path.replace(&format!("{{{name}}}"), &text);
        }
        (!self.data.join(&path).is_file()).then(|| format!("no {path}"))
    }
}

//! Targets by name: blocks of pipeline.yaml, or else of the files in `pipelines/` beside it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use artifact::known_names;

use crate::part::Part;
use crate::pipeline::{Pipeline, SHELVES};
use crate::request::PlanError;

/// The pipeline that has all targets, and the blocks that they are. `pipelines/NAME.yaml` is the
/// target NAME: its block of that name, or its default. A block of such a file is a target, too.
pub fn find(pipeline: &Pipeline, targets: &[String]) -> Result<(Pipeline, Vec<String>), PlanError> {
    let (mut all, mut blocks): (Option<Pipeline>, Vec<String>) = (None, Vec::new());
    for target in targets {
        let (found, named) = if pipeline.stages.contains_key(target) {
            (pipeline.clone(), vec![target.clone()])
        } else {
            on_shelf(pipeline, target)?
        };
        all = Some(match all {
            None => found,
            Some(all) => all.joined(found).map_err(|problem| {
                PlanError::Usage(format!(
                    "{target} can't be made together with {}: {problem}; make it by itself",
                    blocks.join(", ")
                ))
            })?,
        });
        blocks.extend(named);
    }
    Ok((all.unwrap_or_else(|| pipeline.clone()), blocks))
}

/// The file of `pipelines/` that has a target, and its blocks that are meant.
fn on_shelf(pipeline: &Pipeline, target: &str) -> Result<(Pipeline, Vec<String>), PlanError> {
    let files = shelf(pipeline);
    if let Some(path) = files.get(target) {
        let found = Pipeline::read(path)?;
        let blocks = if found.stages.contains_key(target) {
            vec![target.to_owned()]
        } else {
            found.default.clone()
        };
        return Ok((found, blocks));
    }
    // A file that can't be used is reported when it is asked for.
    let others: Vec<Pipeline> =
        files.values().filter_map(|path| Pipeline::read(path).ok()).collect();
    if let Some(found) = others.iter().find(|other| other.files[0].says(target, Part::Block)) {
        return Ok((found.clone(), vec![target.to_owned()]));
    }
    let blocks = others.iter().chain([pipeline]).flat_map(|other| other.stages.keys());
    let known: BTreeSet<&str> = blocks.chain(files.keys()).map(String::as_str).collect();
    Err(PlanError::Usage(format!("no stage {target:?}; {}", known_names(target, known))))
}

/// The files of `pipelines/` and `experiments/`, by name; the former win.
fn shelf(pipeline: &Pipeline) -> BTreeMap<String, PathBuf> {
    let folders = SHELVES.iter().rev().map(|shelf| pipeline.home().join(shelf));
    let entries =
        folders.flat_map(|folder| std::fs::read_dir(folder).into_iter().flatten().flatten());
    let paths = entries
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|e| e == "yaml"));
    paths.filter_map(|path| Some((path.file_stem()?.to_str()?.to_owned(), path))).collect()
}

//! Finds targets by name in pipeline.yaml, then in the files of `pipelines/` and `experiments/`
//! next to it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use artifact::known_names;

use crate::file::Part;
use crate::pipeline::{Pipeline, TARGET_FOLDERS};
use crate::request::PlanError;

/// Returns a pipeline that contains all targets, and the targets' blocks. A target NAME is the
/// first of these:
/// 1. the block NAME of pipeline.yaml;
/// 2. the block NAME of NAME.yaml in [`TARGET_FOLDERS`] or, without one, its default blocks;
/// 3. the block NAME of another file there, preferably of a file that inherits no such block; files
///    of `pipelines/` come before those of `experiments/`.
pub fn find_targets(
    pipeline: &Pipeline,
    targets: &[String],
) -> Result<(Pipeline, Vec<String>), PlanError> {
    let mut joined: Option<Pipeline> = None;
    let mut blocks: Vec<String> = Vec::new();
    for target in targets {
        let (found, target_blocks) = if pipeline.stages.contains_key(target) {
            (pipeline.clone(), vec![target.clone()])
        } else {
            find_in_folders(pipeline, target)?
        };
        let cannot_combine = |reason: &str| {
            PlanError::Usage(format!(
                "{target} can't be combined with {}: {reason}; run {target} alone",
                blocks.join(", ")
            ))
        };
        joined = Some(match joined {
            None => found,
            Some(joined)
                if joined.quality.unwrap_or_default() != found.quality.unwrap_or_default() =>
            {
                return Err(cannot_combine("their files set different qualities"));
            }
            Some(joined) => joined.joined(found).map_err(|problem| cannot_combine(&problem))?,
        });
        blocks.extend(target_blocks);
    }
    Ok((joined.unwrap_or_else(|| pipeline.clone()), blocks))
}

/// Returns the pipeline of the file in [`TARGET_FOLDERS`] that has a target, and the target's
/// blocks.
fn find_in_folders(
    pipeline: &Pipeline,
    target: &str,
) -> Result<(Pipeline, Vec<String>), PlanError> {
    let files = target_files(pipeline);
    if let Some(path) = files.get(target) {
        let found = Pipeline::read(path)?;
        let blocks = if found.stages.contains_key(target) {
            vec![target.to_owned()]
        } else {
            found.default.clone()
        };
        return Ok((found, blocks));
    }
    // An invalid file is reported only when it is the target.
    let others: Vec<Pipeline> =
        files.values().filter_map(|path| Pipeline::read(path).ok()).collect();
    if let Some(found) = find_block(&others, target)? {
        return Ok((found.clone(), vec![target.to_owned()]));
    }
    let blocks = others.iter().chain([pipeline]).flat_map(|other| other.stages.keys());
    let known: BTreeSet<&str> = blocks.chain(files.keys()).map(String::as_str).collect();
    Err(PlanError::Usage(format!("no stage {target:?}; {}", known_names(target, known))))
}

/// Returns the file with a block; the file that first defines it rather than one that overrides it,
/// and a file of `pipelines/` rather than one of `experiments/`. Fails if several files remain.
fn find_block<'a>(files: &'a [Pipeline], block: &str) -> Result<Option<&'a Pipeline>, PlanError> {
    let rank = |file: &&Pipeline| {
        let is_inherited = file.files[1..].iter().any(|file| file.has(block, Part::Block));
        (is_inherited, !file.files[0].folder().ends_with(TARGET_FOLDERS[0]))
    };
    let with_block = files.iter().filter(|file| file.files[0].has(block, Part::Block));
    let Some(best) = with_block.clone().map(|file| rank(&file)).min() else { return Ok(None) };
    let found: Vec<&Pipeline> = with_block.filter(|file| rank(file) == best).collect();
    if let [file] = found[..] {
        return Ok(Some(file));
    }
    let paths = found.iter().map(|file| file.files[0].path.display().to_string());
    let paths = paths.collect::<Vec<_>>().join(", ");
    let problem = format!("several files have a block {block}: {paths}; choose one by --pipeline");
    Err(PlanError::Usage(problem))
}

/// Returns the YAML files of [`TARGET_FOLDERS`] by name. A file of `pipelines/` hides one of
/// `experiments/`.
fn target_files(pipeline: &Pipeline) -> BTreeMap<String, PathBuf> {
    let mut files = BTreeMap::new();
    for folder in TARGET_FOLDERS.iter().rev().map(|name| pipeline.project_folder().join(name)) {
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.extension().is_some_and(|extension| extension == "yaml")
                && let Some(name) = path.file_stem().and_then(|name| name.to_str())
            {
                files.insert(name.to_owned(), path);
            }
        }
    }
    files
}

//! From files to a pipeline: each with the blocks of those that it extends.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::file::File;
use crate::part::PipelineError;
use crate::pipeline::Pipeline;

/// Most files in a chain of which each extends the next.
const MOST_CHAINED_FILES: usize = 8;

/// Two pipelines that can't be one: a block of one is another in the other.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("block {block} isn't the same in {one} and in {two}")]
pub struct JoinError {
    /// The block's name.
    pub block: String,
    /// The file that one has it from.
    pub one: PathBuf,
    /// The file that the other has it from.
    pub two: PathBuf,
}

impl Pipeline {
    /// Reads a file and those that it extends.
    pub fn read(path: &Path) -> Result<Self, PipelineError> {
        let bytes = std::fs::read(path).map_err(|e| PipelineError {
            place: path.display().to_string(),
            problem: format!(
                "{e}; run in the folder of pipeline.yaml, name it with --pipeline, or write one \
                with `nerf-sr init DIR`"
            ),
        })?;
        Self::parse(&bytes, path)
    }

    /// The pipeline of a file's bytes; `path` says where relative paths start, and is named in
    /// errors.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, PipelineError> {
        let file = File::parse(bytes, path)?;
        let mut trail = vec![file.id.clone()];
        extended(file, &mut trail)
    }

    /// Both pipelines as one, where no block of one is another in the other.
    pub fn joined(mut self, other: Self) -> Result<Self, JoinError> {
        let mut shared = other.stages.keys().filter(|name| self.stages.contains_key(*name));
        if let Some(name) = shared.find(|name| !self.has_same(&other, name)) {
            let [one, two] =
                [&self, &other].map(|pipeline| pipeline.file_of_block(name).path.clone());
            return Err(JoinError { block: name.clone(), one, two });
        }
        self.stages.extend(other.stages);
        self.experiment.change(&other.experiment);
        for file in other.files {
            if !self.files.iter().any(|known| known.id == file.id) {
                self.files.push(file);
            }
        }
        Ok(self)
    }
}

/// A file with what it extends; `trail` are the files that lead to it, itself the last.
fn extended(file: File, trail: &mut Vec<PathBuf>) -> Result<Pipeline, PipelineError> {
    let mut all: Option<Pipeline> = None;
    for other in &file.written.extends {
        let fail =
            |problem: String| file.error(&["extends"], format!("extends {other}: {problem}"));
        let id = file.folder().join(other).canonicalize();
        let id = id
            .map_err(|e| fail(format!("{e}; a path is relative to the file in which it stands")))?;
        if trail.contains(&id) {
            return Err(fail("that file is this one or extends it; leave it out".to_owned()));
        }
        if trail.len() == MOST_CHAINED_FILES {
            return Err(fail(format!(
                "more than {MOST_CHAINED_FILES} files extend one another; extend a file nearer to \
                the last"
            )));
        }
        let bytes = std::fs::read(&id).map_err(|e| fail(e.to_string()))?;
        trail.push(id.clone());
        let pipeline = extended(File::parse(&bytes, &shown(&id))?, trail)?;
        trail.pop();
        all = Some(match all {
            None => pipeline,
            Some(all) => all
                .joined(pipeline)
                .map_err(|problem| fail(format!("{problem}; extend one of them")))?,
        });
    }
    Ok(changed(all.unwrap_or_default(), file))
}

/// What is extended, with what a file says of it and besides.
fn changed(mut pipeline: Pipeline, by: File) -> Pipeline {
    for (name, block) in &by.written.stages {
        pipeline.stages.entry(name.clone()).or_default().change(block);
    }
    pipeline.experiment.change(&by.written.experiment);
    if !by.written.default.is_empty() {
        pipeline.default.clone_from(&by.written.default);
    }
    pipeline.files.insert(0, Arc::new(by));
    pipeline
}

/// A path as people know it: from the current folder, if it is inside.
fn shown(path: &Path) -> PathBuf {
    let here = std::env::current_dir().and_then(|here| here.canonicalize()).unwrap_or_default();
    path.strip_prefix(here).unwrap_or(path).to_path_buf()
}

#[cfg(test)]
#[path = "extend_tests.rs"]
mod tests;

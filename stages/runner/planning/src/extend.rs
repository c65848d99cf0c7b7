//! Reads a pipeline file with the files that it extends.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::file::{ParsedFile, PipelineError};
use crate::pipeline::Pipeline;

/// Maximum number of files in a chain in which each extends the next, chosen by hand.
const MAX_CHAINED_FILES: usize = 8;

impl Pipeline {
    /// Reads a pipeline file and the files that it extends.
    pub fn read(path: &Path) -> Result<Self, PipelineError> {
        let bytes = std::fs::read(path).map_err(|e| {
            let problem = format!(
                "{e}; run in the folder of pipeline.yaml, name it with --pipeline, or write one \
                with `nerf-sr init DIR`"
            );
            PipelineError::new(path, None, problem)
        })?;
        Self::parse(&bytes, path)
    }

    /// Parses a pipeline file and reads the files that it extends. `path` locates the file for
    /// relative paths and error messages.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, PipelineError> {
        let file = ParsedFile::parse(bytes, path)?;
        let mut chain = vec![file.canonical_path.clone()];
        read_extended(file, &mut chain)
    }

    /// Joins two pipelines. Fails with the problem if blocks of the same name differ. Default
    /// targets come from `self`. If both set the quality, `self` wins. If both set a part of the
    /// experiment, `other` wins.
    pub(crate) fn joined(mut self, other: Self) -> Result<Self, String> {
        let mut shared = other.stages.keys().filter(|name| self.stages.contains_key(*name));
        if let Some(name) = shared.find(|name| !self.has_equal_block(&other, name)) {
            let files = [&self, &other].map(|joined| joined.file_of_block(name).path.display());
            return Err(format!("block {name} differs in {} and in {}", files[0], files[1]));
        }
        self.stages.extend(other.stages);
        self.experiment.override_with(&other.experiment);
        self.quality = self.quality.or(other.quality);
        for file in other.files {
            if !self.files.iter().any(|known| known.canonical_path == file.canonical_path) {
                self.files.push(file);
            }
        }
        Ok(self)
    }
}

/// Joins the files that a file extends, then applies this file's own blocks over them. In `chain`,
/// each file extends the next; the last one is this file.
fn read_extended(file: ParsedFile, chain: &mut Vec<PathBuf>) -> Result<Pipeline, PipelineError> {
    let mut joined: Option<Pipeline> = None;
    for extended in &file.content.extends {
        let path = file.folder().join(extended).canonicalize().map_err(|e| {
            let problem = format!("{e}; paths are relative to the file that contains them");
            extends_error(&file, extended, problem)
        })?;
        if chain.contains(&path) {
            let problem = "the file extends itself, maybe through other files; remove this entry";
            return Err(extends_error(&file, extended, problem));
        }
        if chain.len() == MAX_CHAINED_FILES {
            let problem = format!(
                "more than {MAX_CHAINED_FILES} files in a chain of `extends`; extend {} in an \
                earlier file of the chain",
                display_path(&path).display()
            );
            return Err(extends_error(&file, extended, problem));
        }
        let bytes = std::fs::read(&path).map_err(|e| extends_error(&file, extended, e))?;
        chain.push(path.clone());
        let pipeline = read_extended(ParsedFile::parse(&bytes, &display_path(&path))?, chain)?;
        chain.pop();
        joined = Some(match joined {
            None => pipeline,
            Some(joined) => joined.joined(pipeline).map_err(|e| {
                let problem = format!("{e}; extend only one of these files, or rename a block");
                extends_error(&file, extended, problem)
            })?,
        });
    }
    let mut pipeline = joined.unwrap_or_default();
    for (name, block) in &file.content.stages {
        let inherited = pipeline.stages.entry(name.clone()).or_default();
        let mut removed = block.given_inputs.iter().filter(|(_, source)| source.is_none());
        if let Some((input, _)) = removed.find(|(input, _)| !inherited.inputs.contains_key(*input))
        {
            let problem = format!(
                "stage {name}: input {input}: null removes an inherited input, but no extended \
                file has it; remove the entry"
            );
            return Err(file.error(&["stages", name, "inputs", input], problem));
        }
        inherited.override_with(block);
    }
    pipeline.experiment.override_with(&file.content.experiment);
    pipeline.quality = file.content.quality.or(pipeline.quality);
    if !file.content.default.is_empty() {
        pipeline.default.clone_from(&file.content.default);
    }
    pipeline.files.insert(0, Arc::new(file));
    Ok(pipeline)
}

fn extends_error(
    file: &ParsedFile,
    extended: &str,
    problem: impl std::fmt::Display,
) -> PipelineError {
    file.error(&["extends"], format!("extends {extended}: {problem}"))
}

/// Returns a path for messages: relative to the current folder if it is inside.
fn display_path(path: &Path) -> PathBuf {
    let current = std::env::current_dir().and_then(|path| path.canonicalize()).unwrap_or_default();
    path.strip_prefix(current).unwrap_or(path).to_path_buf()
}

#[cfg(test)]
#[path = "extend_tests.rs"]
mod tests;

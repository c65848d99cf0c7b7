//! Pipeline files with the files that they extend.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use slurm::Resources;

use crate::experiment::Experiment;
use crate::file::{InputSource, ParsedFile, Part, PipelineError, StageBlock};
use crate::quality::Quality;

/// Blocks of a pipeline file and of the files that it extends.
#[derive(Clone, Debug, Default)]
pub struct Pipeline {
    /// Targets of `nerf-sr run` if the command line names none.
    pub default: Vec<String>,
    /// Blocks by stage name.
    pub stages: BTreeMap<String, StageBlock>,
    /// Scenes, protocols and variants.
    pub experiment: Experiment,
    /// Quality of all stages, if a file sets one.
    pub quality: Option<Quality>,
    /// The given file and the files that it extends; each file comes before those that it extends.
    pub files: Vec<Arc<ParsedFile>>,
}

/// Maximum number of files in a chain in which each extends the next, chosen by hand.
const MAX_CHAINED_FILES: usize = 8;

/// Folders of further pipelines and of experiments, next to pipeline.yaml.
pub(crate) const TARGET_FOLDERS: [&str; 2] = ["pipelines", "experiments"];

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

    /// Returns the names of the blocks that set a stage's parameters: the extended block, if any,
    /// then the stage's own block, which overrides the extended one.
    pub fn layers<'a>(&'a self, stage: &'a str) -> impl Iterator<Item = &'a str> {
        self.stages[stage].extends.as_deref().into_iter().chain([stage])
    }

    /// Returns the resources that a stage needs, from all its layers.
    pub fn resources(&self, stage: &str) -> Resources {
        let layers = self.layers(stage).map(|layer| &self.stages[layer].resources);
        layers.fold(Resources::default(), |resources, layer| resources.overridden_by(layer))
    }

    /// Returns the project's folder, which contains the store, pages and `pipelines/`. For a file
    /// in `pipelines/` or `experiments/` that extends another, it is the parent folder; otherwise
    /// the file's own folder.
    pub fn project_folder(&self) -> PathBuf {
        let folder = self.files[0].folder();
        let is_inside = folder.canonicalize().is_ok_and(|folder| is_target_folder(&folder));
        if !is_inside || self.files[0].content.extends.is_empty() {
            return folder.to_path_buf();
        }
        // A path such as `.` or a link doesn't end in the folder's name.
        match folder.parent() {
            Some(parent) if is_target_folder(folder) => Path::new(".").join(parent),
            _ => folder.join(".."),
        }
    }

    /// Resolves a path in a part of a stage's block from the folder of the file with this part.
    pub fn resolve_path(&self, stage: &str, part: Part, path: impl AsRef<Path>) -> PathBuf {
        self.file_of_part(stage, part).folder().join(path)
    }

    /// Returns whether another pipeline has an equal block, with equal paths.
    pub fn has_equal_block(&self, other: &Self, stage: &str) -> bool {
        self.stages[stage] == other.stages[stage]
            && self.base_folders(stage) == other.base_folders(stage)
    }

    /// Returns the folders that a block's relative paths start from.
    fn base_folders(&self, stage: &str) -> Vec<Option<&Path>> {
        let block = &self.stages[stage];
        let run = block.run.iter().filter(|run| run.contains('/')).map(|_| Part::Field("run"));
        let folders =
            block.inputs.iter().filter(|(_, source)| InputSource::parse(source).stage().is_none());
        let parts = run.chain(folders.map(|(name, _)| Part::Input(name)));
        parts.map(|part| self.file_of_part(stage, part).canonical_path.parent()).collect()
    }

    /// Returns the file that gives a part of a block, or else the first file with the block.
    fn file_of_part(&self, stage: &str, part: Part) -> &ParsedFile {
        let file = self.files.iter().find(|file| file.has(stage, part));
        file.map_or_else(|| self.file_of_block(stage), Arc::as_ref)
    }

    /// Returns whether a part of a block is inherited: the first file with the block doesn't have
    /// it.
    pub(crate) fn is_inherited(&self, stage: &str, part: Part) -> bool {
        !self.file_of_block(stage).has(stage, part)
    }

    /// Returns the first file with a stage's block.
    pub fn file_of_block(&self, stage: &str) -> &ParsedFile {
        self.find_file(|file| file.has(stage, Part::Block))
    }

    fn find_file(&self, is_wanted: impl Fn(&ParsedFile) -> bool) -> &ParsedFile {
        self.files.iter().find(|file| is_wanted(file)).unwrap_or(&self.files[0])
    }

    /// Creates an error about a part of a stage's block, with its file and line.
    pub fn error(&self, stage: &str, part: Part, problem: impl Into<String>) -> PipelineError {
        let inside = match part {
            Part::Block => &[][..],
            Part::Field(name) => &[name],
            Part::Input(name) => &["inputs", name],
            Part::Parameter(name) => &["parameters", name],
        };
        let keys = [&["stages", stage], inside].concat();
        let problem = format!("stage {stage}: {}", problem.into());
        self.file_of_part(stage, part).error(&keys, problem)
    }

    /// Creates an error about a name that an experiment sets, with the file that sets it.
    pub(crate) fn error_in_experiment(&self, name: &str, problem: &str) -> PipelineError {
        self.find_file(|file| file.content.experiment.sets(name))
            .error(&["experiment"], format!("experiment: {problem}"))
    }

    /// Creates an error about the default targets.
    pub fn error_in_default(&self, problem: String) -> PipelineError {
        self.find_file(|file| !file.content.default.is_empty()).error(&["default"], problem)
    }
}

fn is_target_folder(folder: &Path) -> bool {
    TARGET_FOLDERS.iter().any(|name| folder.ends_with(name))
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
#[path = "pipeline_tests.rs"]
mod tests;

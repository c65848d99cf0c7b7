use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use slurm::Resources;

use crate::experiment::Experiment;
use crate::file::{File, StageBlock};
use crate::part::{Part, PipelineError, Source};

/// The blocks of a pipeline file and of those that it extends.
#[derive(Clone, Debug, Default)]
pub struct Pipeline {
    /// What `nerf-sr run` makes when no target is named.
    pub default: Vec<String>,
    /// The stages by name.
    pub stages: BTreeMap<String, StageBlock>,
    /// Scenes, protocols and variants.
    pub experiment: Experiment,
    /// The file that was asked for, and those that it extends, each before what it extends itself.
    pub files: Vec<Arc<File>>,
}

/// The folders of further pipelines and of experiments, beside pipeline.yaml.
pub(crate) const SHELVES: [&str; 2] = ["pipelines", "experiments"];

impl Pipeline {
    /// The blocks that a stage's parameters come from, the weightiest last: the one it extends,
    /// then its own.
    pub fn layers<'a>(&'a self, stage: &'a str) -> impl Iterator<Item = &'a str> {
        self.stages[stage].extends.as_deref().into_iter().chain([stage])
    }

    /// What a stage needs of a machine: its own words over those of the block it extends.
    pub fn resources(&self, stage: &str) -> Resources {
        let said = self.layers(stage).map(|layer| &self.stages[layer].resources);
        said.fold(Resources::default(), |all, more| all.changed(more))
    }

    /// The project's folder, where the store, pages and `pipelines/` are: the file's own. A file of
    /// `pipelines/` shares those of the folder above.
    pub fn home(&self) -> PathBuf {
        let folder = self.files[0].folder();
        let ends = |folder: &Path| SHELVES.iter().any(|shelf| folder.ends_with(shelf));
        let is_shelf = folder.canonicalize().is_ok_and(|folder| ends(&folder));
        match folder.parent() {
            _ if !is_shelf || self.files[0].written.extends.is_empty() => folder.to_path_buf(),
            Some(above) if ends(folder) => Path::new(".").join(above),
            _ => folder.join(".."),
        }
    }

    /// Where a path leads that stands in a stage's block.
    pub fn resolve(&self, stage: &str, part: Part, path: impl AsRef<Path>) -> PathBuf {
        self.file_of(stage, part).folder().join(path)
    }

    /// Whether another pipeline has the same block, with the same paths.
    pub fn has_same(&self, other: &Self, stage: &str) -> bool {
        self.stages[stage] == other.stages[stage] && self.roots(stage) == other.roots(stage)
    }

    /// The folders that a block's relative paths start from.
    fn roots(&self, stage: &str) -> Vec<Option<&Path>> {
        let block = &self.stages[stage];
        let run = block.run.iter().filter(|run| run.contains('/')).map(|_| Part::Field("run"));
        let folders =
            block.inputs.iter().filter(|(_, source)| Source::of(source).stage().is_none());
        let parts = run.chain(folders.map(|(name, _)| Part::Input(name)));
        parts.map(|part| self.file_of(stage, part).id.parent()).collect()
    }

    /// The file that says that of a stage, or else the first that has it.
    fn file_of(&self, stage: &str, part: Part) -> &File {
        let file = self.files.iter().find(|file| file.says(stage, part));
        file.map_or_else(|| self.file_of_block(stage), Arc::as_ref)
    }

    /// The first file that has a block.
    pub fn file_of_block(&self, stage: &str) -> &File {
        self.files.iter().find(|file| file.says(stage, Part::Block)).unwrap_or(&self.files[0])
    }

    /// An error about a stage's block, or a part of it, with its file and line.
    pub fn error(&self, stage: &str, part: Part, problem: impl Into<String>) -> PipelineError {
        let inside = match part {
            Part::Block => &[][..],
            Part::Field(name) => &[name],
            Part::Input(name) => &["inputs", name],
            Part::Parameter(name) => &["parameters", name],
        };
        let keys = [&["stages", stage], inside].concat();
        self.file_of(stage, part).error(&keys, format!("stage {stage}: {}", problem.into()))
    }

    /// An error about something that an experiment names, with the file that names it.
    pub(crate) fn error_in_experiment(&self, name: &str, problem: &str) -> PipelineError {
        let file = self
            .files
            .iter()
            .find(|file| file.written.experiment.names(name))
            .unwrap_or(&self.files[0]);
        file.error(&["experiment"], format!("experiment: {problem}"))
    }

    /// An error about what stands before the stages.
    pub fn error_in_default(&self, problem: String) -> PipelineError {
        let file = self
            .files
            .iter()
            .find(|file| !file.written.default.is_empty())
            .unwrap_or(&self.files[0]);
        file.error(&["default"], problem)
    }
}

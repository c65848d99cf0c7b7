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

/// Folders of further pipelines and of experiments, next to pipeline.yaml.
pub(crate) const TARGET_FOLDERS: [&str; 2] = ["pipelines", "experiments"];

impl Pipeline {
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

    /// Returns whether a part of a block is inherited: the first file with the block doesn't have it.
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

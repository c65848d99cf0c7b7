//! Stages' programs with their descriptions, which are cached in the store.
//!
//! Programs in the runner's folder are its own. Any other is a user's file that a pipeline file
//! names: only `run` starts it, and only for a needed stage. Other verbs know it by its cached
//! description while its bytes are unchanged (docs/design/030).
//!
//! Before a stage's start and after its end, its program is compared with the planned one, whose
//! code is part of the key (docs/design/002).

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use artifact::{hash_file, suggestion, write_atomically};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use stage::{Description, Schema};
use store::Store;

use crate::file::{Part, PipelineError, StageBlock};
use crate::pipeline::Pipeline;
use crate::request::PlanError;
use crate::sources::Stamp;
use crate::stage_call::{ProgramError, describe_all};

/// Program of a stage, with its description.
#[derive(Debug)]
pub struct StageProgram {
    /// Path of the executable.
    pub path: PathBuf,
    /// Description from `STAGE describe`.
    pub description: Description,
    /// Schema of the parameters.
    pub schema: Schema,
    /// Stamp of the executable from before it was described; `None` if the description was given,
    /// not read from the executable.
    pub(crate) stamp: Option<Stamp>,
}

impl StageProgram {
    /// Creates a program from its description. Fails if the description is invalid.
    pub fn new(path: &Path, description: Description) -> Result<Self, ProgramError> {
        description.check().map_err(|problem| {
            ProgramError(format!("description of {} is invalid: {problem}", path.display()))
        })?;
        let schema =
            Schema::new(&description.parameters).map_err(|e| ProgramError(e.to_string()))?;
        Ok(Self { path: path.to_path_buf(), description, schema, stamp: None })
    }

    /// Returns whether a block of this program gives a parameter itself.
    pub fn is_given(&self, block: &StageBlock, parameter: &str) -> bool {
        block.parameter_layers().any(|layer| self.schema.flattened(layer).contains_key(parameter))
    }

    /// Overrides the parameters `base` with those of a block.
    pub fn lay_over(&self, base: &mut Map<String, Value>, block: &StageBlock) {
        for layer in block.parameter_layers() {
            self.schema.override_with(base, layer);
        }
    }
}

/// Limit to the programs that may be started to describe themselves.
#[derive(Clone, Copy)]
pub enum Describing<'a> {
    /// The runner's own programs, and users' files that are needed; setting the flag interrupts.
    OwnAndNeeded(&'a AtomicBool),
    /// The runner's own programs only.
    OwnOnly,
}

/// Program of each stage, or the error that makes it unusable.
pub struct Programs(BTreeMap<String, Result<Arc<StageProgram>, PipelineError>>);

impl Programs {
    /// Returns a stage's program, if it can be used.
    pub fn get(&self, stage: &str) -> Option<&StageProgram> {
        self.0.get(stage)?.as_deref().ok()
    }

    /// Returns a stage's program. Fails if it can't be used.
    pub fn require(&self, stage: &str) -> Result<&Arc<StageProgram>, PipelineError> {
        self.0[stage].as_ref().map_err(Clone::clone)
    }

    /// Returns the stages whose programs can't be used.
    pub fn unusable(&self) -> impl Iterator<Item = &str> {
        self.0.iter().filter(|(_, program)| program.is_err()).map(|(stage, _)| stage.as_str())
    }

    /// Creates the programs from descriptions, whose keys are the programs' names or paths in the
    /// pipeline file. Starts no program.
    pub fn from_descriptions(
        pipeline: &Pipeline,
        descriptions: &BTreeMap<String, Description>,
    ) -> Self {
        Self::new(pipeline, |stage| {
            let path = Path::new(program_name(pipeline, stage));
            match descriptions.get(program_name(pipeline, stage)) {
                Some(description) => StageProgram::new(path, description.clone()),
                None => Err(ProgramError::undescribed(path)),
            }
        })
    }

    /// Finds the programs of all stages. Describes those that aren't in the store's cache. `needed`
    /// are the targets and their transitive dependencies.
    pub fn find(
        pipeline: &Pipeline,
        store: &Store,
        needed: &BTreeSet<String>,
        describing: Describing,
    ) -> Result<Self, PlanError> {
        let mut cache = DescriptionCache::read(store);
        let mut descriptions: BTreeMap<PathBuf, Result<IdentifiedDescription, ProgramError>> =
            BTreeMap::new();
        let mut unknown = BTreeMap::new();
        let paths: BTreeMap<&str, PathBuf> =
            pipeline.stages.keys().map(|s| (s.as_str(), executable(pipeline, s))).collect();
        for (stage, path) in &paths {
            let is_needed =
                paths.iter().any(|(stage, other)| other == path && needed.contains(*stage));
            let described = match identify(path, program_name(pipeline, stage)) {
                Err(problem) => Err(problem),
                Ok(identity) => match cache.description(path, &identity) {
                    Some(description) => Ok(IdentifiedDescription { identity, description }),
                    None if identity.may_be_started(describing, is_needed) => {
                        unknown.insert(path.clone(), identity);
                        continue;
                    }
                    None => Err(ProgramError(format!(
                        "{} isn't part of nerf-sr; check what the program does, then start it with \
                        `nerf-sr run`",
                        path.display()
                    ))),
                },
            };
            descriptions.insert(path.clone(), described);
        }
        let stop = match describing {
            Describing::OwnAndNeeded(stop) => Some(stop),
            Describing::OwnOnly => None,
        };
        let unknown_paths: Vec<PathBuf> = unknown.keys().cloned().collect();
        for (path, description) in
            describe_all(&unknown_paths, stop).ok_or(PlanError::Interrupted)?
        {
            let described = check_unchanged(&path, unknown[&path].clone(), description);
            if let Ok(described) = &described {
                cache.0.insert(cache_key(&path), described.clone());
            }
            descriptions.insert(path, described);
        }
        if !unknown.is_empty() {
            cache.write(store);
        }
        Ok(Self::new(pipeline, |stage| {
            let IdentifiedDescription { identity, description } =
                descriptions[&paths[stage]].clone()?;
            let program = StageProgram::new(&paths[stage], description)?;
            Ok(StageProgram { stamp: Some(identity.stamp), ..program })
        }))
    }

    /// Finds each stage's program. Errors get the location of the stage's block.
    fn new(pipeline: &Pipeline, find: impl Fn(&str) -> Result<StageProgram, ProgramError>) -> Self {
        let programs = pipeline.stages.keys().map(|stage| {
            let program = find(stage)
                .map(Arc::new)
                .map_err(|e| pipeline.error(stage, Part::Field("run"), e.to_string()));
            (stage.clone(), program)
        });
        Self(programs.collect())
    }
}

/// Fails if a program's file has changed since it was identified.
fn check_unchanged(
    path: &Path,
    identity: FileIdentity,
    description: Result<Description, ProgramError>,
) -> Result<IdentifiedDescription, ProgramError> {
    let description = description?;
    if Stamp::of(path).is_ok_and(|now| now.is_untouched_since(&identity.stamp)) {
        Ok(IdentifiedDescription { identity, description })
    } else {
        let path = path.display();
        Err(ProgramError(format!("{path} changed while it was described; run again")))
    }
}

/// Cached descriptions by the program's path.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct DescriptionCache(BTreeMap<String, IdentifiedDescription>);

/// Description of a program, with the identity of its file.
#[derive(Clone, Serialize, Deserialize)]
struct IdentifiedDescription {
    #[serde(flatten)]
    identity: FileIdentity,
    description: Description,
}

/// Identity of a program's file.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct FileIdentity {
    #[serde(flatten)]
    stamp: Stamp,
    /// Hash of the bytes of a user's file; `None` for the runner's own programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    blake3: Option<String>,
}

impl DescriptionCache {
    /// Reads the cache of a store. An unreadable cache counts as empty.
    fn read(store: &Store) -> Self {
        let bytes = std::fs::read(Self::file(store)).unwrap_or_default();
        serde_json::from_slice(&bytes).unwrap_or_default()
    }

    fn file(store: &Store) -> PathBuf {
        store.root().join("cache/describe.json")
    }

    fn write(&self, store: &Store) {
        if let Ok(bytes) = serde_json::to_vec(self) {
            // Without a cache, the next start is only slower.
            write_atomically(&Self::file(store), &bytes).ok();
        }
    }

    /// Removes the description of a program, so that the next run describes it again.
    pub(crate) fn forget(store: &Store, program: &Path) {
        let mut cache = Self::read(store);
        if cache.0.remove(&cache_key(program)).is_some() {
            cache.write(store);
        }
    }

    fn description(&self, path: &Path, identity: &FileIdentity) -> Option<Description> {
        let described = self.0.get(&cache_key(path))?;
        described.identity.is_same(identity).then(|| described.description.clone())
    }
}

impl FileIdentity {
    /// Returns whether two identities are equal. A user's file is identified by its bytes alone: a
    /// copy of a project has other times.
    fn is_same(&self, other: &Self) -> bool {
        self.blake3 == other.blake3 && (self.blake3.is_some() || self.stamp == other.stamp)
    }

    fn may_be_started(&self, describing: Describing, is_needed: bool) -> bool {
        self.blake3.is_none() || (is_needed && matches!(describing, Describing::OwnAndNeeded(_)))
    }
}

fn cache_key(path: &Path) -> String {
    path.display().to_string()
}

/// Returns a stage's program as its block names it: a path, or the name of a program in the
/// runner's folder.
fn program_name<'a>(pipeline: &'a Pipeline, stage: &'a str) -> &'a str {
    let block = program_block(pipeline, stage);
    pipeline.stages[block].run.as_deref().unwrap_or(block)
}

/// Returns the name of the block that names a stage's program.
fn program_block<'a>(pipeline: &'a Pipeline, stage: &'a str) -> &'a str {
    pipeline.stages[stage].extends.as_deref().unwrap_or(stage)
}

/// Returns the path of a stage's executable.
pub fn executable(pipeline: &Pipeline, stage: &str) -> PathBuf {
    let name = program_name(pipeline, stage);
    if name.contains('/') {
        let block = program_block(pipeline, stage);
        let path = pipeline.resolve_path(block, Part::Field("run"), name);
        return path.canonicalize().unwrap_or(path);
    }
    runner_folder().join(name)
}

/// Returns whether a program is one of the runner's own.
pub fn is_own(path: &Path) -> bool {
    path.parent() == Some(&runner_folder())
}

/// Returns the path of a program in the runner's folder; `None` if there is none of this name.
pub fn own_program(name: &str) -> Option<PathBuf> {
    // Next to the programs, Cargo's folder has files with an extension.
    let path = (!name.contains(['/', '.'])).then(|| runner_folder().join(name))?;
    path.is_file().then_some(path)
}

/// Returns the folder of the running program.
fn runner_folder() -> PathBuf {
    let exe = std::env::current_exe().and_then(|exe| exe.canonicalize());
    exe.ok().and_then(|exe| exe.parent().map(Path::to_path_buf)).unwrap_or_default()
}

/// Returns the identity of a program's file.
fn identify(path: &Path, name: &str) -> Result<FileIdentity, ProgramError> {
    let stamp =
        if path.is_dir() { Err(std::io::ErrorKind::IsADirectory.into()) } else { Stamp::of(path) };
    let failure = |error| ProgramError(format!("{}: {error}", path.display()));
    let stamp = stamp.map_err(|error| {
        if name.contains('/') {
            failure(format!("{error}; set `run:` to the stage's executable"))
        } else if error.kind() == std::io::ErrorKind::NotFound {
            let suggestion = suggestion(name, own_programs().iter().map(String::as_str));
            let remedy = "run `make build`, or set `run:` to another program";
            ProgramError(format!("{} isn't built; {suggestion}{remedy}", path.display()))
        } else {
            failure(error.to_string())
        }
    })?;
    if is_own(path) {
        return Ok(FileIdentity { stamp, blake3: None });
    }
    let hash = hash_file(path).map_err(|error| failure(error.to_string()))?;
    Ok(FileIdentity { stamp, blake3: Some(hash) })
}

/// Returns the names of the programs in the runner's folder.
fn own_programs() -> Vec<String> {
    let entries = std::fs::read_dir(runner_folder()).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    names.filter(|name| !name.contains('.')).collect()
}

fn changed(path: &Path) -> PlanError {
    let problem = "was changed or rebuilt after planning; run again";
    PlanError::Usage(format!("{} {problem}", path.display()))
}

impl StageProgram {
    /// Returns whether the program is in the runner's folder. Others are the user's files.
    pub fn is_own(&self) -> bool {
        is_own(&self.path)
    }

    /// Checks before a stage's start that the program is the planned one. Returns the file's stamp.
    /// Programs that this one calls are checked after the stage's end.
    pub fn confirm(&self, store: &Store, stop: Option<&AtomicBool>) -> Result<Stamp, PlanError> {
        let now = self.stamp_now()?;
        if self.stamp == Some(now) {
            return Ok(now);
        }
        if let Some(planned) = &self.stamp {
            self.check_untouched(planned, &now)?;
        }
        self.check_code(store, stop)?;
        Ok(now)
    }

    /// Checks after a stage's end that the program was the planned one since the stage's start;
    /// `start` is the file's stamp at that time. Programs outside the runner's folder are always
    /// described again: they may call other programs.
    pub fn confirm_since(
        &self,
        start: &Stamp,
        store: &Store,
        stop: Option<&AtomicBool>,
    ) -> Result<(), PlanError> {
        let now = self.stamp_now()?;
        if now == *start && self.is_own() {
            return Ok(());
        }
        self.check_untouched(start, &now)?;
        self.check_code(store, stop)
    }

    fn stamp_now(&self) -> Result<Stamp, PlanError> {
        let path = self.path.display();
        Stamp::of(&self.path).map_err(|problem| PlanError::Usage(format!("{path}: {problem}")))
    }

    /// Fails if a user's file was written to: an interpreter may read a script at any time. The
    /// runner's own programs are in memory after their start, and a build may rewrite their files
    /// without a change of code.
    fn check_untouched(&self, before: &Stamp, now: &Stamp) -> Result<(), PlanError> {
        if self.is_own() || now.is_untouched_since(before) {
            return Ok(());
        }
        Err(changed(&self.path))
    }

    /// Describes the program again. Fails if its code has changed.
    fn check_code(&self, store: &Store, stop: Option<&AtomicBool>) -> Result<(), PlanError> {
        let path = &self.path;
        let description = describe_all(std::slice::from_ref(path), stop)
            .and_then(|mut descriptions| descriptions.remove(path))
            .ok_or(PlanError::Interrupted)?;
        if description?.code == self.description.code {
            return Ok(());
        }
        // The cache knows a wrapper script by its own file, which may be unchanged.
        DescriptionCache::forget(store, path);
        Err(changed(path))
    }
}

//! Which program each stage is, and what it says of itself: asked once for each build, and kept in
//! the store.
//!
//! Programs beside the runner are its own. Any other one is somebody's file that a pipeline.yaml
//! names: `run` alone starts it, and only where it is needed; the other verbs know it by what it
//! answered then, while its bytes are the same.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use artifact::{nearest, write_atomically};
use contract::{Description, DescriptionError, Schema, SchemaError};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use stage_call::{DescribeError, Interrupted, describe_all};
use store::Store;

use crate::file::StageBlock;
use crate::part::{Part, PipelineError};
use crate::pipeline::Pipeline;
use crate::stamp::Stamp;

/// A stage's executable and what it says of itself.
#[derive(Debug)]
pub struct StageProgram {
    /// The executable.
    pub path: PathBuf,
    /// What it says of itself.
    pub description: Description,
    /// Its parameters.
    pub schema: Schema,
    /// Stamp of the executable from before it was asked; `None` in a plan that was read from a
    /// file.
    pub(crate) stamp: Option<Stamp>,
}

/// Why a stage's program can't be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ProgramError {
    /// Its file can't be used.
    #[error("{path}: {problem}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong, and what to do.
        problem: String,
    },
    /// It isn't built.
    #[error("{path} isn't built; {remedy}")]
    Unbuilt {
        /// Where it would be.
        path: PathBuf,
        /// What to do.
        remedy: String,
    },
    /// It is somebody's file, which only a run may start.
    #[error("{0} is no part of nerf-sr: `nerf-sr run` starts it; read it first")]
    Foreign(PathBuf),
    /// It doesn't say what it is.
    #[error(transparent)]
    Describe(#[from] DescribeError),
    /// The program's file changed while the program was asked.
    #[error("{0} changed while it was asked what it is; run again")]
    Changing(PathBuf),
    /// Nobody says what it is.
    #[error("nothing describes {0}")]
    Undescribed(PathBuf),
    /// What it says of itself is wrong.
    #[error("what {path} says of itself can't be used: {problem}")]
    Description {
        /// The program.
        path: PathBuf,
        /// What is wrong.
        problem: DescriptionError,
    },
    /// Its parameters can't be checked.
    #[error(transparent)]
    Schema(#[from] SchemaError),
}

impl StageProgram {
    /// A program by what it says; fails where that can't be used.
    pub fn new(path: &Path, description: Description) -> Result<Self, ProgramError> {
        description
            .check()
            .map_err(|problem| ProgramError::Description { path: path.to_path_buf(), problem })?;
        let schema = Schema::new(&description.parameters)?;
        Ok(Self { path: path.to_path_buf(), description, schema, stamp: None })
    }

    /// Whether a block of this program gives a parameter itself.
    pub fn is_given(&self, block: &StageBlock, parameter: &str) -> bool {
        block.parameter_layers().any(|layer| self.schema.flattened(layer).contains_key(parameter))
    }

    /// The parameters that a block gives, laid over those that were given before.
    pub fn lay_over(&self, given: &mut Map<String, Value>, block: &StageBlock) {
        block.parameter_layers().for_each(|layer| self.schema.lay_over(given, layer));
    }
}

/// Which programs may be started to ask what they are.
#[derive(Clone, Copy)]
pub enum Asking<'a> {
    /// The runner's own, and others that are needed; ends when the flag is set.
    Run(&'a AtomicBool),
    /// The runner's own.
    Look,
}

/// The stages' programs, or why they aren't known.
pub struct Programs(BTreeMap<String, Result<Arc<StageProgram>, PipelineError>>);

impl Programs {
    /// A stage's program, where it is known.
    pub fn get(&self, stage: &str) -> Option<&StageProgram> {
        self.0.get(stage)?.as_deref().ok()
    }

    /// A stage's program, or why it isn't known.
    pub fn require(&self, stage: &str) -> Result<&Arc<StageProgram>, PipelineError> {
        self.0[stage].as_ref().map_err(Clone::clone)
    }

    /// The stages whose programs aren't known.
    pub fn unknown(&self) -> impl Iterator<Item = &str> {
        self.0.iter().filter(|(_, program)| program.is_err()).map(|(stage, _)| stage.as_str())
    }

    /// Programs by what they would answer; nothing is started.
    pub fn of(pipeline: &Pipeline, descriptions: &BTreeMap<String, Description>) -> Self {
        Self::new(pipeline, |stage| {
            let name = program_name(pipeline, stage);
            let absent = || ProgramError::Undescribed(PathBuf::from(name));
            let description = descriptions.get(name).cloned().ok_or_else(absent)?;
            StageProgram::new(Path::new(name), description)
        })
    }

    /// Finds the programs of all stages and asks those that aren't known yet; `needed` are the
    /// stages that the targets come to.
    pub fn ask(
        pipeline: &Pipeline,
        store: &Store,
        needed: &BTreeSet<String>,
        asking: Asking,
    ) -> Result<Self, Interrupted> {
        let mut cache = DescriptionCache::of(store);
        let mut answers: BTreeMap<PathBuf, Result<Answer, ProgramError>> = BTreeMap::new();
        let mut unasked = BTreeMap::new();
        let paths: BTreeMap<&str, PathBuf> =
            pipeline.stages.keys().map(|s| (s.as_str(), executable(pipeline, s))).collect();
        for (stage, path) in &paths {
            let is_needed =
                paths.iter().any(|(stage, other)| other == path && needed.contains(*stage));
            match identify(path, program_name(pipeline, stage)) {
                Err(problem) => _ = answers.insert(path.clone(), Err(problem)),
                Ok(identity) => match cache.answer(path, &identity) {
                    Some(description) => {
                        _ = answers.insert(path.clone(), Ok(Answer { identity, description }));
                    }
                    None if identity.may_be_asked(asking, is_needed) => {
                        _ = unasked.insert(path.clone(), identity);
                    }
                    None => {
                        answers.insert(path.clone(), Err(ProgramError::Foreign(path.clone())));
                    }
                },
            }
        }
        let stop = match asking {
            Asking::Run(stop) => Some(stop),
            Asking::Look => None,
        };
        let asked = describe_all(&unasked.keys().cloned().collect::<Vec<_>>(), stop)?;
        for (path, description) in asked {
            let answer = answer(&path, unasked[&path].clone(), description);
            if let Ok(answer) = &answer {
                cache.0.insert(id(&path), answer.clone());
            }
            answers.insert(path, answer);
        }
        if !unasked.is_empty() {
            cache.write(store);
        }
        Ok(Self::new(pipeline, |stage| {
            let Answer { identity, description } = answers[&paths[stage]].clone()?;
            let program = StageProgram::new(&paths[stage], description)?;
            Ok(StageProgram { stamp: Some(identity.stamp), ..program })
        }))
    }

    /// What each stage's program turns out to be; what is wrong with it, is wrong with the block.
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

/// Returns the answer of a program. Fails if its file has changed since it was identified.
fn answer(
    path: &Path,
    identity: Identity,
    description: Result<Description, DescribeError>,
) -> Result<Answer, ProgramError> {
    let description = description?;
    if Stamp::of(path).is_ok_and(|now| now.is_untouched_since(&identity.stamp)) {
        Ok(Answer { identity, description })
    } else {
        Err(ProgramError::Changing(path.to_path_buf()))
    }
}

/// Answers of `describe` by the program's path.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct DescriptionCache(BTreeMap<String, Answer>);

#[derive(Clone, Serialize, Deserialize)]
struct Answer {
    #[serde(flatten)]
    identity: Identity,
    description: Description,
}

/// By what a program is known again.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Identity {
    #[serde(flatten)]
    stamp: Stamp,
    /// The hash of its bytes, where it isn't one of the runner's own: then a run has started it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    blake3: Option<String>,
}

impl DescriptionCache {
    /// Reads the cache of a store. A cache that can't be read is empty.
    fn of(store: &Store) -> Self {
        let bytes = std::fs::read(Self::file(store)).unwrap_or_default();
        serde_json::from_slice(&bytes).unwrap_or_default()
    }

    fn file(store: &Store) -> PathBuf {
        store.root().join("cache/describe.json")
    }

    fn write(&self, store: &Store) {
        if let Ok(bytes) = serde_json::to_vec(self) {
            // Only a cache: without it the next start is slower.
            write_atomically(&Self::file(store), &bytes).ok();
        }
    }

    /// Removes the answer of a program, so that the next run asks again.
    pub(crate) fn forget(store: &Store, program: &Path) {
        let mut cache = Self::of(store);
        if cache.0.remove(&id(program)).is_some() {
            cache.write(store);
        }
    }

    fn answer(&self, path: &Path, identity: &Identity) -> Option<Description> {
        self.0
            .get(&id(path))
            .filter(|answer| answer.identity.is_same(identity))
            .map(|answer| answer.description.clone())
    }
}

impl Identity {
    /// Compares two identities. Somebody's file is identified by its bytes alone: a copy of a
    /// project has other times.
    fn is_same(&self, other: &Self) -> bool {
        self.blake3 == other.blake3 && (self.blake3.is_some() || self.stamp == other.stamp)
    }

    fn may_be_asked(&self, asking: Asking, is_needed: bool) -> bool {
        self.blake3.is_none() || (is_needed && matches!(asking, Asking::Run(_)))
    }
}

fn id(path: &Path) -> String {
    path.display().to_string()
}

/// What a stage runs: a path, or the name of a program beside the runner.
fn program_name<'a>(pipeline: &'a Pipeline, stage: &'a str) -> &'a str {
    let origin = origin(pipeline, stage);
    pipeline.stages[origin].run.as_deref().unwrap_or(origin)
}

/// The block that says what a stage runs.
fn origin<'a>(pipeline: &'a Pipeline, stage: &'a str) -> &'a str {
    pipeline.stages[stage].extends.as_deref().unwrap_or(stage)
}

/// The executable of a stage.
pub fn executable(pipeline: &Pipeline, stage: &str) -> PathBuf {
    let name = program_name(pipeline, stage);
    if name.contains('/') {
        let path = pipeline.resolve(origin(pipeline, stage), Part::Field("run"), name);
        return path.canonicalize().unwrap_or(path);
    }
    own_folder().join(name)
}

/// Returns whether a program is one of the runner's own.
pub(crate) fn is_own(path: &Path) -> bool {
    path.parent() == Some(&own_folder())
}

/// The runner's own folder.
fn own_folder() -> PathBuf {
    let exe = std::env::current_exe().and_then(|exe| exe.canonicalize());
    exe.ok().and_then(|exe| exe.parent().map(Path::to_path_buf)).unwrap_or_default()
}

/// What a program is known by; else what is wrong and what to do.
fn identify(path: &Path, name: &str) -> Result<Identity, ProgramError> {
    let fail = |problem: String| ProgramError::File { path: path.to_path_buf(), problem };
    let stamp = std::fs::metadata(path).and_then(|meta| {
        let kind = std::io::ErrorKind::IsADirectory;
        if meta.is_dir() { Err(std::io::Error::from(kind)) } else { Stamp::of(path) }
    });
    match stamp {
        Ok(stamp) if is_own(path) => Ok(Identity { stamp, blake3: None }),
        Ok(stamp) => {
            let hash = hash_file(path).map_err(|e| fail(e.to_string()))?;
            Ok(Identity { stamp, blake3: Some(hash) })
        }
        Err(e) if name.contains('/') => {
            Err(fail(format!("{e}; set `run:` to the stage's executable")))
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            let meant =
                neighbour(name).map(|other| format!("did you mean {other}? ")).unwrap_or_default();
            let remedy = format!("{meant}run `make build`, or set `run:` to another program");
            Err(ProgramError::Unbuilt { path: path.to_path_buf(), remedy })
        }
        Err(e) => Err(fail(e.to_string())),
    }
}

/// The program beside the runner whose name is meant by another.
fn neighbour(name: &str) -> Option<String> {
    let files = std::fs::read_dir(own_folder())
        .ok()?
        .flatten()
        .filter_map(|entry| entry.file_name().into_string().ok());
    let mut programs: Vec<String> = files.filter(|file| !file.contains('.')).collect();
    programs.sort_unstable();
    nearest(name, programs.iter().map(String::as_str)).map(str::to_owned)
}

fn hash_file(path: &Path) -> std::io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(std::fs::File::open(path)?)?;
    Ok(hasher.finalize().to_hex().to_string())
}

//! Checks that a stage's program and inputs stay the same from the computation of the stage's key
//! to the stage's end; otherwise no result is recorded. Local runs and a cluster's jobs share these
//! checks.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use artifact::{Damage, MANIFEST_FILE, Manifest};
use planning::stage_call::StageFailure;
use planning::{
    ConfirmError, HashedInputs, Node, NodeInput, Origin, PlanError, Source, StageProgram, Stamp,
    read_source,
};
use store::{Attempt, Store};

/// A program that was confirmed before its start.
pub(crate) struct ConfirmedProgram<'a> {
    program: &'a StageProgram,
    store: &'a Store,
    stop: &'a AtomicBool,
    stamp: Stamp,
}

impl<'a> ConfirmedProgram<'a> {
    /// Confirms that a program is the planned one.
    pub(crate) fn new(
        program: &'a StageProgram,
        store: &'a Store,
        stop: &'a AtomicBool,
    ) -> Result<Self, StageFailure> {
        let stamp = program.confirm(store, Some(stop)).map_err(|e| confirmation_failure(&e))?;
        Ok(Self { program, store, stop, stamp })
    }

    /// Confirms after the program's end that the program was not changed since [`Self::new`].
    pub(crate) fn confirm_again(&self) -> Result<(), StageFailure> {
        let confirmed = self.program.confirm_since(&self.stamp, self.store, Some(self.stop));
        confirmed.map_err(|e| confirmation_failure(&e))
    }
}

fn confirmation_failure(problem: &ConfirmError) -> StageFailure {
    let is_interrupted = matches!(problem, ConfirmError::Interrupted);
    let code = if is_interrupted { StageFailure::INTERRUPTED } else { 2 };
    StageFailure { code, message: problem.to_string() }
}

/// Returns the failure of a stage whose inputs can't be used.
pub(crate) fn input_failure(problem: &PlanError) -> StageFailure {
    let code = match problem {
        PlanError::Source { .. } | PlanError::Artifact(_) => StageFailure::BAD_INPUT,
        PlanError::Interrupted => StageFailure::INTERRUPTED,
        PlanError::Pipeline(_) | PlanError::Store(_) | PlanError::Usage(_) => 1,
    };
    StageFailure { code, message: problem.to_string() }
}

/// Inputs of a node, as they were when the key was computed.
pub(crate) struct Inputs<'a> {
    node: &'a Node,
    store: &'a Store,
    /// Name and content hash of each input.
    pub(crate) hashes: Vec<(String, String)>,
    sources: BTreeMap<String, Source>,
    artifacts: Vec<StoredInput>,
}

impl<'a> Inputs<'a> {
    /// Reads the [`Stamp`]s of the artifacts' files, and compares the contents with the manifests
    /// unless the program does so itself. `output_of` returns the hash of a parent's artifact.
    pub(crate) fn new(
        node: &'a Node,
        store: &'a Store,
        found: HashedInputs,
        output_of: impl Fn(usize) -> String,
    ) -> Result<Self, StageFailure> {
        let mut artifacts = Vec::new();
        for input in &node.inputs {
            if let Origin::Node { index, subtree } = &input.from {
                let stored = StoredInput::new(store, &output_of(*index), subtree.as_deref());
                artifacts.push(stored.map_err(|e| damage_failure(&e))?);
            }
        }
        let HashedInputs { hashes, sources } = found;
        let inputs = Self { node, store, hashes, sources, artifacts };
        if !node.program.is_own() {
            // The runner's own programs compare files with manifests themselves.
            for artifact in &inputs.artifacts {
                artifact.check_contents().map_err(|e| damage_failure(&e))?;
            }
        }
        Ok(inputs)
    }

    /// Fails if an input was changed since its content was hashed.
    pub(crate) fn check(&self, stop: &AtomicBool) -> Result<(), StageFailure> {
        for NodeInput { name, from } in &self.node.inputs {
            let Origin::Folder(folder) = from else { continue };
            let now = read_source(self.store, self.node, name, folder, Some(stop))
                .map_err(|e| input_failure(&e))?;
            if let Some(change) = now.change_since(&self.sources[name]) {
                let message = format!(
                    "input {name} ({}): {change} since it was hashed, so no result is recorded; \
                    run again",
                    folder.display()
                );
                return Err(StageFailure { code: StageFailure::BAD_INPUT, message });
            }
        }
        self.artifacts.iter().try_for_each(StoredInput::check).map_err(|e| damage_failure(&e))
    }

    /// Removes checkpoints of an earlier attempt if a folder outside the store was written to since
    /// that attempt began: the content is the same now, but the attempt may have read other
    /// content. Returns whether checkpoints were removed.
    pub(crate) fn drop_doubtful_checkpoints(&self, attempt: &Attempt) -> io::Result<bool> {
        let times: BTreeMap<&str, String> = self
            .sources
            .iter()
            .map(|(name, source)| (name.as_str(), source.times_hash()))
            .collect();
        if times.is_empty() {
            return Ok(false);
        }
        let file = attempt.work.with_file_name("inputs.json");
        let text = serde_json::to_string(&times)?;
        let earlier = std::fs::read_to_string(&file).ok();
        let is_doubtful = earlier.is_some_and(|earlier| earlier != text) && attempt.work.exists();
        if is_doubtful {
            std::fs::remove_dir_all(&attempt.work)?;
        }
        std::fs::write(&file, text)?;
        Ok(is_doubtful)
    }
}

fn damage_failure(damage: &Damage) -> StageFailure {
    StageFailure { code: StageFailure::BAD_INPUT, message: damage.to_string() }
}

/// An input from the store.
struct StoredInput {
    folder: PathBuf,
    manifest: Manifest,
    /// Stamps of the manifest's files, in the same order.
    stamps: Vec<Stamp>,
}

impl StoredInput {
    fn new(store: &Store, artifact: &str, subtree: Option<&str>) -> Result<Self, Damage> {
        let (mut folder, mut manifest) = (store.object(artifact), store.manifest(artifact)?);
        if manifest.identity() != artifact {
            return Err(Damage::Content { path: folder.join(MANIFEST_FILE) });
        }
        if let Some(subtree) = subtree {
            (folder, manifest) = (folder.join(subtree), manifest.subtree(subtree));
        }
        let stamps = stamps(&folder, &manifest)?;
        Ok(Self { folder, manifest, stamps })
    }

    /// Fails if the content of a file has changed. Contents are read only if a stamp has changed,
    /// since a backup that creates hard links changes stamps, too.
    fn check(&self) -> Result<(), Damage> {
        let now = stamps(&self.folder, &self.manifest)?;
        let is_untouched =
            now.iter().enumerate().all(|(i, stamp)| stamp.is_untouched_since(&self.stamps[i]));
        if is_untouched { Ok(()) } else { self.check_contents() }
    }

    fn check_contents(&self) -> Result<(), Damage> {
        self.manifest.check_contents(&self.folder)
    }
}

fn stamps(folder: &Path, manifest: &Manifest) -> Result<Vec<Stamp>, Damage> {
    let mut stamps = Vec::with_capacity(manifest.files.len());
    for file in &manifest.files {
        let path = folder.join(&file.path);
        stamps.push(Stamp::of(&path).map_err(|source| Damage::Unreadable { path, source })?);
    }
    Ok(stamps)
}

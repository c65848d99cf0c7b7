//! Checks that a stage's program and inputs stay the same from the computation of the stage's key
//! to the stage's end; otherwise no result is recorded. Local runs and a cluster's jobs share these
//! checks.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use artifact::{Damage, Failure, MANIFEST_FILE, Manifest, write_atomically};
use planning::{HashedInputs, Node, NodeInput, Origin, Source, StageProgram, Stamp, read_source};
use store::{Attempt, Store};

/// Calls a program if it is the planned one, and fails if it was changed until its end. Only a
/// second signal interrupts the latter check: the first one must not cost a result.
pub(crate) fn call_confirmed<T>(
    program: &StageProgram,
    store: &Store,
    stop: &AtomicBool,
    call: impl FnOnce() -> anyhow::Result<T>,
) -> anyhow::Result<T> {
    let start = program.confirm(store, Some(stop))?;
    let result = call()?;
    program.confirm_since(&start, store, None)?;
    Ok(result)
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
    ) -> Result<Self, Failure> {
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
                let checked = artifact.manifest.check_contents(&artifact.folder);
                checked.map_err(|e| damage_failure(&e))?;
            }
        }
        Ok(inputs)
    }

    /// Fails if an input was changed since its content was hashed.
    pub(crate) fn check(&self, stop: &AtomicBool) -> anyhow::Result<()> {
        match self.find_change(Some(stop))? {
            None => Ok(()),
            Some(change) => Err(change.into()),
        }
    }

    /// Checks the inputs like [`Self::check`] after the stage's end. If an input was changed,
    /// removes the attempt's checkpoints: they may contain the changed input, even if it gets its
    /// old content back. Only a second signal interrupts this: the first one must not cost a
    /// result.
    pub(crate) fn check_again(&self, attempt: &Attempt) -> anyhow::Result<()> {
        let Some(change) = self.find_change(None)? else { return Ok(()) };
        attempt.remove_checkpoints()?;
        Err(change.into())
    }

    /// Returns the failure for an input that was changed since its content was hashed. Fails if an
    /// input can't be compared: an unreadable one may be unchanged.
    fn find_change(&self, stop: Option<&AtomicBool>) -> anyhow::Result<Option<Failure>> {
        for NodeInput { name, from } in &self.node.inputs {
            let Origin::Folder(folder) = from else { continue };
            let now = read_source(self.store, self.node, name, folder, stop)?;
            if let Some(change) = now.change_since(&self.sources[name]) {
                let problem = format!(
                    "input {name} ({}): {change} since it was hashed, so no result is recorded; \
                    run again",
                    folder.display()
                );
                return Ok(Some(Failure::BadInput(problem)));
            }
        }
        match self.artifacts.iter().try_for_each(StoredInput::check) {
            Ok(()) => Ok(None),
            Err(unreadable @ Damage::Unreadable { .. }) => Err(damage_failure(&unreadable).into()),
            Err(damage) => Ok(Some(damage_failure(&damage))),
        }
    }

    /// Removes checkpoints of an earlier attempt if a folder outside the store was written to since
    /// that attempt began: the content is the same now, but the attempt may have read other
    /// content. Returns whether checkpoints were removed.
    pub(crate) fn drop_doubtful_checkpoints(&self, attempt: &Attempt) -> anyhow::Result<bool> {
        let sources = self.sources.iter();
        let times: BTreeMap<String, String> =
            sources.map(|(name, source)| (name.clone(), source.times_hash())).collect();
        if times.is_empty() {
            return Ok(false);
        }
        let file = attempt.work.with_file_name("inputs.json");
        let earlier: Option<BTreeMap<String, String>> =
            std::fs::read(&file).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok());
        if earlier.as_ref() == Some(&times) {
            return Ok(false);
        }
        let is_doubtful = earlier.is_some() && attempt.work.exists();
        if is_doubtful {
            attempt.remove_checkpoints()?;
        }
        write_atomically(&file, serde_json::to_string(&times)?.as_bytes())?;
        Ok(is_doubtful)
    }
}

fn damage_failure(damage: &Damage) -> Failure {
    Failure::BadInput(damage.to_string())
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
        if is_untouched { Ok(()) } else { self.manifest.check_contents(&self.folder) }
    }
}

fn stamps(folder: &Path, manifest: &Manifest) -> Result<Vec<Stamp>, Damage> {
    let paths = manifest.files.iter().map(|file| folder.join(&file.path));
    paths
        .map(|path| Stamp::of(&path).map_err(|source| Damage::Unreadable { path, source }))
        .collect()
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::MetadataExt as _;

    use planning::{Pipeline, Plan, Request, hash_inputs};
    use serde_json::json;
    use store::{Locked, Unfinished};

    use super::*;

    /// Returns a node that reads the folder `data`, a store, and an attempt with a checkpoint.
    fn attempt(dir: &Path) -> (Node, Store, Attempt) {
        fs::create_dir(dir.join("data")).unwrap();
        fs::write(dir.join("data/x"), "1").unwrap();
        let pipeline = "default: [make]\nstages: {make: {inputs: {data: ./data}}}";
        let pipeline = Pipeline::parse(pipeline.as_bytes(), &dir.join("pipeline.yaml")).unwrap();
        let description = serde_json::from_value(json!({"name": "make", "version": "",
            "code": "", "summary": "", "parameters": {}, "output": {"kind": "x"},
            "inputs": {"data": {"kinds": ["x"], "summary": ""}}}));
        let descriptions = BTreeMap::from([("make".to_owned(), description.unwrap())]);
        let request = Request { targets: vec!["make".to_owned()], ..Request::default() };
        let mut plan = Plan::from_descriptions(&pipeline, &descriptions, &request).unwrap();
        let store = Store::open(&dir.join("store")).unwrap();
        let Locked::Acquired(entered) = store.try_enter().unwrap() else { panic!("closed") };
        let attempt = store.begin(&entered, &Unfinished::default(), &json!({})).unwrap();
        fs::create_dir(&attempt.work).unwrap();
        (plan.nodes.remove(0), store, attempt)
    }

    fn inputs<'a>(node: &'a Node, store: &'a Store) -> Inputs<'a> {
        let found = hash_inputs(node, store, None, |_| String::new()).unwrap();
        Inputs::new(node, store, found, |_| String::new()).unwrap()
    }

    #[test]
    fn checkpoints_are_dropped_only_after_a_change() {
        let dir = tempfile::tempdir().unwrap();
        let (node, store, attempt) = attempt(dir.path());
        let (data, away) = (dir.path().join("data"), dir.path().join("away"));
        let before = inputs(&node, &store);
        before.check_again(&attempt).unwrap();
        fs::rename(&data, &away).unwrap();
        let message = before.check_again(&attempt).unwrap_err().to_string();
        assert!(message.contains("no such folder") && attempt.work.exists(), "{message}");
        fs::rename(&away, &data).unwrap();
        fs::write(data.join("x"), "2").unwrap();
        let message = before.check_again(&attempt).unwrap_err().to_string();
        assert!(message.contains("x was changed") && !attempt.work.exists(), "{message}");
    }

    #[test]
    fn a_damaged_list_of_inputs_keeps_the_checkpoints() {
        let dir = tempfile::tempdir().unwrap();
        let (node, store, attempt) = attempt(dir.path());
        let is_dropped = || inputs(&node, &store).drop_doubtful_checkpoints(&attempt).unwrap();
        let list = attempt.work.with_file_name("inputs.json");
        assert!(!is_dropped());
        let file = fs::metadata(&list).unwrap().ino();
        assert!(!is_dropped() && fs::metadata(&list).unwrap().ino() == file, "not rewritten");
        fs::write(&list, "{\"da").unwrap();
        assert!(!is_dropped() && attempt.work.exists());
        fs::write(dir.path().join("data/x"), "1").unwrap();
        assert!(is_dropped() && !attempt.work.exists());
    }
}

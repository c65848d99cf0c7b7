use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use artifact::{Damage, Failure, FileEntry, MANIFEST_FILE, Manifest, relative_path, report_line};
use store::{Arrival, Entered, Locked, Record, RunFile, Store, StoreError, is_hash};

/// Maximum size of a record in bytes; usual ones have a few kilobytes. Chosen by hand.
pub(crate) const MAX_RECORD_BYTES: u64 = 4 << 20;
/// Maximum size of a manifest in bytes; usual ones have about 150 bytes per file. Chosen by hand.
pub(crate) const MAX_MANIFEST_BYTES: u64 = 64 << 20;

/// Maximum number of components of a path. `std::fs::remove_dir_all` opens all folders of a path at
/// once, and many systems limit a process to 1024 open files. Chosen by hand.
const MAX_DEPTH: usize = 100;
/// Maximum number of characters of a refused path in a message. Chosen by hand.
const MAX_QUOTED_CHARACTERS: usize = 200;
/// Maximum length of a path in bytes, which leaves most of the system's 4096 to the folders above.
/// Chosen by hand.
const MAX_PATH_BYTES: usize = 1000;

/// Import of artifacts into a store. The store records the import as a run, so that garbage
/// collection keeps the imported artifacts, and deletes the leftovers of a killed import.
pub(crate) struct Intake {
    pub(crate) store: Store,
    run: Option<RunFile>,
    folder: PathBuf,
    stop: Arc<AtomicBool>,
}

impl Intake {
    pub(crate) fn begin(store: &Store, stop: &Arc<AtomicBool>) -> anyhow::Result<Self> {
        let run = protect(store, [], stop)?;
        let folder = store.scratch(run.id());
        Ok(Self { store: store.clone(), run: Some(run), folder, stop: Arc::clone(stop) })
    }

    /// Returns the folder in which an artifact is assembled.
    pub(crate) fn scratch(&self, identity: &str) -> PathBuf {
        self.folder.join(identity)
    }

    /// Writes a manifest from a remote or an archive, called `name` in messages, to an artifact's
    /// scratch folder, and reads it.
    pub(crate) fn add_manifest(
        &self,
        identity: &str,
        bytes: &[u8],
        name: &str,
    ) -> anyhow::Result<Manifest> {
        let folder = self.scratch(identity);
        let path = folder.join(MANIFEST_FILE);
        fs::create_dir_all(&folder)
            .and_then(|()| fs::write(&path, bytes))
            .with_context(|| path.display().to_string())?;
        Ok(read_manifest(&folder, identity, name)?)
    }

    /// Imports an object, if given, then its records. Returns the number of new records.
    pub(crate) fn import(
        &self,
        arrival: Option<&Arrival>,
        records: &[Record],
    ) -> anyhow::Result<usize> {
        let entered = enter(&self.store, &self.stop)?;
        if let Some(arrival) = arrival {
            self.store.import_object(&entered, arrival)?;
        }
        let mut new = 0;
        for record in records {
            if let Some(run) = &self.run {
                run.record_action(&entered, &record.stage, &record.key())?;
            }
            new += usize::from(self.store.import_record(&entered, record)?);
        }
        Ok(new)
    }

    /// Records the end of the import.
    pub(crate) fn end(mut self) -> anyhow::Result<()> {
        Ok(self.run.take().map_or(Ok(()), RunFile::end)?)
    }
}

impl Drop for Intake {
    fn drop(&mut self) {
        // Garbage collection removes the folder if this fails.
        fs::remove_dir_all(&self.folder).ok();
    }
}

/// Enters the store; waits until garbage collection has finished.
pub(crate) fn enter(store: &Store, stop: &AtomicBool) -> anyhow::Result<Entered> {
    let start = Instant::now();
    let mut is_reported = false;
    loop {
        if let Locked::Acquired(entered) = store.try_enter()? {
            return Ok(entered);
        }
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted.into());
        }
        if !is_reported && start.elapsed() > Duration::from_secs(1) {
            is_reported = true;
            report_line!("waiting for garbage collection");
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Begins a run that lists the actions of records, which protects them from garbage collection.
pub(crate) fn protect<'a>(
    store: &Store,
    records: impl IntoIterator<Item = &'a Record>,
    stop: &AtomicBool,
) -> anyhow::Result<RunFile> {
    let entered = enter(store, stop)?;
    let run = store.begin_run(&entered, std::env::args().collect())?;
    for record in records {
        if let Err(error) = run.record_action(&entered, &record.stage, &record.key()) {
            // The first error is reported, even if the clean-up fails.
            unprotect(store, run).ok();
            return Err(error.into());
        }
    }
    Ok(run)
}

/// Ends a run and removes it, so that garbage collection doesn't keep the actions as those of a
/// recent run.
pub(crate) fn unprotect(store: &Store, run: RunFile) -> Result<(), StoreError> {
    let id = run.id().to_owned();
    let ended = run.end();
    store.remove_run(&id).ok();
    ended
}

/// Parses a record from a remote or an archive, called `name` in messages. Fails if its key differs
/// from `key`, or if `made_of` or `output`, which become parts of paths, contain anything but
/// hashes.
pub(crate) fn parse_record(bytes: &[u8], key: &str, name: &str) -> Result<Record, Failure> {
    let problem = match serde_json::from_slice::<Record>(bytes) {
        Err(error) => format!("not a record: {error}"),
        Ok(record) if record.key() != key => {
            "the content has changed (its key differs from its name)".to_owned()
        }
        Ok(record) => {
            let invalid = record.made_of.iter().chain([&record.output]).find(|name| !is_hash(name));
            match invalid.cloned() {
                Some(name) => format!("{name:?} is not a hash"),
                None => return Ok(record),
            }
        }
    };
    Err(Failure::BadInput(format!("{name}: {problem}")))
}

/// Reads a manifest, called `name` in messages, in a scratch folder. Fails if its identity differs,
/// or if it contains paths that nerf-sr doesn't write.
pub(crate) fn read_manifest(
    folder: &Path,
    identity: &str,
    name: &str,
) -> Result<Manifest, Failure> {
    let problem = match Manifest::read(folder) {
        Err(Damage::Manifest { reason, .. }) => format!("not a manifest: {reason}"),
        Err(damage) => damage.to_string(),
        Ok(manifest) if manifest.identity() != identity => {
            "the content has changed (its blake3 differs from the artifact's name)".to_owned()
        }
        Ok(manifest) => match manifest_problem(&manifest) {
            Some(problem) => problem,
            None => return Ok(manifest),
        },
    };
    Err(Failure::BadInput(format!("{name}: {problem}")))
}

/// Describes why a manifest can't be an artifact's: its total size, or its first invalid path.
fn manifest_problem(manifest: &Manifest) -> Option<String> {
    let mut total: u64 = 0;
    for file in &manifest.files {
        let Some(sum) = total.checked_add(file.size) else {
            return Some("the total size exceeds 64 bits".to_owned());
        };
        total = sum;
    }
    let file = manifest.files.iter().find(|file| !has_valid_path(file))?;
    let path: String = file.path.chars().take(MAX_QUOTED_CHARACTERS).collect();
    Some(format!("{path:?} is not the path of an artifact's file"))
}

/// Returns whether nerf-sr writes such a path, and it can be created and removed again.
fn has_valid_path(file: &FileEntry) -> bool {
    file.path != MANIFEST_FILE
        && file.path.len() <= MAX_PATH_BYTES
        && relative_path(&file.path).is_ok_and(|path| path.to_str() == Some(file.path.as_str()))
        && file.path.split('/').count() <= MAX_DEPTH
}

/// Creates a file of an artifact in a scratch folder. A path that the file system doesn't support
/// is bad input; any other error would concern all files.
pub(crate) fn create_file(path: &Path) -> anyhow::Result<File> {
    let folder = path.parent().unwrap_or(path);
    fs::create_dir_all(folder).and_then(|()| File::create_new(path)).map_err(|error| {
        let name = path.display().to_string();
        match error.kind() {
            ErrorKind::InvalidFilename
            | ErrorKind::InvalidInput
            | ErrorKind::AlreadyExists
            | ErrorKind::NotADirectory
            | ErrorKind::IsADirectory => Failure::BadInput(format!("{name}: {error}")).into(),
            _ => anyhow::Error::new(error).context(name),
        }
    })
}

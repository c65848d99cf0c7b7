use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use artifact::{Damage, Failure, FileEntry, MANIFEST_FILE, Manifest, relative_path, report_line};
use store::{Arrival, Entered, Locked, Record, RunFile, Store, is_hash};

/// A record is a few kilobytes.
pub(crate) const RECORD_LIMIT: u64 = 4 << 20;
/// A manifest has some 150 bytes a file.
pub(crate) const MANIFEST_LIMIT: u64 = 64 << 20;

/// Maximum number of folders in a path, with the file. `std::fs::remove_dir_all` keeps each folder
/// on its way open, and a process may often open 1024 files.
const MAX_DEPTH: usize = 100;
/// Maximum number of characters of a refused path in a message.
const SHOWN_CHARS: usize = 200;
/// Maximum length of a path, in bytes: the folders above also need some of the system's 4096.
const MAX_PATH_BYTES: usize = 1000;

/// What is being copied into a store. It is a run: garbage collection leaves alone what a run
/// needs, and clears what a killed one left behind.
pub(crate) struct Intake {
    pub(crate) store: Store,
    run: Option<RunFile>,
    folder: PathBuf,
    stop: Arc<AtomicBool>,
}

impl Intake {
    pub(crate) fn begin(store: &Store, stop: &Arc<AtomicBool>) -> anyhow::Result<Self> {
        let run = store.begin_run(&entered(store, stop)?, std::env::args().collect())?;
        let folder = store.scratch(run.id());
        Ok(Self { store: store.clone(), run: Some(run), folder, stop: Arc::clone(stop) })
    }

    /// Where an artifact is put together.
    pub(crate) fn scratch(&self, identity: &str) -> PathBuf {
        self.folder.join(identity)
    }

    /// Takes in an object, if one is given, then its records; how many of these are new.
    pub(crate) fn take_in(
        &self,
        arrival: Option<&Arrival>,
        records: &[Record],
    ) -> anyhow::Result<usize> {
        let entered = entered(&self.store, &self.stop)?;
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

    /// All is there.
    pub(crate) fn end(mut self) -> anyhow::Result<()> {
        Ok(self.run.take().map_or(Ok(()), RunFile::end)?)
    }
}

impl Drop for Intake {
    fn drop(&mut self) {
        // What is left over has no value, and is cleared with the run's file at the latest.
        std::fs::remove_dir_all(&self.folder).ok();
    }
}

/// Enters the store; waits while garbage is collected.
pub(crate) fn entered(store: &Store, stop: &AtomicBool) -> anyhow::Result<Entered> {
    let (since, mut is_said) = (Instant::now(), false);
    loop {
        match store.try_enter()? {
            Locked::Acquired(entered) => return Ok(entered),
            Locked::HeldBy(_) if stop.load(Ordering::Relaxed) => {
                return Err(Failure::Interrupted.into());
            }
            Locked::HeldBy(_) => {}
        }
        if !is_said && since.elapsed() > Duration::from_secs(1) {
            is_said = true;
            report_line!("waits for garbage collection");
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A record from elsewhere: of this key, and with names that paths may be made of.
pub(crate) fn read_record(bytes: &[u8], key: &str, name: &str) -> anyhow::Result<Record> {
    let refuse = |reason: String| Failure::BadInput(format!("{name}: {reason}"));
    let record: Record =
        serde_json::from_slice(bytes).map_err(|e| refuse(format!("not a record: {e}")))?;
    if record.key() != key {
        return Err(refuse(
            "the content is not what was written (its key is not its name)".to_owned(),
        )
        .into());
    }
    match std::iter::once(&record.output).chain(&record.made_of).find(|name| !is_hash(name)) {
        Some(name) => Err(refuse(format!("{name:?} is not a hash")).into()),
        None => Ok(record),
    }
}

/// The manifest from elsewhere in a scratch folder: of this identity, and with paths as nerf-sr
/// writes them.
pub(crate) fn read_manifest(folder: &Path, identity: &str, name: &str) -> anyhow::Result<Manifest> {
    let refuse = |reason: String| Failure::BadInput(format!("{name}: {reason}"));
    let manifest = Manifest::read(folder).map_err(|damage| match damage {
        Damage::Manifest { reason, .. } => refuse(format!("not a manifest: {reason}")),
        other => refuse(other.to_string()),
    })?;
    if manifest.identity() != identity {
        return Err(refuse(
            "the content is not what was written (its blake3 is not the artifact's name)"
                .to_owned(),
        )
        .into());
    }
    if manifest.files.iter().try_fold(0_u64, |sum, file| sum.checked_add(file.size)).is_none() {
        return Err(refuse("sizes that no disk has".to_owned()).into());
    }
    match manifest.files.iter().find(|file| !is_plain(file)) {
        Some(file) => {
            let path: String = file.path.chars().take(SHOWN_CHARS).collect();
            Err(refuse(format!("{path:?} is not the path of an artifact's file")).into())
        }
        None => Ok(manifest),
    }
}

/// Returns whether a path is one as nerf-sr writes them, and can be created and removed again.
fn is_plain(file: &FileEntry) -> bool {
    file.path != MANIFEST_FILE
        && file.path.len() <= MAX_PATH_BYTES
        && relative_path(&file.path).is_ok_and(|path| path.to_str() == Some(file.path.as_str()))
        && file.path.split('/').count() <= MAX_DEPTH
}

/// Creates a file of an artifact in a scratch folder. A path that this file system doesn't take is
/// the sender's mistake; any other failure would meet all files.
pub(crate) fn create(path: &Path) -> anyhow::Result<File> {
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

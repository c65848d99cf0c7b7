//! A folder as a remote: the parts that `object_store` doesn't provide.
//!
//! `object_store` reads and writes files, but blocks on named pipes, and ends a listing at the
//! first unreadable entry. Here one bad entry doesn't affect the others. Each push also has a
//! folder for incomplete files, which `object_store` would leave next to complete ones when it is
//! killed.

use std::fs;
use std::io;
use std::path::{Path as FilePath, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use artifact::{Failure, file_kind, temporary};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use store::is_hash;
use tempfile::TempDir;

/// Folder of a remote with uploads in progress.
const UPLOADS: &str = "uploads";
/// Prefix and suffix of a push's folder in [`UPLOADS`].
const UPLOAD_AFFIXES: Affixes = ("push-", "");

/// Folder that is a remote.
#[derive(Clone, Debug)]
pub(crate) struct Folder {
    root: PathBuf,
    files: LocalFileSystem,
    /// Incomplete files of a push; `None` for other commands.
    uploads: Option<Arc<Uploads>>,
}

/// Folder with incomplete files of a push, removed with this value.
#[derive(Debug)]
struct Uploads {
    folder: TempDir,
    /// Number of files so far, which is the next file's name.
    count: AtomicU64,
}

impl Folder {
    pub(crate) fn new(root: &FilePath, files: LocalFileSystem) -> Self {
        Self { root: root.to_path_buf(), files, uploads: None }
    }

    /// Prepares the folder for a push.
    pub(crate) fn for_push(mut self) -> io::Result<Self> {
        let uploads = self.root.join(UPLOADS);
        fs::create_dir_all(&uploads)?;
        remove_leftovers(&uploads, UPLOAD_AFFIXES);
        let folder = temporary(0o777).prefix(UPLOAD_AFFIXES.0).tempdir_in(uploads)?;
        self.uploads = Some(Arc::new(Uploads { folder, count: AtomicU64::new(0) }));
        Ok(self)
    }

    /// Returns whether a file exists, called `name` in messages. Fails for anything but a regular
    /// file.
    pub(crate) fn has_file(&self, file: &Path, name: &str) -> anyhow::Result<bool> {
        let problem = match fs::metadata(self.files.path_to_filesystem(file)?) {
            Ok(found) if found.is_file() => return Ok(true),
            Ok(found) => format!("{name} is {}, not a regular file", file_kind(found.file_type())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
            Err(error) => format!("{name}: {error}"),
        };
        Err(Failure::BadInput(problem).into())
    }

    /// Returns whether a file of the given size exists.
    pub(crate) fn has_file_of_size(&self, file: &Path, size: u64) -> bool {
        let found =
            self.files.path_to_filesystem(file).ok().and_then(|path| fs::metadata(path).ok());
        found.is_some_and(|found| found.is_file() && found.len() == size)
    }

    /// Lists the records. Every entry that is neither a record nor a regular file is invalid.
    pub(crate) fn records(&self) -> anyhow::Result<Listing> {
        let folder = self.root.join(ACTIONS);
        let mut listing = Listing::default();
        let entries = match fs::read_dir(&folder) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(listing),
            entries => entries.with_context(|| folder.display().to_string())?,
        };
        for entry in entries {
            let path = entry.with_context(|| folder.display().to_string())?.path();
            let name = path.file_name().unwrap_or_default();
            let is_regular = fs::metadata(&path).is_ok_and(|found| found.is_file());
            match name.to_str() {
                // The file type of a record is checked when it is read.
                Some(name) if name.ends_with(".json") || is_regular => listing.add(name),
                _ => listing.invalid.push(name.to_string_lossy().into_owned()),
            }
        }
        Ok(listing)
    }

    /// Returns a new path for an incomplete file, which is renamed later; `None` unless pushing.
    pub(crate) fn staged_path(&self) -> Option<Path> {
        let Uploads { folder, count } = self.uploads.as_deref()?;
        let name = folder.path().file_name()?.to_str()?;
        let number = count.fetch_add(1, Ordering::Relaxed);
        Some(Path::from_iter([UPLOADS, name, &number.to_string()]))
    }
}

/// Folder of a remote with its records.
pub(crate) const ACTIONS: &str = "actions";

/// Entries of a remote's folder of records.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Listing {
    /// Keys of the records, sorted.
    pub(crate) keys: Vec<String>,
    /// Names that can't be a record's, sorted.
    pub(crate) invalid: Vec<String>,
}

impl Listing {
    /// Adds a file. Hidden files, logs and notes are allowed and ignored.
    pub(crate) fn add(&mut self, name: &str) {
        match name.strip_suffix(".json") {
            Some(key) if is_hash(key) => self.keys.push(key.to_owned()),
            Some(_) if !name.starts_with('.') => self.invalid.push(name.to_owned()),
            _ => {}
        }
    }

    pub(crate) fn sort(&mut self) {
        self.keys.sort_unstable();
        self.invalid.sort_unstable();
    }
}

/// Idle time after which the process of a temporary file counts as killed. A live process writes
/// many times a second; the margin, chosen by hand, covers clock differences and suspended
/// machines.
const MIN_IDLE_TIME: Duration = Duration::from_secs(3600);

/// Prefix and suffix of the names of temporary files.
pub(crate) type Affixes = (&'static str, &'static str);

/// Removes the temporary files and folders of killed commands from a folder. Errors are ignored,
/// since leftovers are harmless.
pub(crate) fn remove_leftovers(folder: &FilePath, (prefix, suffix): Affixes) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let (name, path) = (entry.file_name(), entry.path());
        let matches = name.to_str().is_some_and(|n| n.starts_with(prefix) && n.ends_with(suffix));
        if matches && is_idle(&path) {
            let is_folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
            if is_folder { fs::remove_dir_all(&path) } else { fs::remove_file(&path) }.ok();
        }
    }
}

/// Returns whether a file, or a folder with all its files, is unchanged for [`MIN_IDLE_TIME`].
fn is_idle(path: &FilePath) -> bool {
    let mut entries = walkdir::WalkDir::new(path).into_iter();
    entries.all(|entry| {
        let modified = entry.ok().and_then(|entry| entry.metadata().ok()?.modified().ok());
        let idle = modified.and_then(|time| time.elapsed().ok());
        idle.is_some_and(|idle| idle >= MIN_IDLE_TIME)
    })
}

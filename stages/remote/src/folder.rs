//! A remote that is a folder. `object_store` reads and writes its files, but waits for named pipes,
//! and ends a listing at the first entry that it can't read. What is here keeps one bad entry from
//! stopping all else. It also gives each push a folder of its own for files that aren't whole yet:
//! `object_store` alone would leave them beside the whole ones when it is killed.

use std::fs;
use std::io;
use std::path::{Path as FilePath, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::Context as _;
use artifact::{Failure, file_kind, temporary};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use tempfile::TempDir;

use crate::leftovers::{Affixes, remove_leftovers};
use crate::listing::{ACTIONS, Listing};

/// Folder of a remote with the uploads in progress.
const UPLOADS: &str = "uploads";
/// Name of a push's folder there.
const UPLOAD: Affixes = ("push-", "");

/// Folder of a remote.
#[derive(Clone, Debug)]
pub(crate) struct Folder {
    root: PathBuf,
    files: LocalFileSystem,
    /// Only of a push.
    uploads: Option<Arc<Uploads>>,
}

/// Files of a push that aren't whole yet; the folder is removed with this value.
#[derive(Debug)]
struct Uploads {
    folder: TempDir,
    /// Number of files so far: their names.
    count: AtomicU64,
}

impl Folder {
    pub(crate) fn new(root: &FilePath, files: LocalFileSystem) -> Self {
        Self { root: root.to_path_buf(), files, uploads: None }
    }

    /// The folder for a push.
    pub(crate) fn for_push(mut self) -> io::Result<Self> {
        let uploads = self.root.join(UPLOADS);
        fs::create_dir_all(&uploads)?;
        remove_leftovers(&uploads, UPLOAD);
        let folder = temporary(0o777).prefix(UPLOAD.0).tempdir_in(uploads)?;
        self.uploads = Some(Arc::new(Uploads { folder, count: AtomicU64::new(0) }));
        Ok(self)
    }

    /// Returns whether a file exists. Fails if its path names something else than a regular file;
    /// `name` is the file's name in the message.
    pub(crate) fn has(&self, file: &Path, name: &str) -> anyhow::Result<bool> {
        let problem = match fs::metadata(self.files.path_to_filesystem(file)?) {
            Ok(found) if found.is_file() => return Ok(true),
            Ok(found) => format!("{name} is {}, not a regular file", file_kind(found.file_type())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
            Err(error) => format!("{name}: {error}"),
        };
        Err(Failure::BadInput(problem).into())
    }

    /// Returns whether a file of this size exists.
    pub(crate) fn has_size(&self, file: &Path, size: u64) -> bool {
        let found =
            self.files.path_to_filesystem(file).ok().and_then(|path| fs::metadata(path).ok());
        found.is_some_and(|found| found.is_file() && found.len() == size)
    }

    /// Lists the records. Any entry that is neither a record nor a regular file is odd.
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
            match name.to_str() {
                // Reading a record finds out what kind of file it is.
                Some(name) if name.ends_with(".json") || is_regular(&path) => listing.add(name),
                _ => listing.odd.push(name.to_string_lossy().into_owned()),
            }
        }
        Ok(listing)
    }

    /// Returns the path under which a file is written before it is renamed.
    pub(crate) fn staged(&self) -> Option<Path> {
        let Uploads { folder, count } = self.uploads.as_deref()?;
        let name = folder.path().file_name()?.to_str()?;
        let number = count.fetch_add(1, Ordering::Relaxed);
        Some(Path::from_iter([UPLOADS, name, &number.to_string()]))
    }
}

fn is_regular(path: &FilePath) -> bool {
    fs::metadata(path).is_ok_and(|found| found.is_file())
}

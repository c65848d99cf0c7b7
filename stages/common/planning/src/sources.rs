//! Folders outside the store: content hashes of their files, and whether they stay as they were.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

use artifact::{FileEntry, hash_json, list_source_files, report_line, sized, write_atomically};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use store::Store;

use crate::stamp::Stamp;

/// Interval between two looks at the signals' flag.
const LOOK_INTERVAL: Duration = Duration::from_millis(20);
/// Reading that takes longer than this is reported; again after twice the time, and so on.
const NOTICE_AFTER: Duration = Duration::from_secs(2);

/// A folder outside the store that has no content hash.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// It can't be found.
    #[error("{folder:?}: {problem}; name a folder that is there")]
    Absent {
        /// The folder.
        folder: PathBuf,
        /// Why.
        problem: io::Error,
    },
    /// It isn't a folder.
    #[error("{0:?}: not a folder")]
    NoFolder(PathBuf),
    /// A file in it can't be read.
    #[error("{folder:?}: {problem}")]
    Unreadable {
        /// The folder.
        folder: PathBuf,
        /// Why.
        problem: io::Error,
    },
    /// A file changed while the folder was hashed.
    #[error("{folder:?}: {change} while it was hashed; run again when nothing writes there")]
    Changing {
        /// The folder.
        folder: PathBuf,
        /// File and change, as text.
        change: String,
    },
    /// A signal came.
    #[error("interrupted")]
    Interrupted,
}

/// A folder outside the store as it was when it was read.
#[derive(Clone, Debug, PartialEq)]
pub struct Source {
    /// Files by their paths inside the folder.
    files: BTreeMap<String, SourceFile>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct SourceFile {
    #[serde(flatten)]
    stamp: Stamp,
    blake3: String,
}

impl Source {
    /// Reads a folder. Files that the store's cache knows by their stamps aren't hashed again.
    /// Reports progress if hashing takes long, and ends soon after `stop` is set.
    pub fn read(
        store: &Store,
        folder: &Path,
        stop: Option<&AtomicBool>,
    ) -> Result<Self, SourceError> {
        let absolute = folder
            .canonicalize()
            .map_err(|problem| SourceError::Absent { folder: folder.to_path_buf(), problem })?;
        if !absolute.is_dir() {
            return Err(SourceError::NoFolder(folder.to_path_buf()));
        }
        let cache = CacheFile::new(store, &absolute);
        let progress = Arc::new(HashProgress::default());
        let (sender, receiver) = mpsc::channel();
        let shared = Arc::clone(&progress);
        // A thread of its own, which may wait for a dead file server for ever.
        std::thread::spawn(move || sender.send(read(&absolute, &cache, &shared)));
        let (begun, mut notice) = (Instant::now(), NOTICE_AFTER);
        loop {
            match receiver.recv_timeout(LOOK_INTERVAL) {
                Ok(result) => return result.map_err(|failure| failure.at(folder)),
                Err(RecvTimeoutError::Disconnected) => return Err(SourceError::Interrupted),
                Err(RecvTimeoutError::Timeout) => {}
            }
            if stop.is_some_and(|stop| stop.load(Ordering::Relaxed)) {
                progress.is_abandoned.store(true, Ordering::Relaxed);
                return Err(SourceError::Interrupted);
            }
            if begun.elapsed() >= notice {
                report_line!("{}", progress.words(folder));
                notice *= 2;
            }
        }
    }

    /// Returns the content hash: that of each file's path, size and hash.
    pub fn content(&self) -> String {
        let entries: Vec<FileEntry> = self
            .files
            .iter()
            .map(|(path, file)| FileEntry {
                path: path.clone(),
                size: file.stamp.size,
                blake3: file.blake3.clone(),
            })
            .collect();
        hash_json(&entries)
    }

    /// Returns a hash of each file's path, size and time of its content's last change. A copy that
    /// keeps times has the same.
    pub fn times(&self) -> String {
        let files: Vec<_> =
            self.files.iter().map(|(path, file)| (path, file.stamp.of_content())).collect();
        hash_json(&files)
    }

    /// Returns the first file that was changed, added or removed since an earlier reading, as text.
    /// A file that has its earlier content again counts as changed: what a stage read in between
    /// isn't known.
    pub fn change_since(&self, earlier: &Self) -> Option<String> {
        first_change(&earlier.files, &self.files, |before, now| {
            now.stamp.is_untouched_since(&before.stamp) && now.blake3 == before.blake3
        })
    }
}

/// Finds the first name at which two lists differ. Returns the difference as text.
fn first_change<T>(
    before: &BTreeMap<String, T>,
    now: &BTreeMap<String, T>,
    is_same: impl Fn(&T, &T) -> bool,
) -> Option<String> {
    let changed = before.iter().find_map(|(name, old)| match now.get(name) {
        None => Some(format!("{name} was removed")),
        Some(new) if !is_same(old, new) => Some(format!("{name} was changed")),
        Some(_) => None,
    });
    let added = || now.keys().find(|name| !before.contains_key(*name));
    changed.or_else(|| added().map(|name| format!("{name} was added")))
}

/// Progress of hashing a folder.
#[derive(Default)]
struct HashProgress {
    /// Bytes hashed.
    done: AtomicU64,
    /// Bytes to hash in all; 0 while files are listed.
    total: AtomicU64,
    /// True once nobody waits for the hash any more.
    is_abandoned: AtomicBool,
}

impl HashProgress {
    fn words(&self, folder: &Path) -> String {
        let (done, total) = (self.done.load(Ordering::Relaxed), self.total.load(Ordering::Relaxed));
        if total == 0 {
            return format!("listing the files of {}", folder.display());
        }
        format!("hashing {}: {} of {}", folder.display(), sized(done), sized(total))
    }
}

/// Error returned when a folder's files can't be hashed.
enum ReadFailure {
    Unreadable(io::Error),
    Changing(String),
}

impl ReadFailure {
    fn at(self, folder: &Path) -> SourceError {
        let folder = folder.to_path_buf();
        match self {
            Self::Unreadable(problem) => SourceError::Unreadable { folder, problem },
            Self::Changing(change) => SourceError::Changing { folder, change },
        }
    }
}

impl From<io::Error> for ReadFailure {
    fn from(problem: io::Error) -> Self {
        Self::Unreadable(problem)
    }
}

/// Paths and stamps of files, by their paths inside a folder.
type Listing = BTreeMap<String, (PathBuf, Stamp)>;

fn list(folder: &Path) -> io::Result<Listing> {
    let files = list_source_files(folder)?.0.into_iter();
    files
        .map(|(relative, file)| {
            let stamp = Stamp::of(&file).map_err(|e| naming(&file, &e))?;
            Ok((name_of(&relative), (file, stamp)))
        })
        .collect()
}

fn naming(file: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", file.display()))
}

fn read(folder: &Path, cache: &CacheFile, progress: &HashProgress) -> Result<Source, ReadFailure> {
    let listing = list(folder)?;
    let mut files = cache.files();
    files.retain(|name, file| listing.get(name).is_some_and(|(_, stamp)| *stamp == file.stamp));
    let unknown: Vec<(&String, &(PathBuf, Stamp))> =
        listing.iter().filter(|(name, _)| !files.contains_key(*name)).collect();
    if unknown.is_empty() {
        return Ok(Source { files });
    }
    progress.total.store(unknown.iter().map(|(_, (_, s))| s.size).sum(), Ordering::Relaxed);
    let hashed: Vec<(String, SourceFile)> = unknown
        .into_par_iter()
        .map(|(name, (file, stamp))| {
            let blake3 = hash_file(file, progress).map_err(|e| naming(file, &e))?;
            Ok((name.clone(), SourceFile { stamp: *stamp, blake3 }))
        })
        .collect::<io::Result<_>>()?;
    files.extend(hashed);
    // The hash of a file that is written to meanwhile may be that of no content it ever had.
    let is_same = |before: &(PathBuf, Stamp), now: &(PathBuf, Stamp)| before.1 == now.1;
    if let Some(change) = first_change(&listing, &list(folder)?, is_same) {
        return Err(ReadFailure::Changing(change));
    }
    cache.write(&files);
    Ok(Source { files })
}

/// Open file that counts the bytes that are read from it.
struct Counted<'a> {
    file: File,
    progress: &'a HashProgress,
}

impl Read for Counted<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.progress.is_abandoned.load(Ordering::Relaxed) {
            return Err(io::Error::other("interrupted"));
        }
        let read = self.file.read(buffer)?;
        self.progress.done.fetch_add(read as u64, Ordering::Relaxed);
        Ok(read)
    }
}

fn hash_file(path: &Path, progress: &HashProgress) -> io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(Counted { file: File::open(path)?, progress })?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// File of the store's cache for one folder.
struct CacheFile {
    path: PathBuf,
    folder: String,
}

/// Content of a [`CacheFile`].
#[derive(Default, Serialize, Deserialize)]
struct Cached {
    folder: String,
    files: BTreeMap<String, SourceFile>,
}

impl CacheFile {
    fn new(store: &Store, folder: &Path) -> Self {
        let folder = name_of(folder);
        let name = format!("{}.json", hash_json(&folder));
        Self { path: store.root().join("cache/sources").join(name), folder }
    }

    /// Reads the known files. A cache that can't be read is empty.
    fn files(&self) -> BTreeMap<String, SourceFile> {
        let bytes = std::fs::read(&self.path).unwrap_or_default();
        let cached: Cached = serde_json::from_slice(&bytes).unwrap_or_default();
        if cached.folder == self.folder { cached.files } else { BTreeMap::new() }
    }

    /// Writes the files whose next change will give them another stamp.
    fn write(&self, files: &BTreeMap<String, SourceFile>) {
        let settled = files.iter().filter(|(_, file)| file.stamp.is_settled());
        let files = settled.map(|(name, file)| (name.clone(), file.clone())).collect();
        let folder = self.folder.clone();
        if let Ok(bytes) = serde_json::to_vec(&Cached { folder, files })
            && let Some(parent) = self.path.parent()
        {
            // Only a cache: without it the next start is slower.
            std::fs::create_dir_all(parent)
                .and_then(|()| write_atomically(&self.path, &bytes))
                .ok();
        }
    }
}

/// A path as text, another for each path: names that aren't UTF-8 are written in hexadecimal after
/// a NUL, which no name has.
fn name_of(path: &Path) -> String {
    path.to_str().map_or_else(
        || {
            path.as_os_str()
                .as_encoded_bytes()
                .iter()
                .fold("\0".to_owned(), |text, byte| text + &format!("{byte:02x}"))
        },
        str::to_owned,
    )
}

#[cfg(test)]
#[path = "source_tests.rs"]
mod tests;

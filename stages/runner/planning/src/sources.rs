//! Folders outside the store: content hashes of their files, and changes since an earlier reading.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use artifact::{
    FileEntry, format_size, hash_json, list_source_files, report_line, write_atomically,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use store::Store;

/// Interval between two checks of the stop flag.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Time after which progress is reported, then again after twice that time and so on; chosen by
/// hand.
const NOTICE_AFTER: Duration = Duration::from_secs(2);

/// Error returned when a folder outside the store can't be hashed.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The folder doesn't exist, can't be read, or changed while it was hashed.
    #[error("{folder:?}: {problem}")]
    Folder {
        /// Path of the folder.
        folder: PathBuf,
        /// Problem and remedy.
        problem: String,
    },
    /// A signal came during hashing.
    #[error("interrupted")]
    Interrupted,
}

/// Maximum step of a file system's clock: FAT has two seconds.
const MAX_TICK_SECONDS: u64 = 2;

/// Size, times and inode of a file. If a settled stamp (`is_settled`) equals a later stamp of the
/// file, the content is unchanged (docs/design/002).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stamp {
    /// Size in bytes.
    pub(crate) size: u64,
    /// Time of the last change of the content, as seconds and nanoseconds since 1970.
    modified: (i64, i64),
    /// Time of the last change of content, name, links or permissions. Programs can't set it.
    changed: (i64, i64),
    inode: u64,
}

impl Stamp {
    /// Reads the stamp of a file. Links are followed.
    pub fn of(file: &Path) -> io::Result<Self> {
        let meta = file.metadata()?;
        Ok(Self {
            size: meta.len(),
            modified: (meta.mtime(), meta.mtime_nsec()),
            changed: (meta.ctime(), meta.ctime_nsec()),
            inode: meta.ino(),
        })
    }

    /// Returns whether the file wasn't touched since `earlier`. Inodes aren't compared: exFAT, SMB
    /// and SSHFS give new ones to old files.
    pub fn is_untouched_since(&self, earlier: &Self) -> bool {
        Self { inode: earlier.inode, ..*self } == *earlier
    }

    /// Returns whether every later change of the file will change the stamp. A second change within
    /// one tick of the file system's clock leaves the times unchanged.
    pub(crate) fn is_settled(&self) -> bool {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs() as i64;
        let times = [self.modified.0, self.changed.0];
        times.iter().all(|time| now.abs_diff(*time) > MAX_TICK_SECONDS)
    }

    /// Returns the size and the time of the content's last change, which copies of a file may
    /// preserve.
    pub(crate) fn size_and_modified(&self) -> (u64, (i64, i64)) {
        (self.size, self.modified)
    }
}

/// Content of a folder outside the store at the time of reading.
#[derive(Clone, Debug, PartialEq)]
pub struct Source {
    /// Files by path inside the folder.
    files: BTreeMap<String, SourceFile>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct SourceFile {
    #[serde(flatten)]
    stamp: Stamp,
    blake3: String,
}

impl Source {
    /// Reads a folder. Files with the stamps in the store's cache aren't hashed again. Reports
    /// progress if hashing takes long, and ends soon after `stop` is set.
    pub fn read(
        store: &Store,
        folder: &Path,
        stop: Option<&AtomicBool>,
    ) -> Result<Self, SourceError> {
        let absolute = check_folder(folder)?;
        let cache = CacheFile::new(store, &absolute);
        let progress = Arc::new(HashProgress::default());
        let (sender, receiver) = mpsc::channel();
        let shared = Arc::clone(&progress);
        // On another thread, since a dead file server may block it for ever.
        std::thread::spawn(move || sender.send(read(&absolute, &cache, &shared)));
        let started = Instant::now();
        let mut notice = NOTICE_AFTER;
        loop {
            match receiver.recv_timeout(POLL_INTERVAL) {
                Ok(result) => return result.map_err(|e| in_folder(folder, e.to_string())),
                Err(RecvTimeoutError::Disconnected) => return Err(SourceError::Interrupted),
                Err(RecvTimeoutError::Timeout) => {}
            }
            if stop.is_some_and(|stop| stop.load(Ordering::Relaxed)) {
                progress.is_abandoned.store(true, Ordering::Relaxed);
                return Err(SourceError::Interrupted);
            }
            if started.elapsed() >= notice {
                report_line!("{}", progress.message(folder));
                notice *= 2;
            }
        }
    }

    /// Returns the content hash: the hash of all files' paths, sizes and hashes.
    pub fn content_hash(&self) -> String {
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

    /// Returns the hash of all files' paths, sizes and times of the last change of content. A copy
    /// with preserved times has an equal one.
    pub fn times_hash(&self) -> String {
        let files: Vec<_> =
            self.files.iter().map(|(path, file)| (path, file.stamp.size_and_modified())).collect();
        hash_json(&files)
    }

    /// Returns the first file that was changed, added or removed since an earlier reading, as text.
    /// A file that was changed back counts as changed: a stage may have read it in between.
    pub fn change_since(&self, earlier: &Self) -> Option<String> {
        first_change(&earlier.files, &self.files, |before, now| {
            now.stamp.is_untouched_since(&before.stamp) && now.blake3 == before.blake3
        })
    }
}

/// Returns the absolute path of a folder. Fails if the folder doesn't exist or can't be accessed.
pub(crate) fn check_folder(folder: &Path) -> Result<PathBuf, SourceError> {
    let absolute = folder.canonicalize().map_err(|problem| match problem.kind() {
        io::ErrorKind::NotFound => in_folder(folder, "no such folder; name an existing one"),
        _ => in_folder(folder, format!("{problem}; name another folder")),
    })?;
    if absolute.is_dir() { Ok(absolute) } else { Err(in_folder(folder, "not a folder")) }
}

fn in_folder(folder: &Path, problem: impl Into<String>) -> SourceError {
    SourceError::Folder { folder: folder.to_path_buf(), problem: problem.into() }
}

/// Returns the first difference between two maps of files, as text.
fn first_change<T>(
    before: &BTreeMap<String, T>,
    now: &BTreeMap<String, T>,
    is_same: impl Fn(&T, &T) -> bool,
) -> Option<String> {
    for (name, old) in before {
        match now.get(name) {
            None => return Some(format!("{name} was removed")),
            Some(new) if !is_same(old, new) => return Some(format!("{name} was changed")),
            Some(_) => {}
        }
    }
    let added = now.keys().find(|name| !before.contains_key(*name))?;
    Some(format!("{added} was added"))
}

/// Progress of hashing a folder.
#[derive(Default)]
struct HashProgress {
    /// Number of bytes hashed so far.
    done: AtomicU64,
    /// Number of bytes to hash; 0 while files are listed.
    total: AtomicU64,
    /// True after the caller has stopped waiting.
    is_abandoned: AtomicBool,
}

impl HashProgress {
    fn message(&self, folder: &Path) -> String {
        let (done, total) = (self.done.load(Ordering::Relaxed), self.total.load(Ordering::Relaxed));
        if total == 0 {
            return format!("listing the files of {}", folder.display());
        }
        format!("hashing {}: {} of {}", folder.display(), format_size(done), format_size(total))
    }
}

/// Paths and stamps of files, by path inside a folder.
type Listing = BTreeMap<String, (PathBuf, Stamp)>;

fn list(folder: &Path) -> io::Result<Listing> {
    let files = list_source_files(folder)?.0.into_iter();
    files
        .map(|(relative, file)| {
            let stamp = Stamp::of(&file).map_err(|e| with_path(&file, &e))?;
            Ok((path_text(&relative), (file, stamp)))
        })
        .collect()
}

fn with_path(file: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", file.display()))
}

fn read(folder: &Path, cache: &CacheFile, progress: &HashProgress) -> io::Result<Source> {
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
            let blake3 = hash_file(file, progress).map_err(|e| with_path(file, &e))?;
            Ok((name.clone(), SourceFile { stamp: *stamp, blake3 }))
        })
        .collect::<io::Result<_>>()?;
    files.extend(hashed);
    // The hash of a file that is being written may fit no state of the file.
    let is_same = |before: &(PathBuf, Stamp), now: &(PathBuf, Stamp)| before.1 == now.1;
    if let Some(change) = first_change(&listing, &list(folder)?, is_same) {
        return Err(io::Error::other(format!(
            "{change} during hashing; run again when no program writes to the folder"
        )));
    }
    cache.write(&files);
    Ok(Source { files })
}

/// Reader of a file that counts the bytes read.
struct CountingReader<'a> {
    file: File,
    progress: &'a HashProgress,
}

impl Read for CountingReader<'_> {
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
    hasher.update_reader(CountingReader { file: File::open(path)?, progress })?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// Cache of one folder's hashes in the store.
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
        let folder = path_text(folder);
        let name = format!("{}.json", hash_json(&folder));
        Self { path: store.root().join("cache/sources").join(name), folder }
    }

    /// Reads the hashed files. An unreadable cache counts as empty.
    fn files(&self) -> BTreeMap<String, SourceFile> {
        let bytes = std::fs::read(&self.path).unwrap_or_default();
        let cached: Cached = serde_json::from_slice(&bytes).unwrap_or_default();
        if cached.folder == self.folder { cached.files } else { BTreeMap::new() }
    }

    /// Writes the files whose next change will change their stamps.
    fn write(&self, files: &BTreeMap<String, SourceFile>) {
        let settled = files.iter().filter(|(_, file)| file.stamp.is_settled());
        let files = settled.map(|(name, file)| (name.clone(), file.clone())).collect();
        let folder = self.folder.clone();
        if let Ok(bytes) = serde_json::to_vec(&Cached { folder, files })
            && let Some(parent) = self.path.parent()
        {
            // Without a cache, the next start is only slower.
            std::fs::create_dir_all(parent)
                .and_then(|()| write_atomically(&self.path, &bytes))
                .ok();
        }
    }
}

/// Converts a path to a unique text. Paths that aren't UTF-8 are written in hexadecimal after a
/// NUL, which no path contains.
pub(crate) fn path_text(path: &Path) -> String {
    if let Some(text) = path.to_str() {
        return text.to_owned();
    }
    let bytes = path.as_os_str().as_encoded_bytes();
    bytes.iter().fold("\0".to_owned(), |text, byte| text + &format!("{byte:02x}"))
}

#[cfg(test)]
#[path = "source_tests.rs"]
mod tests;

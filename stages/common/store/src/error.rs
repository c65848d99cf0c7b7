use std::fs::{self, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use artifact::{Damage, permission_advice};
use rustix::io::Errno;

/// What can go wrong in a store.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file operation failed.
    #[error("{path}: {source}{}", permission_advice(.path, .source))]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A record, a pin or a run's file has unusable content.
    #[error("{path}: {problem}; {remedy}")]
    Content {
        /// The file.
        path: PathBuf,
        /// Why its content is unusable.
        problem: String,
        /// What to do.
        remedy: String,
    },
    /// The file system refuses every lock.
    #[error(
        "file locks don't work on the file system of {path} ({source}); choose a folder on a local \
        disk, with --store or --out"
    )]
    NoLocks {
        /// The file to be locked.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A record or an object isn't what it should be.
    #[error(transparent)]
    Damage(#[from] Damage),
    /// A stage ended well but left no proper artifact.
    #[error("the stage ended without a proper artifact: {0}")]
    NoArtifact(String),
    /// A newer program made the store.
    #[error(
        "{path}: the store has format {found}, this nerf-sr knows format {known}; use the newer \
        nerf-sr, or another folder with --store"
    )]
    Newer {
        /// The store.
        path: PathBuf,
        /// Its format.
        found: String,
        /// The format that this program knows.
        known: u32,
    },
}

/// Says of a failed file operation which file it was.
pub(crate) fn at<T>(path: &Path, result: io::Result<T>) -> Result<T, StoreError> {
    result.map_err(|source| StoreError::Io { path: path.to_path_buf(), source })
}

/// Reads a file; `None` if it is not found. Any other error is one: a file that can't be read may
/// well be needed.
pub(crate) fn read_if_found(path: &Path) -> Result<Option<Vec<u8>>, StoreError> {
    match fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        bytes => at(path, bytes).map(Some),
    }
}

/// Returns whether an attempt took the lock of a file; false if another process holds the lock.
pub fn is_taken(path: &Path, attempt: Result<(), TryLockError>) -> Result<bool, StoreError> {
    match attempt {
        Ok(()) => Ok(true),
        Err(TryLockError::WouldBlock) => Ok(false),
        Err(TryLockError::Error(source)) => Err(lock_error(path, source)),
    }
}

/// Names the file whose lock failed, and tells file systems without locks from other failures.
pub(crate) fn lock_error(path: &Path, source: io::Error) -> StoreError {
    let path = path.to_path_buf();
    match Errno::from_io_error(&source) {
        Some(Errno::NOSYS | Errno::OPNOTSUPP | Errno::NOLCK) => {
            StoreError::NoLocks { path, source }
        }
        _ => StoreError::Io { path, source },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_systems_without_locks_are_named() {
        for (errno, is_named) in [
            (Errno::NOSYS, true),
            (Errno::OPNOTSUPP, true),
            (Errno::NOLCK, true),
            (Errno::IO, false),
        ] {
            let message = lock_error("s/gate".as_ref(), errno.into()).to_string();
            let words = "file locks don't work on the file system of s/gate";
            assert_eq!(message.starts_with(words) && message.contains("--store"), is_named);
            assert!(message.contains("s/gate") && message.contains("os error"), "{message}");
        }
    }
}

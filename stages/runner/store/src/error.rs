use std::fs::TryLockError;
use std::io;
use std::path::{Path, PathBuf};

use artifact::{Damage, permission_advice};
use rustix::io::Errno;

/// Error of a store.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file operation failed.
    #[error("{path}: {source}{}", permission_advice(.path, .source))]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Error of the file operation.
        source: io::Error,
    },
    /// A record, a pin or a run file has invalid content.
    #[error("{path}: {problem}")]
    Content {
        /// Path of the file.
        path: PathBuf,
        /// Problem of the content, and remedy.
        problem: String,
    },
    /// The file system doesn't support locks, the store is on several file systems, or a newer
    /// program has marked the store.
    #[error("{0}")]
    Unsupported(String),
    /// An object is damaged.
    #[error(transparent)]
    Damage(#[from] Damage),
    /// A stage succeeded, but its output is not a valid artifact.
    #[error("the stage ended without a valid artifact: {0}")]
    NoArtifact(String),
}

impl StoreError {
    /// Creates the error for a stage that has written no output.
    pub fn missing_output() -> Self {
        Self::NoArtifact("the stage has not created the folder --output".to_owned())
    }
}

/// Adds the path to the error of a file operation.
pub(crate) fn with_path<T>(path: &Path, result: io::Result<T>) -> Result<T, StoreError> {
    result.map_err(|source| StoreError::Io { path: path.to_path_buf(), source })
}

/// Adds the path to the error of a file operation; `None` if the file is not found.
pub(crate) fn if_found<T>(path: &Path, result: io::Result<T>) -> Result<Option<T>, StoreError> {
    match result {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        result => with_path(path, result).map(Some),
    }
}

/// Returns whether an attempt has acquired the lock of a file; false if another process holds it.
pub fn is_lock_acquired(
    path: &Path,
    attempt: Result<(), TryLockError>,
) -> Result<bool, StoreError> {
    match attempt {
        Ok(()) => Ok(true),
        Err(TryLockError::WouldBlock) => Ok(false),
        Err(TryLockError::Error(source)) => Err(lock_error(path, source)),
    }
}

/// Converts the error of a lock operation; file systems without locks have an error of their own.
pub(crate) fn lock_error(path: &Path, source: io::Error) -> StoreError {
    match Errno::from_io_error(&source) {
        Some(Errno::NOSYS | Errno::OPNOTSUPP | Errno::NOLCK) => StoreError::Unsupported(format!(
            "file locks don't work on the file system of {} ({source}); choose a folder on a \
            local disk, with --store or --out",
            path.display()
        )),
        _ => StoreError::Io { path: path.to_path_buf(), source },
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
            let expected = "file locks don't work on the file system of s/gate";
            assert_eq!(message.starts_with(expected) && message.contains("--store"), is_named);
            assert!(message.contains("s/gate") && message.contains("os error"), "{message}");
        }
    }
}

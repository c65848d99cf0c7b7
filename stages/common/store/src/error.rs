use std::io;
use std::path::{Path, PathBuf};

use artifact::Damage;

/// What can go wrong in a store.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file operation failed.
    #[error("{path}: {source}")]
    Io {
        /// The file.
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

//! Ownership of published folders: a folder may be replaced if a sink wrote all of it, and nobody
//! has changed it since.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use artifact::{Damage, MANIFEST_FILE, Manifest, list_files};

use crate::aside::{MARK, Mark};

/// Reason why a folder may not be replaced.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ForeignError {
    /// A file or a link stands in the folder's place.
    #[error("{0} is not a folder of nerf-sr's")]
    NoFolder(PathBuf),
    /// No sink wrote this file.
    #[error("{0} is not nerf-sr's")]
    File(PathBuf),
    /// This file differs from what a sink wrote.
    #[error("{0} was changed by somebody")]
    Changed(PathBuf),
    /// The folder, or a file in it, can't be read.
    #[error("cannot read {path}: {problem}")]
    Unreadable {
        /// The folder or file.
        path: PathBuf,
        /// The reason.
        problem: io::Error,
    },
    /// The folder's files can't be listed.
    #[error("{0}")]
    Unlisted(io::Error),
}

/// Checks that a folder has nothing but what a sink wrote; otherwise names the first other file. An
/// empty folder passes.
pub(crate) fn owned(target: &Path, kind: &str) -> Result<(), ForeignError> {
    let is_link = target.symlink_metadata().is_ok_and(|meta| meta.file_type().is_symlink());
    if is_link || !target.is_dir() {
        return Err(ForeignError::NoFolder(target.to_path_buf()));
    }
    let mut entries = fs::read_dir(target).map_err(|e| unreadable(target, e))?;
    if entries.next().is_none() {
        return Ok(());
    }
    let files = list_files(target).map_err(ForeignError::Unlisted)?;
    // Where the page goes is decided by its mark.
    Mark::read(target).map_err(|e| unreadable(&target.join(MARK), e))?;
    let own = |file: &Path| file == Path::new(MANIFEST_FILE) || file == Path::new(MARK);
    let manifest = match Manifest::read(target) {
        Ok(manifest) if kind == manifest.kind => manifest,
        _ => {
            let first = files
                .iter()
                .map(|(file, _)| file.as_path())
                .find(|file| !own(file))
                .unwrap_or(Path::new(""));
            return Err(ForeignError::File(target.join(first)));
        }
    };
    let listed = |file: &Path| manifest.files.iter().any(|entry| Path::new(&entry.path) == file);
    if let Some((foreign, _)) = files.iter().find(|(file, _)| !own(file) && !listed(file)) {
        return Err(ForeignError::File(target.join(foreign)));
    }
    for entry in &manifest.files {
        let single = Manifest { files: vec![entry.clone()], ..manifest.clone() };
        match single.check_contents(target) {
            // A page whose file somebody took away is still ours.
            Ok(()) | Err(Damage::Missing { .. }) => {}
            Err(Damage::Unreadable { path, source }) => return Err(unreadable(&path, source)),
            Err(_) => return Err(ForeignError::Changed(target.join(&entry.path))),
        }
    }
    Ok(())
}

fn unreadable(path: &Path, problem: io::Error) -> ForeignError {
    ForeignError::Unreadable { path: path.to_path_buf(), problem }
}

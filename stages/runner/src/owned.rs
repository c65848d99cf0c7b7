//! Which published folders may be replaced: those in which everything is a sink's own, unchanged.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use artifact::{Damage, MANIFEST_FILE, Manifest, list_files};

use crate::aside::{MARK, Mark};

/// Why a folder may not be replaced.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ForeignError {
    /// It is a file or a link.
    #[error("{0} is not a folder of nerf-sr's")]
    NoFolder(PathBuf),
    /// A file in it that no sink of ours put there.
    #[error("{0} is not nerf-sr's")]
    File(PathBuf),
    /// A file in it that isn't as a sink of ours left it.
    #[error("{0} was changed by somebody")]
    Changed(PathBuf),
    /// The folder, or a file in it, can't be read.
    #[error("cannot read {path}: {problem}")]
    Unreadable {
        /// The folder or file.
        path: PathBuf,
        /// Why.
        problem: io::Error,
    },
    /// The files in it can't be listed.
    #[error("{0}")]
    Unlisted(io::Error),
}

/// Whether all in a folder is what a sink of ours put there; else which file isn't. An empty folder
/// may be replaced, too.
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

//! Temporary files of commands that were killed: the next command that writes to the same folder
//! removes them.

use std::fs;
use std::path::Path;
use std::time::Duration;

/// Idle time after which the writer of a temporary file counts as dead. A writer that is alive
/// writes many times a second; the rest is for clocks that disagree and for a suspended writer.
const MIN_IDLE: Duration = Duration::from_secs(3600);

/// Beginning and end of the names of temporary files.
pub(crate) type Affixes = (&'static str, &'static str);

/// Removes temporary files and folders of these names from a folder. A leftover that can't be
/// removed harms nobody.
pub(crate) fn remove_leftovers(folder: &Path, (prefix, suffix): Affixes) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let (name, path) = (entry.file_name(), entry.path());
        let is_named = name.to_str().is_some_and(|n| n.starts_with(prefix) && n.ends_with(suffix));
        if is_named && is_idle(&path) {
            let is_folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
            if is_folder { fs::remove_dir_all(&path) } else { fs::remove_file(&path) }.ok();
        }
    }
}

/// Returns whether a file, or a folder with all files in it, has not changed for long.
fn is_idle(path: &Path) -> bool {
    let mut entries = walkdir::WalkDir::new(path).into_iter();
    entries.all(|entry| {
        let modified = entry.ok().and_then(|entry| entry.metadata().ok()?.modified().ok());
        let idle = modified.and_then(|time| time.elapsed().ok());
        idle.is_some_and(|idle| idle >= MIN_IDLE)
    })
}

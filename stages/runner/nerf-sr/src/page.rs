//! Folders of published pages: their marks, whether a folder may be replaced, and where a page is
//! moved that a new one replaces. A page is archived if it shows a result that the new page lacks.
//! A result is a stage with parameter values and a data set.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use anyhow::{anyhow, bail};
use artifact::{Damage, MANIFEST_FILE, Manifest, list_files};
use serde::{Deserialize, Serialize};

/// File name of a [`PageMark`].
pub(crate) const MARK_FILE: &str = ".shows";

/// Description of a published page, stored in its folder.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct PageMark {
    /// Hash of the run's record and of the sink.
    pub(crate) identity: String,
    /// Shown results, each a stage with its point and its data sets; `None` in the mark of an
    /// earlier version.
    #[serde(default)]
    pub(crate) results: Option<BTreeSet<String>>,
    /// Data sets of the run; empty if unknown.
    #[serde(default)]
    pub(crate) data_sets: Vec<String>,
}

impl PageMark {
    /// Reads the mark of a folder; `None` if the folder has none. The mark of an earlier version,
    /// which was no JSON, counts as empty.
    pub(crate) fn read(folder: &Path) -> io::Result<Option<Self>> {
        let text = match fs::read_to_string(folder.join(MARK_FILE)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            text => text?,
        };
        Ok(Some(serde_json::from_str(&text).unwrap_or_default()))
    }

    pub(crate) fn write(&self, folder: &Path) -> io::Result<()> {
        fs::write(folder.join(MARK_FILE), serde_json::to_string(self)?)
    }

    /// True if the page shows each result that another page shows. False if either page is of an
    /// earlier version, whose results are unknown.
    fn has_results_of(&self, other: &Self) -> bool {
        match (&self.results, &other.results) {
            (Some(own), Some(others)) => others.is_subset(own),
            _ => false,
        }
    }
}

/// Fails if a folder contains a file that no sink wrote, or that was changed since. A folder
/// without any entries passes; one that contains only folders fails: a sink didn't create them.
/// `kind` is the kind of the sink's output.
pub(crate) fn check_ownership(target: &Path, kind: &str) -> anyhow::Result<()> {
    let is_link = target.symlink_metadata().is_ok_and(|meta| meta.file_type().is_symlink());
    if is_link || !target.is_dir() {
        bail!("{} is not a folder written by nerf-sr", target.display());
    }
    let mut entries = fs::read_dir(target).map_err(|e| unreadable(target, &e))?;
    if entries.next().is_none() {
        return Ok(());
    }
    let files = list_files(target)?;
    // The mark decides whether the page is archived, so it must be readable.
    PageMark::read(target).map_err(|e| unreadable(&target.join(MARK_FILE), &e))?;
    let manifest = Manifest::read(target).ok();
    if let Some(manifest) = manifest.as_ref().filter(|manifest| manifest.kind != kind) {
        bail!("{} contains an artifact of kind {}, not {kind}", target.display(), manifest.kind);
    }
    let listed = manifest.iter().flat_map(|manifest| &manifest.files);
    let mut own: BTreeSet<&Path> = listed.map(|entry| Path::new(&entry.path)).collect();
    own.extend([Path::new(MANIFEST_FILE), Path::new(MARK_FILE)]);
    let foreign = files.iter().map(|(file, _)| file.as_path()).find(|file| !own.contains(file));
    let Some(manifest) = manifest.as_ref().filter(|_| foreign.is_none()) else {
        let foreign = target.join(foreign.unwrap_or(Path::new("")));
        bail!("{} was not written by nerf-sr", foreign.display());
    };
    // One by one, since a missing file must not hide a changed one.
    for entry in &manifest.files {
        let files = vec![entry.clone()];
        let single = Manifest { kind: kind.to_owned(), schema: manifest.schema, files };
        match single.check_contents(target) {
            // A page that lost a file still belongs to nerf-sr.
            Ok(()) | Err(Damage::Missing { .. }) => {}
            Err(Damage::Unreadable { path, source }) => return Err(unreadable(&path, &source)),
            Err(_) => {
                let file = target.join(&entry.path);
                bail!("{} was changed after nerf-sr wrote it", file.display());
            }
        }
    }
    Ok(())
}

fn unreadable(path: &Path, problem: &io::Error) -> anyhow::Error {
    anyhow!("cannot read {}: {problem}", path.display())
}

/// Returns the path to which a page is moved when one with the mark `newer` replaces it: next to
/// the target, named after the data sets. `None` if the page may be deleted. `kind` is the kind of
/// the sink's output.
pub(crate) fn archive_path(
    page: &Path,
    newer: &PageMark,
    target: &Path,
    kind: &str,
) -> io::Result<Option<PathBuf>> {
    let Some(old) = PageMark::read(page)?.filter(|old| !newer.has_results_of(old)) else {
        return Ok(None);
    };
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    let name = format!("{name}-{}", data_sets_name(&old.data_sets));
    let mut path = target.with_file_name(&name);
    let mut number = 1;
    while !can_replace(&path, &old, kind) {
        number += 1;
        path = target.with_file_name(format!("{name}-{number}"));
    }
    Ok(Some(path))
}

/// True if nothing is at `path`, or only an archived page whose results a page with the mark `old`
/// also shows.
fn can_replace(path: &Path, old: &PageMark, kind: &str) -> bool {
    match PageMark::read(path) {
        Ok(Some(mark)) => old.has_results_of(&mark) && check_ownership(path, kind).is_ok(),
        _ => path.symlink_metadata().is_err(),
    }
}

/// Maximum length of the data sets' names in a folder's name in bytes, so that they fit into a file
/// name of 255 bytes next to a stage's name, of 100 bytes at most, and a number; chosen by hand.
const MAX_NAME_BYTES: usize = 140;

/// Returns a folder name for data sets, from the last components of their paths, without special
/// characters.
fn data_sets_name(data_sets: &[String]) -> String {
    let names = data_sets
        .iter()
        .map(|path| Path::new(path).file_name().and_then(OsStr::to_str).unwrap_or("data"));
    let name = if data_sets.is_empty() {
        "before".to_owned()
    } else {
        names.collect::<Vec<_>>().join("-")
    };
    let name = name.replace(|c: char| !(c.is_alphanumeric() || "-_.".contains(c)), "-");
    name[..name.floor_char_boundary(MAX_NAME_BYTES)].to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name_of(paths: &[&str]) -> String {
        data_sets_name(&paths.iter().map(|&path| path.to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn names_are_short_and_plain() {
        assert_eq!(name_of(&["/data/my lego"]), "my-lego");
        assert_eq!(name_of(&["a", "b", "c", "d", "e"]), "a-b-c-d-e");
        assert_eq!(name_of(&["/"]), "data");
        assert_eq!(name_of(&[]), "before");
        assert_eq!(name_of(&[&"x".repeat(300)]).len(), 140);
    }
}

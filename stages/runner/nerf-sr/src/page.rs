//! Folders of published pages: their marks, and whether a folder may be replaced.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::Path;

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
    /// Reads the mark of a folder; `None` if the folder has none. Earlier versions wrote the
    /// identity alone.
    pub(crate) fn read(folder: &Path) -> io::Result<Option<Self>> {
        let text = match fs::read_to_string(folder.join(MARK_FILE)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            text => text?,
        };
        Ok(Some(serde_json::from_str(&text).unwrap_or_else(|_| Self {
            identity: text,
            results: None,
            data_sets: Vec::new(),
        })))
    }

    pub(crate) fn write(&self, folder: &Path) -> io::Result<()> {
        fs::write(folder.join(MARK_FILE), serde_json::to_string(self)?)
    }
}

/// Fails if a folder contains a file that no sink wrote, or that was changed since. An empty folder
/// passes. `kind` is the kind of the sink's output.
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

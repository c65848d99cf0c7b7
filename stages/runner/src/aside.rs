//! What a published folder shows, and where it goes when something else takes its place.

use std::ffi::OsStr;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// Name of a [`Mark`] in a published folder.
pub(crate) const MARK: &str = ".shows";

/// What a published folder shows.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Mark {
    /// Hash of the run's record.
    pub(crate) identity: String,
    /// Whether all of it is there: nothing failed.
    pub(crate) is_whole: bool,
    /// The data sets that it is about; none where that isn't known.
    pub(crate) data_sets: Vec<String>,
}

impl Mark {
    /// Reads the mark of a folder; `None` if the folder has none. Earlier versions wrote the identity
    /// alone.
    pub(crate) fn read(folder: &Path) -> io::Result<Option<Self>> {
        let text = match fs::read_to_string(folder.join(MARK)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            text => text?,
        };
        let older = || Self { identity: text.clone(), is_whole: true, data_sets: Vec::new() };
        Ok(Some(serde_json::from_str(&text).unwrap_or_else(|_| older())))
    }

    pub(crate) fn write(&self, folder: &Path) -> io::Result<()> {
        fs::write(folder.join(MARK), serde_json::to_string(self)?)
    }

    /// Whether it is worth keeping when the other takes its place.
    fn is_kept_from(&self, other: &Self) -> bool {
        let is_other = !self.data_sets.is_empty() && self.data_sets != other.data_sets;
        is_other || (self.is_whole && !other.is_whole)
    }

    /// Whether it may take the other's place.
    fn succeeds(&self, other: &Self) -> bool {
        self.data_sets == other.data_sets && (self.is_whole || !other.is_whole)
    }
}

/// Where a page goes when one with a newer mark takes its place: beside the target, under its data
/// set's name. None where it may go for good. `is_ours` says whether a folder may be replaced.
pub(crate) fn place_aside(
    page: &Path,
    newer: &Mark,
    target: &Path,
    is_ours: impl Fn(&Path) -> bool,
) -> io::Result<Option<PathBuf>> {
    let (Some(old), Some(name)) = (Mark::read(page)?, target.file_name().and_then(OsStr::to_str))
    else {
        return Ok(None);
    };
    if !old.is_kept_from(newer) {
        return Ok(None);
    }
    let name = format!("{name}-{}", short_name(&old.data_sets));
    let is_free = |place: &PathBuf| match Mark::read(place) {
        Ok(Some(mark)) => old.succeeds(&mark) && is_ours(place),
        _ => place.symlink_metadata().is_err(),
    };
    Ok((1..).map(|number| numbered(target, &name, number)).find(is_free))
}

/// A folder of this name beside the target, the first without a number.
fn numbered(target: &Path, name: &str, number: usize) -> PathBuf {
    match number {
        1 => target.with_file_name(name),
        _ => target.with_file_name(format!("{name}-{number}")),
    }
}

/// Most data sets that a folder's name has.
const MAX_NAMES: usize = 3;

/// A name for data sets that every file system takes.
fn short_name(data_sets: &[String]) -> String {
    let mut names: Vec<String> =
        data_sets.iter().take(MAX_NAMES).map(|path| last_name(path)).collect();
    match data_sets.len() {
        0 => names.push("before".to_owned()),
        1..=MAX_NAMES => {}
        more => names.push(format!("{}-more", more - MAX_NAMES)),
    }
    names.join("-")
}

fn last_name(path: &str) -> String {
    let name = Path::new(path).file_name().and_then(OsStr::to_str).unwrap_or("data");
    let is_plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    name.chars().map(|c| if is_plain(c) { c } else { '-' }).take(60).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name_of(paths: &[&str]) -> String {
        short_name(&paths.iter().map(|&path| path.to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn names_are_short_and_plain() {
        assert_eq!(name_of(&["/data/my lego"]), "my-lego");
        assert_eq!(name_of(&["a", "b", "c", "d", "e"]), "a-b-c-2-more");
        assert_eq!(name_of(&["/"]), "data");
        assert_eq!(name_of(&[]), "before");
        assert_eq!(name_of(&[&"x".repeat(300)]).len(), 60);
    }
}

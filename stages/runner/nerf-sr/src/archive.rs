//! Archiving of pages that a new one replaces, by one rule: a page is archived if it shows a result
//! that the new page lacks. A result is a stage with parameter values and a data set.

use std::ffi::OsStr;
use std::io;
use std::path::{Path, PathBuf};

use crate::page::{PageMark, check_ownership};

impl PageMark {
    /// True if the page shows each result that another page shows. False if either page is of an
    /// earlier version, whose results are unknown.
    fn has_results_of(&self, other: &Self) -> bool {
        match (&self.results, &other.results) {
            (Some(own), Some(others)) => others.is_subset(own),
            _ => false,
        }
    }
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

/// Maximum number of data sets in a folder's name; chosen by hand.
const MAX_NAMED_DATA_SETS: usize = 3;
/// Maximum length of a data set's name in bytes, so that three names fit into a file name; chosen
/// by hand.
const MAX_NAME_BYTES: usize = 60;

/// Returns a folder name for data sets, without special characters.
fn data_sets_name(data_sets: &[String]) -> String {
    let mut names: Vec<String> =
        data_sets.iter().take(MAX_NAMED_DATA_SETS).map(|path| plain_file_name(path)).collect();
    match data_sets.len() {
        0 => names.push("before".to_owned()),
        1..=MAX_NAMED_DATA_SETS => {}
        n => names.push(format!("{}-more", n - MAX_NAMED_DATA_SETS)),
    }
    names.join("-")
}

/// Returns a path's last component with `-` for each special character.
fn plain_file_name(path: &str) -> String {
    let name = Path::new(path).file_name().and_then(OsStr::to_str).unwrap_or("data");
    let plain =
        name.chars().map(|c| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '-' });
    let mut bytes = 0;
    let fits = |c: &char| {
        bytes += c.len_utf8();
        bytes <= MAX_NAME_BYTES
    };
    plain.take_while(fits).collect()
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
        assert_eq!(name_of(&["a", "b", "c", "d", "e"]), "a-b-c-2-more");
        assert_eq!(name_of(&["/"]), "data");
        assert_eq!(name_of(&[]), "before");
        assert_eq!(name_of(&[&"x".repeat(300)]).len(), 60);
    }
}

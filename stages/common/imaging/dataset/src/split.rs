use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use anyhow::{Context as _, ensure};
use artifact::{format_count, relative_path};

use crate::entry::{Entry, expectation};
use crate::lookup::{Lookup, LookupError};

/// Interval of held-out frames, as in LLFF's code.
const HOLD_OUT_EVERY: usize = 8;

/// Indices of training and test frames.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Split {
    /// Indices of the training frames.
    pub train: Vec<usize>,
    /// Indices of the test frames.
    pub test: Vec<usize>,
}

impl Split {
    /// Uses every frame for both training and testing, as the paper does with photographs.
    pub fn all(count: usize) -> Self {
        Self { train: (0..count).collect(), test: (0..count).collect() }
    }

    /// Holds out every eighth frame, starting with the first, for testing, as LLFF does. A single
    /// frame is used for both training and testing.
    pub fn hold_out(count: usize) -> Self {
        let (test, train): (Vec<_>, Vec<_>) =
            (0..count).partition(|i| i.is_multiple_of(HOLD_OUT_EVERY));
        if train.is_empty() { Self::all(count) } else { Self { train, test } }
    }
}

/// nerfstudio's lists of file names. An empty list counts as absent.
pub(crate) struct SplitLists {
    train: Vec<String>,
    test: Vec<String>,
    val: Vec<String>,
}

/// Frames by the names and files that split lists may contain.
#[derive(Debug, Default)]
pub(crate) struct FrameNames {
    by_name: BTreeMap<PathBuf, Vec<usize>>,
}

impl FrameNames {
    /// Adds a frame with its name in the data set and its file.
    pub(crate) fn add(&mut self, frame: usize, name: &str, file: PathBuf) {
        let name = relative_path(name).unwrap_or_else(|_| PathBuf::from(name));
        for path in BTreeSet::from([name, file]) {
            self.by_name.entry(path).or_default().push(frame);
        }
    }

    fn find(&self, name: &str, lookup: &mut Lookup) -> Result<&[usize], LookupError> {
        let literal = relative_path(name).unwrap_or_else(|_| PathBuf::from(name));
        if let Some(frames) = self.by_name.get(&literal) {
            return Ok(frames);
        }
        let frames = match lookup.find_repeated(name) {
            Ok(file) => self.by_name.get(&file.path),
            Err(ambiguous @ LookupError::Ambiguous { .. }) => return Err(ambiguous),
            Err(_) => None,
        };
        Ok(frames.map(Vec::as_slice).unwrap_or_default())
    }
}

impl SplitLists {
    /// Reads the lists of training, test and validation views.
    pub(crate) fn read(entry: &Entry) -> anyhow::Result<Self> {
        Ok(Self {
            train: read_names(entry, "train_filenames")?,
            test: read_names(entry, "test_filenames")?,
            val: read_names(entry, "val_filenames")?,
        })
    }

    /// Returns the names in all lists.
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        [&self.train, &self.test, &self.val].into_iter().flatten().map(String::as_str)
    }

    /// Returns the split of `count` frames that the lists describe, with notes. Validation views
    /// are test views if there are no others. If only one side is listed, unlisted frames are on
    /// the other side.
    pub(crate) fn split(
        &self,
        count: usize,
        names: &FrameNames,
        lookup: &mut Lookup,
    ) -> anyhow::Result<(Option<Split>, Vec<String>)> {
        let mut notes = Vec::new();
        let train = listed_frames("train_filenames", &self.train, names, lookup, &mut notes)?;
        let test = listed_frames("test_filenames", &self.test, names, lookup, &mut notes)?;
        let val = listed_frames("val_filenames", &self.val, names, lookup, &mut notes)?;
        let listed: BTreeSet<usize> = train.iter().chain(&test).chain(&val).copied().collect();
        let unlisted: BTreeSet<usize> = (0..count).filter(|i| !listed.contains(i)).collect();
        let mut split = [train, if test.is_empty() { val } else { test }];
        for (side, noun) in [(0, "training view"), (1, "test view")] {
            let is_missing = split[side].is_empty() && !split[1 - side].is_empty();
            if is_missing && !unlisted.is_empty() {
                let views = format_count(unlisted.len(), noun);
                notes.push(format!("{views}: all unlisted frames"));
                split[side].clone_from(&unlisted);
            }
        }
        if split.iter().any(BTreeSet::is_empty) {
            return Ok((None, notes));
        }
        let unused = (0..count).filter(|i| !split.iter().any(|side| side.contains(i))).count();
        if unused > 0 {
            let frames = format_count(count, "frame");
            let are = if unused == 1 { "is" } else { "are" };
            notes.push(format!(
                "{unused} of {frames} {are} listed for neither training nor testing"
            ));
        }
        let [train, test] = split.map(|frames| frames.into_iter().collect());
        Ok((Some(Split { train, test }), notes))
    }
}

/// Reads a list of names; empty if missing.
fn read_names(entry: &Entry, list: &str) -> anyhow::Result<Vec<String>> {
    let mut names = Vec::new();
    for name in entry.list(list)? {
        let text = name.as_str();
        let text = text.with_context(|| format!("{list}: {}", expectation("text", name)))?;
        names.push(text.to_owned());
    }
    Ok(names)
}

/// Returns the frames of a list. Names without a frame are noted; a list of only such names is an
/// error.
fn listed_frames(
    list: &str,
    list_names: &[String],
    names: &FrameNames,
    lookup: &mut Lookup,
    notes: &mut Vec<String>,
) -> anyhow::Result<BTreeSet<usize>> {
    let (mut found, mut unknown) = (BTreeSet::new(), Vec::new());
    for name in list_names {
        let frames = names.find(name, lookup)?;
        found.extend(frames);
        if frames.is_empty() {
            unknown.push(name);
        }
    }
    if let Some(first) = unknown.first() {
        let count = unknown.len();
        ensure!(
            !found.is_empty(),
            "no name in {list} is that of a frame (first of {count}: {first}); correct the names, \
            or remove {list}"
        );
        let names = format_count(list_names.len(), "name");
        let have = if count == 1 { "has" } else { "have" };
        notes.push(format!("{count} of {names} in {list} {have} no frame (first: {first})"));
    }
    Ok(found)
}
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_eighth_is_held_out() {
        let split = Split::hold_out(20);
        assert_eq!(split.test, [0, 8, 16]);
        assert_eq!(split.train.len(), 17);
        assert_eq!(Split::hold_out(1), Split::all(1));
        assert_eq!(Split::hold_out(0), Split::default());
    }
}

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use artifact::{counted, relative_path};

use crate::file_reason::FileReason;
use crate::lookup::{Located, Lookup, LookupError};
use crate::split::Split;

/// nerfstudio's lists of file names. An empty list counts as absent.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SplitLists<'a> {
    pub(crate) train: &'a [String],
    pub(crate) test: &'a [String],
    pub(crate) val: &'a [String],
}

/// Frames by the names and files that lists may give.
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

    fn find(&self, name: &str, lookup: &mut Lookup) -> Result<&[usize], FileReason> {
        let written = relative_path(name).unwrap_or_else(|_| PathBuf::from(name));
        if let Some(frames) = self.by_name.get(&written) {
            return Ok(frames);
        }
        let frames = match lookup.find_again(name) {
            Ok(Located::File(file)) => self.by_name.get(&file.path),
            Err(ambiguous @ LookupError::Ambiguous { .. }) => return Err(ambiguous.into()),
            _ => None,
        };
        Ok(frames.map(Vec::as_slice).unwrap_or_default())
    }
}

impl SplitLists<'_> {
    /// Returns the split that the lists describe for a number of frames, and notes on it. Views for
    /// validation are for testing where no others are. Where only one side is listed, the frames
    /// that no list names are on the other side.
    pub(crate) fn split(
        &self,
        count: usize,
        names: &FrameNames,
        lookup: &mut Lookup,
    ) -> Result<(Option<Split>, Vec<String>), FileReason> {
        let mut notes = Vec::new();
        let train = frames_of("train_filenames", self.train, names, lookup, &mut notes)?;
        let test = frames_of("test_filenames", self.test, names, lookup, &mut notes)?;
        let val = frames_of("val_filenames", self.val, names, lookup, &mut notes)?;
        let listed: BTreeSet<usize> = train.iter().chain(&test).chain(&val).copied().collect();
        let rest: BTreeSet<usize> = (0..count).filter(|frame| !listed.contains(frame)).collect();
        let mut split = [train, if test.is_empty() { val } else { test }];
        for (side, use_of) in [(0, "training view"), (1, "test view")] {
            let is_missing = split[side].is_empty() && !split[1 - side].is_empty();
            if is_missing && !rest.is_empty() {
                notes.push(format!(
                    "{}: the frames that no list names",
                    counted(rest.len(), use_of)
                ));
                split[side].clone_from(&rest);
            }
        }
        if split.iter().any(BTreeSet::is_empty) {
            return Ok((None, notes));
        }
        let [train, test] = split.map(|frames| frames.into_iter().collect());
        Ok((Some(Split { train, test }), notes))
    }
}

/// Returns the frames of a list. Names without a frame are noted; a list of nothing else is an
/// error.
fn frames_of(
    list: &'static str,
    list_names: &[String],
    names: &FrameNames,
    lookup: &mut Lookup,
    notes: &mut Vec<String>,
) -> Result<BTreeSet<usize>, FileReason> {
    let (mut found, mut unknown) = (BTreeSet::new(), Vec::new());
    for name in list_names {
        let frames = names.find(name, lookup)?;
        found.extend(frames);
        if frames.is_empty() {
            unknown.push(name);
        }
    }
    match unknown.first() {
        Some(first) if found.is_empty() => {
            Err(FileReason::NoFrameListed { list, count: unknown.len(), first: (*first).clone() })
        }
        Some(first) => {
            let of = counted(list_names.len(), "name");
            let have = if unknown.len() == 1 { "has" } else { "have" };
            notes.push(format!(
                "{} of {of} in {list} {have} no frame, first {first}",
                unknown.len()
            ));
            Ok(found)
        }
        None => Ok(found),
    }
}

//! Files that list frames: `transforms.json` and its relatives.

use std::path::{Path, PathBuf};

use artifact::counted;

use crate::error::DatasetError;
use crate::file_reason::FileReason;
use crate::frame::{Frame, names};
use crate::frame_reason::FrameReason;
use crate::lookup::{Located, Lookup};
use crate::mask_file::{MaskFile, MaskKind};
use crate::misplaced::Misplaced;
use crate::number::words_as_text;
use crate::photograph::is_exr;
use crate::split_lists::{FrameNames, SplitLists};
use crate::text::read_text;
use crate::transforms::{FrameEntry, Transforms, read_frame};

/// Treatment of a frame whose image doesn't exist.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Missing {
    /// The frame is an error.
    Refused,
    /// The frame is left out, and counted.
    LeftOut,
}

/// Parsed file of frames.
pub(crate) struct FrameFile {
    path: PathBuf,
    transforms: Transforms,
}

/// Frames of a file, and the names without a file.
#[derive(Default)]
pub(crate) struct ReadFrames {
    pub(crate) frames: Vec<Frame>,
    pub(crate) names: FrameNames,
    /// Frames whose image doesn't exist, where these are left out.
    missing: Absent,
    /// Depth images that don't exist, and wouldn't be used.
    depths: Absent,
}

/// Number of names without a file, and the first of them.
#[derive(Default)]
struct Absent {
    count: usize,
    first: Option<String>,
}

impl Absent {
    fn add(&mut self, name: &str) {
        self.count += 1;
        self.first.get_or_insert_with(|| name.to_owned());
    }
}

/// Looks up the names of all files of frames of a data set.
pub(crate) fn lookup_of(folder: &Path, files: &[&FrameFile]) -> Lookup {
    let (mut names, mut again): (Vec<&str>, Vec<&str>) = Default::default();
    for file in files {
        for frame in &file.transforms.frames {
            names.push(&frame.file_path);
            names.extend(frame.mask_path.as_deref());
            names.extend(frame.depth_file_path.as_deref());
        }
        let SplitLists { train, test, val } = file.split_lists();
        again.extend([train, test, val].into_iter().flatten().map(String::as_str));
    }
    Lookup::in_folder(folder, &names, &again)
}

impl ReadFrames {
    /// Returns the line on frames that are left out.
    pub(crate) fn missing_note(&self) -> Option<String> {
        let first = self.missing.first.as_ref()?;
        let (count, frames) = (self.missing.count, self.frames.len() + self.missing.count);
        Some(format!("{count} of {frames} frames have no picture and are left out, first {first}"))
    }

    /// Returns the line on depth images that don't exist.
    pub(crate) fn depth_note(&self) -> Option<String> {
        let first = self.depths.first.as_ref()?;
        let count = counted(self.depths.count, "depth image");
        let verb = if self.depths.count == 1 { "does" } else { "do" };
        Some(format!(
            "{count} (depth_file_path) {verb} not exist, first {first}; only EXR depth is used"
        ))
    }
}

impl FrameFile {
    /// Parses a file.
    pub(crate) fn read(path: &Path) -> Result<Self, DatasetError> {
        let transforms = parse(&read_text(path)?).map_err(|e| DatasetError::format(path, e))?;
        Ok(Self { path: path.to_path_buf(), transforms })
    }

    /// Returns the path of the file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns nerfstudio's own split.
    pub(crate) fn split_lists(&self) -> SplitLists<'_> {
        let Transforms { train_filenames, test_filenames, val_filenames, .. } = &self.transforms;
        SplitLists {
            train: train_filenames.as_deref().unwrap_or_default(),
            test: test_filenames.as_deref().unwrap_or_default(),
            val: val_filenames.as_deref().unwrap_or_default(),
        }
    }

    /// Reads the frames; there may be none.
    pub(crate) fn frames(
        &self,
        lookup: &mut Lookup,
        on_missing: Missing,
    ) -> Result<ReadFrames, DatasetError> {
        let (mut read, mut labels) = (ReadFrames::default(), Vec::new());
        for (index, entry) in self.transforms.frames.iter().enumerate() {
            let of_frame =
                |reason| DatasetError::frame(&self.path, index, &entry.file_path, reason);
            let located = lookup.find(&entry.file_path).map_err(|e| of_frame(e.into()))?;
            let file = match located {
                Located::File(file) => file,
                Located::Nothing(found) if on_missing == Missing::Refused => {
                    let remedy = "remove the frame or restore the file";
                    return Err(of_frame(FrameReason::Place { found, remedy }));
                }
                Located::Nothing(_) => {
                    read.missing.add(&entry.file_path);
                    continue;
                }
                Located::Other(found) => {
                    let remedy = "remove the frame or name its image";
                    return Err(of_frame(FrameReason::Place { found, remedy }));
                }
            };
            let image = lookup.root().join(&file.path);
            let mut frame = read_frame(image, entry, &self.transforms.shared).map_err(of_frame)?;
            frame.mask = mask_of(lookup, entry).map_err(of_frame)?;
            frame.depth = depth_of(lookup, entry, &mut read.depths).map_err(of_frame)?;
            read.names.add(read.frames.len(), &entry.file_path, file.path);
            read.frames.push(frame);
            labels.push(file.label);
        }
        if let Some(first) = read.missing.first.clone().filter(|_| read.frames.is_empty()) {
            let reason =
                FileReason::ImagesMissing { count: read.missing.count, folder: None, first };
            return Err(DatasetError::format(&self.path, reason));
        }
        for (frame, name) in read.frames.iter_mut().zip(names(&self.path, &labels)?) {
            frame.name = name;
        }
        Ok(read)
    }
}

/// Finds the mask that a frame names, if it names one.
fn mask_of(lookup: &mut Lookup, entry: &FrameEntry) -> Result<Option<MaskFile>, FrameReason> {
    let Some(name) = &entry.mask_path else { return Ok(None) };
    match lookup.find(name)? {
        Located::File(file) => {
            let path = lookup.root().join(file.path);
            Ok(Some(MaskFile { path, kind: MaskKind::Listed }))
        }
        Located::Nothing(found) | Located::Other(found) => Err(not_beside(found)),
    }
}

/// Finds the depth image that a frame names. Only EXR has true depth: nerfstudio's PNG files are
/// estimates, so that they may be missing.
fn depth_of(
    lookup: &mut Lookup,
    entry: &FrameEntry,
    absent: &mut Absent,
) -> Result<Option<PathBuf>, FrameReason> {
    let Some(name) = &entry.depth_file_path else { return Ok(None) };
    match lookup.find(name) {
        Ok(Located::File(file)) => {
            Ok(Some(lookup.root().join(file.path)).filter(|path| is_exr(path)))
        }
        Ok(Located::Nothing(_) | Located::Other(_)) | Err(_) if !is_exr(Path::new(name)) => {
            absent.add(name);
            Ok(None)
        }
        Ok(Located::Nothing(found) | Located::Other(found)) => Err(not_beside(found)),
        Err(error) => Err(error.into()),
    }
}

fn not_beside(found: Misplaced) -> FrameReason {
    FrameReason::Place { found, remedy: "remove the entry or restore the file" }
}

/// Parses the JSON; where it fails on Python's `NaN` and `Infinity`, those are taken for numbers,
/// so that the frame can be named.
fn parse(text: &str) -> Result<Transforms, serde_json::Error> {
    serde_json::from_str(text).or_else(|error| match words_as_text(text) {
        Some(readable) => serde_json::from_str(&readable).map_err(|_| error),
        None => Err(error),
    })
}

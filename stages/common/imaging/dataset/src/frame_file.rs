//! Reads files that list frames: `transforms.json`, `transforms_train.json` and so on.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail, ensure};
use artifact::shortened;
use serde_json::Value;

use crate::entry::{Entry, quote_python_numbers};
use crate::error::{frame_label, images_missing};
use crate::file_status::path_text;
use crate::frame::{Frame, assign_names};
use crate::lens_entry::lens_part;
use crate::lookup::{Lookup, LookupError};
use crate::masks::{MaskFile, MaskKind};
use crate::photograph::is_exr;
use crate::split::{FrameNames, SplitLists};
use crate::text::{counted_with_verb, read_text};
use crate::transforms::{FrameEntry, read_frame};

/// Treatment of frames whose image doesn't exist.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum MissingImages {
    /// A missing image is an error.
    Refused,
    /// The frame is skipped and counted.
    Skipped,
}

/// Parsed file of frames.
pub(crate) struct FrameFile {
    path: PathBuf,
    frames: Vec<FrameEntry>,
    /// Lens of all frames, unless a frame has its own.
    lens: Entry,
    /// nerfstudio's own split.
    pub(crate) split_lists: SplitLists,
}

/// Frames that were read from a file, their names, and the names of missing and of unused images.
#[derive(Default)]
pub(crate) struct ReadFrames {
    pub(crate) frames: Vec<Frame>,
    pub(crate) names: FrameNames,
    /// Skipped frames whose image doesn't exist.
    missing: Vec<String>,
    /// Depth images that aren't EXR, missing ones included.
    unused_depths: Vec<String>,
}

/// Creates the lookup for the names in all frame files of a data set.
pub(crate) fn lookup_of(folder: &Path, files: &[&FrameFile]) -> Lookup {
    let (mut names, mut repeated): (Vec<&str>, Vec<&str>) = Default::default();
    for file in files {
        for frame in &file.frames {
            names.push(&frame.file_path);
            names.extend(frame.mask_path.as_deref());
            names.extend(frame.depth_file_path.as_deref());
        }
        repeated.extend(file.split_lists.names());
    }
    Lookup::in_folder(folder, &names, &repeated)
}

impl ReadFrames {
    /// Returns the note on skipped frames, if any.
    pub(crate) fn missing_note(&self) -> Option<String> {
        let (first, count) = (self.missing.first()?, self.missing.len());
        let frames = self.frames.len() + count;
        Some(format!(
            "{count} of {frames} frames have no image file and are skipped (first: {first})"
        ))
    }

    /// Returns the note on unused depth images, if any.
    pub(crate) fn depth_note(&self) -> Option<String> {
        let first = self.unused_depths.first()?;
        let unused = counted_with_verb(self.unused_depths.len(), "depth image", ["is", "are"]);
        Some(format!("{unused} not used (depth_file_path, first: {first}); only EXR depth is"))
    }
}

impl FrameFile {
    /// Parses a file.
    pub(crate) fn read(path: &Path) -> anyhow::Result<Self> {
        let text = read_text(path)?;
        ensure!(!text.trim().is_empty(), "{}: file is empty", path_text(path));
        let value = parse(&text).map_err(|error| anyhow!(json_message(&error)));
        let mut file =
            value.and_then(|value| Entry::new(&value)).with_context(|| path_text(path))?;
        let values = file.take("frames").with_context(|| path_text(path))?;
        let lens = lens_part(&file).with_context(|| path_text(path))?;
        let split_lists = SplitLists::read(&file).with_context(|| path_text(path))?;
        let mut frames = Vec::with_capacity(values.len());
        for (index, value) in values.iter().enumerate() {
            let frame = Entry::new(value).and_then(|entry| FrameEntry::new(&entry));
            frames.push(frame.with_context(|| {
                let name = value.get("file_path").and_then(Value::as_str).unwrap_or("unnamed");
                frame_label(path, index, name)
            })?);
        }
        Ok(Self { path: path.to_path_buf(), frames, lens, split_lists })
    }

    /// Returns the path of the file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the error of a file without frames.
    pub(crate) fn no_frames(&self) -> anyhow::Error {
        anyhow!("{}: `frames` is empty; at least one view is required", path_text(&self.path))
    }

    /// Reads the frames, if any.
    pub(crate) fn frames(
        &self,
        lookup: &mut Lookup,
        on_missing: MissingImages,
    ) -> anyhow::Result<ReadFrames> {
        let (mut read, mut labels) = (ReadFrames::default(), Vec::new());
        for (index, entry) in self.frames.iter().enumerate() {
            let label = || frame_label(&self.path, index, &entry.file_path);
            let file = match lookup.find(&entry.file_path) {
                Err(error) if error.is_missing() && on_missing == MissingImages::Skipped => {
                    read.missing.push(entry.file_path.clone());
                    continue;
                }
                found => found.with_context(label)?,
            };
            let image = lookup.root().join(&file.path);
            let mut frame = read_frame(image, entry, &self.lens).with_context(label)?;
            frame.mask = find_mask(lookup, entry).with_context(label)?;
            frame.depth_file =
                find_depth(lookup, entry, &mut read.unused_depths).with_context(label)?;
            read.names.add(read.frames.len(), &entry.file_path, file.path);
            read.frames.push(frame);
            labels.push(file.label);
        }
        if let Some(first) = read.missing.first().filter(|_| read.frames.is_empty()) {
            bail!(images_missing(read.missing.len(), None, first).context(path_text(&self.path)));
        }
        assign_names(&mut read.frames, &self.path, &labels)?;
        Ok(read)
    }
}

/// Finds the mask that a frame names, if any.
fn find_mask(lookup: &mut Lookup, entry: &FrameEntry) -> Result<Option<MaskFile>, LookupError> {
    let Some(name) = &entry.mask_path else { return Ok(None) };
    let path = lookup.find(name)?.path;
    Ok(Some(MaskFile { path: lookup.root().join(path), kind: MaskKind::Listed }))
}

/// Finds the depth image that a frame names, if any. Only EXR contains true depth; nerfstudio's PNG
/// files are estimates and may be missing.
fn find_depth(
    lookup: &mut Lookup,
    entry: &FrameEntry,
    unused: &mut Vec<String>,
) -> Result<Option<PathBuf>, LookupError> {
    let Some(name) = &entry.depth_file_path else { return Ok(None) };
    match lookup.find(name) {
        Ok(file) if is_exr(&file.path) => Ok(Some(lookup.root().join(file.path))),
        Err(error) if is_exr(Path::new(name)) => Err(error),
        _ => {
            unused.push(name.clone());
            Ok(None)
        }
    }
}

/// Returns the message of a JSON error, cut where serde repeats a long string.
fn json_message(error: &serde_json::Error) -> String {
    let text = error.to_string();
    match shortened(&text) {
        Cow::Borrowed(_) => text,
        Cow::Owned(cut) => format!("{cut} at line {} column {}", error.line(), error.column()),
    }
}

/// Parses the JSON. Python's `NaN` and `Infinity` are accepted as numbers, so that the later error
/// names the frame.
fn parse(text: &str) -> Result<Value, serde_json::Error> {
    serde_json::from_str(text).or_else(|error| match quote_python_numbers(text) {
        Some(readable) => serde_json::from_str(&readable).map_err(|_| error),
        None => Err(error),
    })
}

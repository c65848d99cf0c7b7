//! Reads files that list frames: `transforms.json`, `transforms_train.json` and so on.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use artifact::shortened;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::error::{DatasetError, Reason};
use crate::file_status::FileProblem;
use crate::frame::{Frame, assign_names};
use crate::lookup::{Located, Lookup};
use crate::masks::{MaskFile, MaskKind};
use crate::number::quote_python_numbers;
use crate::photograph::is_exr;
use crate::split::{FrameNames, SplitLists};
use crate::text::{counted_with_verb, read_text};
use crate::transforms::{FrameEntry, Transforms, read_frame};

/// Remedy for images above the folder of the file that lists them.
const GIVE_FOLDER_ABOVE: &str = "move this file to the folder above, and give that folder";

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
    transforms: Transforms,
    frames: Vec<FrameEntry>,
}

/// Frames of a file, and names of files that can't be read.
#[derive(Default)]
pub(crate) struct ReadFrames {
    pub(crate) frames: Vec<Frame>,
    pub(crate) names: FrameNames,
    /// Skipped frames whose image doesn't exist.
    missing: CountedNames,
    /// Depth images that aren't EXR, missing ones included.
    unused_depths: CountedNames,
}

/// Number of files, and the name of the first.
#[derive(Default)]
struct CountedNames {
    count: usize,
    first: Option<String>,
}

impl CountedNames {
    fn add(&mut self, name: &str) {
        self.count += 1;
        self.first.get_or_insert_with(|| name.to_owned());
    }
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
        let SplitLists { train, test, val } = file.split_lists();
        repeated.extend([train, test, val].into_iter().flatten().map(String::as_str));
    }
    Lookup::in_folder(folder, &names, &repeated)
}

impl ReadFrames {
    /// Returns the note on skipped frames, if any.
    pub(crate) fn missing_note(&self) -> Option<String> {
        let first = self.missing.first.as_ref()?;
        let (count, frames) = (self.missing.count, self.frames.len() + self.missing.count);
        Some(format!(
            "{count} of {frames} frames have no image file and are skipped (first: {first})"
        ))
    }

    /// Returns the note on unused depth images, if any.
    pub(crate) fn depth_note(&self) -> Option<String> {
        let first = self.unused_depths.first.as_ref()?;
        let unused = counted_with_verb(self.unused_depths.count, "depth image", ["is", "are"]);
        Some(format!("{unused} not used (depth_file_path, first: {first}); only EXR depth is"))
    }
}

impl FrameFile {
    /// Parses a file.
    pub(crate) fn read(path: &Path) -> Result<Self, DatasetError> {
        let text = read_text(path)?;
        let file_error = |reason: Reason| DatasetError::format(path, reason);
        if text.trim().is_empty() {
            return Err(file_error(Reason::new("file is empty")));
        }
        let value = parse(&text).map_err(|error| file_error(Reason::new(json_message(&error))))?;
        let mut transforms: Transforms =
            from_object(&value, &json!({"frames": []})).map_err(file_error)?;
        let required = json!({"file_path": "", "transform_matrix": []});
        let (values, mut frames) = (std::mem::take(&mut transforms.frames), Vec::new());
        for (index, value) in values.iter().enumerate() {
            let frame = from_object(value, &required);
            frames.push(frame.map_err(|reason| {
                let name = value.get("file_path").and_then(Value::as_str).unwrap_or("unnamed");
                DatasetError::frame(path, index, name, reason)
            })?);
        }
        Ok(Self { path: path.to_path_buf(), transforms, frames })
    }

    /// Returns the path of the file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the error of a file without frames.
    pub(crate) fn no_frames(&self) -> DatasetError {
        let reason = Reason::new("`frames` is empty; at least one view is required");
        DatasetError::format(&self.path, reason)
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

    /// Reads the frames, if any.
    pub(crate) fn frames(
        &self,
        lookup: &mut Lookup,
        on_missing: MissingImages,
    ) -> Result<ReadFrames, DatasetError> {
        let (mut read, mut labels) = (ReadFrames::default(), Vec::new());
        for (index, entry) in self.frames.iter().enumerate() {
            let frame_error =
                |reason| DatasetError::frame(&self.path, index, &entry.file_path, reason);
            let located = lookup.find(&entry.file_path).map_err(|error| {
                let reason = Reason::from(error);
                let is_above = entry.file_path.starts_with("../");
                frame_error(if is_above { reason.with_remedy(GIVE_FOLDER_ABOVE) } else { reason })
            })?;
            let file = match located {
                Located::File(file) => file,
                Located::Missing(problem) if on_missing == MissingImages::Refused => {
                    let remedy = "remove the frame or restore the file";
                    return Err(frame_error(Reason::unusable(&problem, remedy)));
                }
                Located::Missing(_) => {
                    read.missing.add(&entry.file_path);
                    continue;
                }
                Located::Unusable(problem) => {
                    let remedy = "remove the frame or name its image";
                    return Err(frame_error(Reason::unusable(&problem, remedy)));
                }
            };
            let image = lookup.root().join(&file.path);
            let shared = &self.transforms.shared;
            let mut frame = read_frame(image, entry, shared).map_err(frame_error)?;
            frame.mask = find_mask(lookup, entry).map_err(frame_error)?;
            frame.depth_file =
                find_depth(lookup, entry, &mut read.unused_depths).map_err(frame_error)?;
            read.names.add(read.frames.len(), &entry.file_path, file.path);
            read.frames.push(frame);
            labels.push(file.label);
        }
        if let Some(first) = read.missing.first.as_ref().filter(|_| read.frames.is_empty()) {
            let reason = Reason::images_missing(read.missing.count, None, first);
            return Err(DatasetError::format(&self.path, reason));
        }
        assign_names(&mut read.frames, &self.path, &labels)?;
        Ok(read)
    }
}

/// Finds the mask that a frame names, if any.
fn find_mask(lookup: &mut Lookup, entry: &FrameEntry) -> Result<Option<MaskFile>, Reason> {
    let Some(name) = &entry.mask_path else { return Ok(None) };
    match lookup.find(name)? {
        Located::File(file) => {
            let path = lookup.root().join(file.path);
            Ok(Some(MaskFile { path, kind: MaskKind::Listed }))
        }
        Located::Missing(problem) | Located::Unusable(problem) => Err(unusable_entry(&problem)),
    }
}

/// Finds the depth image that a frame names, if any. Only EXR contains true depth; nerfstudio's PNG
/// files are estimates and may be missing.
fn find_depth(
    lookup: &mut Lookup,
    entry: &FrameEntry,
    unused: &mut CountedNames,
) -> Result<Option<PathBuf>, Reason> {
    let Some(name) = &entry.depth_file_path else { return Ok(None) };
    match lookup.find(name) {
        Ok(Located::File(file)) if is_exr(&file.path) => Ok(Some(lookup.root().join(file.path))),
        Ok(Located::File(_)) => {
            unused.add(name);
            Ok(None)
        }
        Ok(Located::Missing(_) | Located::Unusable(_)) | Err(_) if !is_exr(Path::new(name)) => {
            unused.add(name);
            Ok(None)
        }
        Ok(Located::Missing(problem) | Located::Unusable(problem)) => Err(unusable_entry(&problem)),
        Err(error) => Err(error.into()),
    }
}

fn unusable_entry(problem: &FileProblem) -> Reason {
    Reason::unusable(problem, "remove the entry or restore the file")
}

/// Returns the message of a JSON error, cut where serde repeats a long string.
fn json_message(error: &serde_json::Error) -> String {
    let text = error.to_string();
    match shortened(&text) {
        Cow::Borrowed(_) => text,
        Cow::Owned(cut) => format!("{cut} at line {} column {}", error.line(), error.column()),
    }
}

/// Converts a JSON object; an error names the key. `required` is an object with the required keys
/// alone: flattened structures lose the position of an error.
fn from_object<T: DeserializeOwned>(value: &Value, required: &Value) -> Result<T, Reason> {
    let reason = |error: serde_json::Error| Reason::new(shortened(&error.to_string()));
    T::deserialize(value).map_err(|error| {
        for (key, value) in value.as_object().into_iter().flatten() {
            let mut single = required.clone();
            single[key] = value.clone();
            if let Err(error) = T::deserialize(&single) {
                return reason(error).at(shortened(key));
            }
        }
        reason(error)
    })
}

/// Parses the JSON. Python's `NaN` and `Infinity` are accepted as numbers, so that the later error
/// names the frame.
fn parse(text: &str) -> Result<Value, serde_json::Error> {
    serde_json::from_str(text).or_else(|error| match quote_python_numbers(text) {
        Some(readable) => serde_json::from_str(&readable).map_err(|_| error),
        None => Err(error),
    })
}

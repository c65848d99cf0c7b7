use std::borrow::Cow;
use std::path::PathBuf;

use artifact::{format_count, format_number, shortened};
use scene::Distortion;

use crate::file_status::{FileProblem, path_text};
use crate::lookup::LookupError;
use crate::npy::ArrayReason;

/// Reason why a file is invalid. Text of the file is unescaped here;
/// [`DatasetError`](crate::DatasetError) escapes it.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FileReason {
    /// Problem in a line of a text file, counted from 1.
    #[error("line {line}: {reason}")]
    Line { line: usize, reason: Box<Self> },
    /// Problem at an offset in a binary file.
    #[error("byte {byte}: {reason}")]
    Byte { byte: usize, reason: Box<Self> },
    #[error("camera {id}: {reason}")]
    Camera { id: u32, reason: Box<Self> },
    #[error("image {id} ({}): {reason}", shortened(name))]
    Image { id: u32, name: String, reason: Box<Self> },
    #[error("file is UTF-16; save it as UTF-8")]
    Utf16,
    /// Text that isn't UTF-8; `word` is its first invalid word with escaped bytes.
    #[error(
        "{} is not UTF-8; save the file as UTF-8, and rename files with such names",
        shortened(word)
    )]
    NotUtf8 { word: String },
    /// Name in a binary file that isn't UTF-8, with escaped bytes.
    #[error(
        "{what}, {}, is not UTF-8; rename the file, and create the model again",
        shortened(name)
    )]
    NameNotUtf8 { what: &'static str, name: String },
    #[error("{}", json_message(.0))]
    Json(#[from] serde_json::Error),
    #[error("not a NumPy array of N×{columns} numbers: {reason}")]
    Array { columns: usize, reason: ArrayReason },
    #[error("{what} is missing")]
    Missing { what: &'static str },
    #[error("{what}: {:?} is not a valid number", shortened(word))]
    InvalidNumber { what: &'static str, word: String },
    #[error("the file ends within {what}; copy it again")]
    CutShort { what: &'static str },
    /// Text without a terminating null byte.
    #[error("{what} is not terminated")]
    Unterminated { what: &'static str },
    /// Number of entries that exceeds the rest of the file.
    #[error("{count} {what} don't fit into the remaining {left} bytes")]
    CountTooLarge { count: u64, what: &'static str, left: usize },
    #[error("unexpected data after the last of the {what}; is this the right file?")]
    TrailingData { what: &'static str },
    #[error(
        "camera {id} has unknown model {model} (from a newer COLMAP?); undistort with colmap \
        image_undistorter"
    )]
    UnknownModelNumber { id: u32, model: u32 },
    #[error(
        "camera model {:?} is unknown (from a newer COLMAP?); undistort with colmap \
        image_undistorter",
        shortened(model)
    )]
    UnknownModelName { model: String },
    #[error("camera model {model} is not supported; undistort with colmap image_undistorter")]
    UnsupportedModel { model: String },
    #[error("{model} has {expected} parameters, not {found}")]
    ParameterCount { model: String, expected: usize, found: usize },
    #[error("image size {width}×{height} is invalid")]
    InvalidSize { width: u64, height: u64 },
    #[error("({}) is not a rotation quaternion", .0.map(format_number).join(", "))]
    Rotation([f64; 4]),
    #[error("`frames` is empty; at least one view is required")]
    NoFrames,
    #[error("the model has no images; at least one is required")]
    NoImages,
    /// None of the named images exists; `folder` is the folder in which all were expected, if there
    /// is a single one.
    #[error(
        "none of the {count} images exists{} (first missing: {})",
        folder.as_ref().map(|folder| format!(" in {}", path_text(folder))).unwrap_or_default(),
        shortened(first)
    )]
    ImagesMissing { count: usize, folder: Option<PathBuf>, first: String },
    /// None of the names in a list of a split belongs to a frame.
    #[error("none of the {count} names in {list} is that of a frame (first: {first})")]
    NoFrameListed { list: &'static str, count: usize, first: String },
    #[error(transparent)]
    Lookup(#[from] LookupError),
    #[error("line {line} should be the points of image {image} (an empty line if there are none)")]
    PointsExpected { line: usize, image: String },
    #[error("{poses} poses {}", folders_text(folders))]
    Counts { poses: usize, folders: Vec<ImageFolder> },
    #[error("lens distortion {0} leaves no pinhole image; are its coefficients right?")]
    Distortion(Distortion),
}

/// Returns the message of a JSON error, cut where serde repeats a long string.
fn json_message(error: &serde_json::Error) -> String {
    let text = error.to_string();
    match shortened(&text) {
        Cow::Borrowed(_) => text,
        Cow::Owned(cut) => format!("{cut} at line {} column {}", error.line(), error.column()),
    }
}

impl FileReason {
    pub(crate) fn on_line(self, line: usize) -> Self {
        Self::Line { line, reason: Box::new(self) }
    }
}

/// Folder with images, for [`FileReason::Counts`].
#[derive(Debug)]
pub(crate) struct ImageFolder {
    pub(crate) name: String,
    /// Number of images.
    pub(crate) images: usize,
    /// First entry that is named like an image but can't be read.
    pub(crate) unusable: Option<FileProblem>,
    /// Number and format of images in an unsupported format, with the remedy.
    pub(crate) unsupported: Option<String>,
}

/// Lists the folders with their numbers of images.
fn folders_text(folders: &[ImageFolder]) -> String {
    if folders.is_empty() {
        return "without a folder images next to them".to_owned();
    }
    let mut listed = Vec::new();
    for ImageFolder { name, images, unusable, unsupported } in folders {
        let remark = unusable.as_ref().map(ToString::to_string).or_else(|| unsupported.clone());
        let remark = remark.map(|remark| format!(" ({remark})")).unwrap_or_default();
        listed.push(format!("{} in {name}/{remark}", format_count(*images, "image")));
    }
    format!(
        "for {}; counts must match, or view_imgs.txt must list the images that have poses",
        listed.join(" and ")
    )
}

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use artifact::{counted, number, shortened};
use scene::Distortion;

use crate::lookup::LookupError;
use crate::misplaced::{Misplaced, shown};
use crate::npy::ArrayReason;

/// Why a file isn't of its form. Text of the file is as it is there; [`DatasetError`] escapes it.
///
/// [`DatasetError`]: crate::DatasetError
#[derive(Debug, thiserror::Error)]
pub enum FileReason {
    /// Something about a line of a text file.
    #[error("line {line}: {reason}")]
    Line {
        /// Which, counted from 1.
        line: usize,
        /// What is wrong there.
        reason: Box<Self>,
    },
    /// Something about a place in a binary file.
    #[error("byte {byte}: {reason}")]
    Byte {
        /// How many bytes are before it.
        byte: usize,
        /// What is wrong there.
        reason: Box<Self>,
    },
    /// Something about a camera of a binary file.
    #[error("camera {id}: {reason}")]
    Camera {
        /// Its number.
        id: u32,
        /// What is wrong with it.
        reason: Box<Self>,
    },
    /// Something about an image of a binary file.
    #[error("image {id} ({}): {reason}", shortened(name))]
    Image {
        /// Its number.
        id: u32,
        /// Its name.
        name: String,
        /// What is wrong with it.
        reason: Box<Self>,
    },
    /// Text that is encoded otherwise.
    #[error("is UTF-16; save it as UTF-8")]
    Utf16,
    /// Text that isn't.
    #[error(
        "{} is not UTF-8; save the file as UTF-8, and rename what it names so",
        shortened(word)
    )]
    NoText {
        /// The first word that isn't, its bytes spelled out.
        word: String,
    },
    /// A name in a binary file that isn't text.
    #[error("{what}, {}, is not UTF-8; rename the file, and make the model again", shortened(name))]
    NoName {
        /// Whose name.
        what: &'static str,
        /// The name, its bytes spelled out.
        name: String,
    },
    /// It isn't the JSON that was expected.
    #[error("{}", json_problem(.0))]
    Json(#[from] serde_json::Error),
    /// It isn't the array that was expected.
    #[error("not a NumPy array of N×{columns} numbers: {reason}")]
    Array {
        /// Numbers of a row.
        columns: usize,
        /// What is wrong with it.
        reason: ArrayReason,
    },
    /// Something is missing.
    #[error("{what} is missing")]
    Missing {
        /// What.
        what: &'static str,
    },
    /// A word isn't a number.
    #[error("{what}: {:?} is not a number of its kind", shortened(word))]
    NoNumber {
        /// What it is to say.
        what: &'static str,
        /// The word.
        word: String,
    },
    /// It ends too early.
    #[error("the file ends within {what}; it is cut short, copy it again")]
    CutShort {
        /// Where.
        what: &'static str,
    },
    /// Text without an end.
    #[error("{what} doesn't end")]
    Endless {
        /// What text.
        what: &'static str,
    },
    /// It claims more than it holds.
    #[error("{count} {what} can't be in the {left} bytes that follow")]
    TooMany {
        /// How much it claims.
        count: u64,
        /// Of what.
        what: &'static str,
        /// The bytes that there are.
        left: usize,
    },
    /// It ends too late.
    #[error("there is more after the last of the {what}; is it another file?")]
    More {
        /// What it lists.
        what: &'static str,
    },
    /// A number of no camera model.
    #[error(
        "camera {id} has model {model}, which this program doesn't know (a newer COLMAP's?); \
        undistort with colmap image_undistorter"
    )]
    ModelNumber {
        /// The camera.
        id: u32,
        /// The number.
        model: u32,
    },
    /// A name of no camera model.
    #[error(
        "camera model {:?} is unknown (a newer COLMAP's?); undistort with colmap \
        image_undistorter",
        shortened(model)
    )]
    ModelName {
        /// The name.
        model: String,
    },
    /// A camera model that isn't read.
    #[error("camera model {model} is not supported; undistort with colmap image_undistorter")]
    Model {
        /// Its name.
        model: String,
    },
    /// A camera model with too many parameters or too few.
    #[error("{model} has {expected} parameters, not {found}")]
    Parameters {
        /// Its name.
        model: String,
        /// How many it has.
        expected: usize,
        /// How many there are.
        found: usize,
    },
    /// A size that no image has.
    #[error("its size is {width}×{height}")]
    Size {
        /// Columns.
        width: u64,
        /// Rows.
        height: u64,
    },
    /// A quaternion that is no rotation.
    #[error("its rotation ({}) is none", .0.map(number).join(", "))]
    Rotation([f64; 4]),
    /// A list of frames has none.
    #[error("`frames` is empty; at least one view is needed")]
    NoFrames,
    /// A model has no images.
    #[error("it has no images; at least one is needed")]
    NoImages,
    /// None of the images that it names is there.
    #[error(
        "none of the {count} images exists{} (first missing: {})",
        place(folder.as_deref()), shortened(first)
    )]
    ImagesMissing {
        /// How many it names.
        count: usize,
        /// Where they should be, if all in one folder.
        folder: Option<PathBuf>,
        /// The first.
        first: String,
    },
    /// A list of file names for a split has no name of a frame.
    #[error("none of the {count} names in {list} is that of a frame (first: {first})")]
    NoFrameListed {
        /// Key of the list.
        list: &'static str,
        /// Number of names in the list.
        count: usize,
        /// First name.
        first: String,
    },
    /// A name leads to no single file inside the folder.
    #[error(transparent)]
    Lookup(#[from] LookupError),
    /// The second line of an image in a text file is missing.
    #[error("line {line} should be the points of image {image} (an empty line if there are none)")]
    PointsExpected {
        /// Line, counted from 1.
        line: usize,
        /// Number of the image, as the file writes it.
        image: String,
    },
    /// No folder has an image for every pose.
    #[error("{poses} poses {}", listed(folders))]
    Counts {
        /// How many poses there are.
        poses: usize,
        /// The folders of images.
        folders: Vec<ImageFolder>,
    },
    /// Distortion that can't be undone.
    #[error("lens distortion {0} leaves no pinhole's image; are its coefficients right?")]
    Distortion(Distortion),
}

/// Returns the message of a JSON error, cut where serde repeats a long string.
fn json_problem(error: &serde_json::Error) -> String {
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

    pub(crate) fn of_camera(self, id: u32) -> Self {
        Self::Camera { id, reason: Box::new(self) }
    }

    pub(crate) fn of_image(self, id: u32, name: &str) -> Self {
        Self::Image { id, name: name.to_owned(), reason: Box::new(self) }
    }
}

/// A folder with images.
#[derive(Debug)]
pub struct ImageFolder {
    /// Its name.
    pub name: String,
    /// How many it has.
    pub images: usize,
    /// The first thing in it that is named like an image and can't be read.
    pub odd: Option<Misplaced>,
    /// Number and format of its images in a format that isn't read, with the remedy.
    pub unread: Option<String>,
}

fn place(folder: Option<&Path>) -> String {
    folder.map(|folder| format!(" in {}", shown(folder))).unwrap_or_default()
}

fn listed(folders: &[ImageFolder]) -> String {
    if folders.is_empty() {
        return "without a folder images next to them".to_owned();
    }
    let one = |ImageFolder { name, images, odd, unread }: &ImageFolder| {
        let remark = odd.as_ref().map(ToString::to_string).or_else(|| unread.clone());
        let remark = remark.map(|remark| format!(" ({remark})")).unwrap_or_default();
        format!("{} in {name}/{remark}", counted(*images, "image"))
    };
    let each: Vec<String> = folders.iter().map(one).collect();
    format!(
        "for {}; counts must match, or view_imgs.txt list the images with poses",
        each.join(" and ")
    )
}

use std::io;
use std::path::{Path, PathBuf};

use artifact::{PathError, printable};
use scene::{CameraError, Distortion};

use crate::format::signs;
use crate::npy::ArrayReason;

/// A data set that can't be used.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder has none of the forms.
    #[error("{}: no data set; expected {}", shown(path), signs())]
    Unknown {
        /// The folder.
        path: PathBuf,
    },
    /// A file can't be read.
    #[error("{}: {source}", shown(path))]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A file can't be where something else stands.
    #[error("{0}")]
    Place(Misplaced),
    /// A file isn't of its form.
    #[error("{}: {}", shown(path), printable(&reason.to_string()))]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong, with its place, and what to do.
        reason: FileReason,
    },
    /// Something about one frame.
    #[error(
        "{}: frame {index} ({}): {}", shown(path), printable(file), printable(&reason.to_string())
    )]
    Frame {
        /// The file that lists the frames.
        path: PathBuf,
        /// The frame, counted from 0.
        index: usize,
        /// What that file calls it.
        file: String,
        /// What is wrong and what to do.
        reason: Box<FrameReason>,
    },
    /// An image that can't be read.
    #[error("{}", printable(&.0.to_string()))]
    Pixels(pixels::PixelError),
}

// Not its source: whoever prints a chain of errors would print a file's name as it is.
impl From<pixels::PixelError> for DatasetError {
    fn from(error: pixels::PixelError) -> Self {
        Self::Pixels(error)
    }
}

impl DatasetError {
    pub(crate) fn format(path: &Path, reason: impl Into<FileReason>) -> Self {
        Self::Format { path: path.to_path_buf(), reason: reason.into() }
    }

    pub(crate) fn frame(path: &Path, index: usize, file: &str, reason: FrameReason) -> Self {
        let (path, file) = (path.to_path_buf(), file.to_owned());
        Self::Frame { path, index, file, reason: Box::new(reason) }
    }
}

/// What stands at a place where a file is wanted.
#[derive(Debug, thiserror::Error)]
pub enum Misplaced {
    /// Nothing.
    #[error("{} is not there", shown(path))]
    Nothing {
        /// The place.
        path: PathBuf,
    },
    /// Something that is no file.
    #[error("{} is {kind}, not {wanted}", shown(path))]
    Kind {
        /// The place.
        path: PathBuf,
        /// What it is.
        kind: &'static str,
        /// What the file was to be.
        wanted: &'static str,
    },
    /// A link to nothing, there or on the way.
    #[error("{} is a symbolic link to {}, which is not there", shown(link), shown(target))]
    Dangling {
        /// The link.
        link: PathBuf,
        /// Where it leads.
        target: PathBuf,
    },
    /// A link that can't be followed, there or on the way.
    #[error("{} is a symbolic link that leads nowhere: {error}", shown(link))]
    Nowhere {
        /// The link.
        link: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// Nobody knows.
    #[error("{} can't be looked at: {error}", shown(path))]
    Unseen {
        /// The place.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

/// Why a file isn't of its form.
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
    #[error("image {id} ({name}): {reason}")]
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
    #[error("{word} is not UTF-8; save the file as UTF-8, and rename what it names so")]
    NoText {
        /// The first word that isn't, its bytes spelled out.
        word: String,
    },
    /// A name in a binary file that isn't text.
    #[error("{what}, {name}, is not UTF-8; rename the file, and make the model again")]
    NoName {
        /// Whose name.
        what: &'static str,
        /// The name, its bytes spelled out.
        name: String,
    },
    /// It isn't the JSON that was expected.
    #[error(transparent)]
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
    #[error("{what}: {word:?} is not a number of its kind")]
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
    #[error("camera {id} has model {model}, which COLMAP doesn't have")]
    ModelNumber {
        /// The camera.
        id: u32,
        /// The number.
        model: u32,
    },
    /// A name of no camera model.
    #[error("camera model {model:?} is none of COLMAP's")]
    ModelName {
        /// The name.
        model: String,
    },
    /// A camera model that isn't read.
    #[error("camera model {model} is not supported; undistort first (colmap image_undistorter)")]
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
    #[error("its rotation ({}, {}, {}, {}) is none", .0[0], .0[1], .0[2], .0[3])]
    Rotation([f64; 4]),
    /// A list of frames has none.
    #[error("`frames` is empty; at least one view is needed")]
    NoFrames,
    /// A model has no images.
    #[error("it has no images; at least one is needed")]
    NoImages,
    /// None of the images that it names is there.
    #[error("not one of its {count} images is {}, first {first}", place(folder.as_deref()))]
    ImagesMissing {
        /// How many it names.
        count: usize,
        /// Where they should be, if all in one folder.
        folder: Option<PathBuf>,
        /// The first.
        first: String,
    },
    /// No folder has an image for every pose.
    #[error("{poses} poses, but {}; images and poses must be as many", listed(folders))]
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
}

fn place(folder: Option<&Path>) -> String {
    folder.map_or_else(|| "there".to_owned(), |folder| format!("in {}", shown(folder)))
}

fn listed(folders: &[ImageFolder]) -> String {
    if folders.is_empty() {
        return "there is no folder images".to_owned();
    }
    let one = |ImageFolder { name, images, odd }: &ImageFolder| {
        let odd = odd.as_ref().map(|odd| format!(" ({odd})")).unwrap_or_default();
        format!("{name} has {images}{odd}")
    };
    folders.iter().map(one).collect::<Vec<_>>().join(", ")
}

/// Why a frame can't be used.
#[derive(Debug, thiserror::Error)]
pub enum FrameReason {
    /// The path of its image, mask or depth.
    #[error(transparent)]
    Path(#[from] PathError),
    /// Its image can't be read.
    #[error(transparent)]
    Pixels(#[from] pixels::PixelError),
    /// It has no camera that can be.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// Its pose is none.
    #[error("transform_matrix: {0}")]
    Pose(CameraError),
    /// A pose of another size.
    #[error("transform_matrix must have 4 rows of 4 numbers")]
    Matrix,
    /// An image, mask or depth isn't where it should be.
    #[error("{found}; {remedy}")]
    Place {
        /// What stands there.
        found: Misplaced,
        /// What to do.
        remedy: &'static str,
    },
    /// Its camera isn't listed.
    #[error("there is no camera {id}")]
    NoCamera {
        /// The camera's number.
        id: u32,
    },
    /// Something about a camera that is listed.
    #[error("{reason} (camera {id})")]
    OfCamera {
        /// The camera's number.
        id: u32,
        /// What is wrong.
        reason: Box<Self>,
    },
    /// Image and camera have different shapes.
    #[error(
        "the image has {}×{} pixels, its camera {}×{}: another shape",
        image.0, image.1, camera.0, camera.1
    )]
    Shape {
        /// The image's columns and rows.
        image: (u32, u32),
        /// The camera's.
        camera: (u32, u32),
    },
    /// A side of an image that none has.
    #[error("{name} is {value}")]
    Side {
        /// Which.
        name: &'static str,
        /// Its length.
        value: f64,
    },
    /// A side of an image without pixels.
    #[error("{name} is {value}; an image has at least one pixel")]
    Empty {
        /// Which.
        name: &'static str,
        /// Its length.
        value: f64,
    },
    /// Depths that contradict each other.
    #[error("its bounds are {near} and {far}; 0 < near < far is expected")]
    Depths {
        /// Of the nearest point.
        near: f64,
        /// Of the farthest.
        far: f64,
    },
    /// A camera model that isn't read.
    #[error(
        "camera_model {model:?} is not supported; undistort the images first (colmap \
        image_undistorter)"
    )]
    Model {
        /// Its name.
        model: String,
    },
    /// A fisheye lens.
    #[error("fisheye lenses are not supported; undistort the images first")]
    Fisheye,
    /// Nothing says how wide it looks.
    #[error("no focal length: neither fl_x nor camera_angle_x is given")]
    NoFocalLength,
    /// An angle of view that no pinhole has.
    #[error("{name} is {angle}: focal length {focal}; the angle must lie between 0 and π")]
    Angle {
        /// What says it.
        name: &'static str,
        /// The angle.
        angle: f64,
        /// The focal length that follows, in image sides.
        focal: f64,
    },
    /// Another frame has its name.
    #[error("a second view named {name:?}; file names must differ")]
    SecondName {
        /// The name.
        name: String,
    },
    /// A name that isn't text.
    #[error("its name is not UTF-8; rename the file")]
    NoName,
}

/// A path for a message, on one line; bytes that aren't UTF-8 are spelled out, as in `\xFF`.
pub(crate) fn shown(path: &Path) -> String {
    match path.to_str() {
        Some(text) => printable(text).into_owned(),
        None => format!("{path:?}").trim_matches('"').to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt as _;

    use super::*;

    #[test]
    fn paths_are_shown_on_one_line() {
        assert_eq!(shown(Path::new("a\u{1b}[31m/b\n.png")), "a\\u{1b}[31m/b\\n.png");
        assert_eq!(shown(Path::new(OsStr::from_bytes(b"a\xff\n.png"))), "a\\xFF\\n.png");
    }
}

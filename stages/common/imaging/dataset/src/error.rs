use std::io;
use std::path::{Path, PathBuf};

use artifact::{format_number, printable, shortened};
use scene::CameraError;

use crate::file_reason::FileReason;
use crate::file_status::{FileProblem, path_text};
use crate::format::expected_files;
use crate::lookup::LookupError;
use crate::nearby::Nearby;

/// Error returned when a data set can't be read; its message names the file and the remedy.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct DatasetError(#[from] Problem);

/// Kinds of [`DatasetError`]. Reasons aren't error sources: a printed chain of errors would contain
/// a file's text unescaped.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Problem {
    #[error("{}: no data set; {}", path_text(path), hint(nearby.as_ref()))]
    Unrecognised { path: PathBuf, nearby: Option<Nearby> },
    #[error("{}: {source}", path_text(path))]
    Io { path: PathBuf, source: io::Error },
    #[error("{0}")]
    File(FileProblem),
    #[error("{}: {}", path_text(path), printable(&reason.to_string()))]
    Format { path: PathBuf, reason: FileReason },
    /// Problem with the frame `index`, counted from 0, of the list in `path`; `file` is the frame's
    /// name in that list.
    #[error(
        "{}: frame {index} ({}): {}",
        path_text(path), printable(&shortened(file)), printable(&reason.to_string())
    )]
    Frame { path: PathBuf, index: usize, file: String, reason: Box<FrameReason> },
    #[error("{}", printable(&.0.to_string()))]
    Pixels(pixels::PixelError),
}

/// Returns what was found instead of a data set, or what was expected.
fn hint(nearby: Option<&Nearby>) -> String {
    match nearby {
        Some(nearby) => printable(&nearby.to_string()).into_owned(),
        None => format!("expected {}", expected_files()),
    }
}

impl From<pixels::PixelError> for DatasetError {
    fn from(error: pixels::PixelError) -> Self {
        Self(Problem::Pixels(error))
    }
}

impl From<FileProblem> for DatasetError {
    fn from(problem: FileProblem) -> Self {
        Self(Problem::File(problem))
    }
}

impl DatasetError {
    /// True if the folder contains neither a data set nor a sign of one.
    pub fn is_unrecognised(&self) -> bool {
        matches!(self.0, Problem::Unrecognised { nearby: None, .. })
    }

    pub(crate) fn io(path: &Path, source: io::Error) -> Self {
        Self(Problem::Io { path: path.to_path_buf(), source })
    }

    pub(crate) fn format(path: &Path, reason: impl Into<FileReason>) -> Self {
        Self(Problem::Format { path: path.to_path_buf(), reason: reason.into() })
    }

    pub(crate) fn frame(path: &Path, index: usize, file: &str, reason: FrameReason) -> Self {
        let (path, file) = (path.to_path_buf(), file.to_owned());
        Self(Problem::Frame { path, index, file, reason: Box::new(reason) })
    }
}

/// Reason why a frame is invalid. Text of a file is unescaped here; [`DatasetError`] escapes it.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FrameReason {
    #[error(transparent)]
    Lookup(#[from] LookupError),
    #[error(transparent)]
    Pixels(#[from] pixels::PixelError),
    #[error(transparent)]
    Camera(#[from] CameraError),
    #[error("transform_matrix: {0}")]
    Pose(CameraError),
    #[error("transform_matrix must have 4 rows of 4 numbers")]
    MatrixSize,
    /// Missing or unusable image, mask or depth image.
    #[error("{problem}; {}", match problem {
        FileProblem::IgnoredName { .. } => "rename the file",
        _ => remedy,
    })]
    File { problem: FileProblem, remedy: &'static str },
    #[error("camera {id} not found")]
    CameraNotFound { id: u32 },
    #[error("{reason} (camera {id})")]
    OfCamera { id: u32, reason: Box<Self> },
    #[error(
        "the image has {}×{} pixels, its camera {}×{}; aspect ratios must match",
        image.0, image.1, camera.0, camera.1
    )]
    AspectRatio { image: (u32, u32), camera: (u32, u32) },
    #[error("{name} is {}; an image has 1 to {} pixels per side", format_number(*value), u32::MAX)]
    InvalidSide { name: &'static str, value: f64 },
    #[error(
        "bounds {} and {}, expected 0 < near < far; LLFF's imgs2poses confuses views if COLMAP \
        registered them in another order than that of their names: rerun COLMAP on images sorted \
        by name, or use COLMAP's model without poses_bounds.npy",
        format_number(*near), format_number(*far)
    )]
    InvalidDepths { near: f64, far: f64 },
    #[error(
        "camera_model {:?} is not supported; undistort the images first (colmap \
        image_undistorter)",
        shortened(model)
    )]
    UnsupportedModel { model: String },
    #[error("no focal length: neither fl_x nor camera_angle_x is given")]
    NoFocalLength,
    /// Angle of view outside 0 to π; `focal` is the resulting focal length in image sides.
    #[error(
        "{name} is {}: focal length {}; the angle must be between 0 and π",
        format_number(*angle), format_number(*focal)
    )]
    InvalidAngle { name: &'static str, angle: f64, focal: f64 },
    /// View name that belongs to another frame, whose image is `first`.
    #[error(
        "view name {:?} is already that of {}; rename one of the two files",
        shortened(name),
        shortened(first)
    )]
    DuplicateName { name: String, first: String },
    #[error("file name is not UTF-8; rename the file")]
    NameNotUtf8,
}

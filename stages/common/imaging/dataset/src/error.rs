use std::fmt::{self, Display};
use std::io;
use std::path::{Path, PathBuf};

use artifact::{format_number, printable, shortened};

use crate::file_status::{FileProblem, path_text};
use crate::format::expected_files;

/// Error returned when a data set can't be read; its message names the file and the remedy.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct DatasetError(#[from] Problem);

/// Kinds of [`DatasetError`]. Reasons aren't error sources: a printed chain of errors would contain
/// a file's text unescaped.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Problem {
    #[error("{}: no data set; {}", path_text(path), hint(finding.as_ref()))]
    Unrecognised {
        path: PathBuf,
        /// Other files found, with the remedy.
        finding: Option<String>,
    },
    #[error("{}: {source}", path_text(path))]
    Io { path: PathBuf, source: io::Error },
    #[error("{0}")]
    File(FileProblem),
    #[error("{}: {}", path_text(path), printable(&reason.to_string()))]
    Format { path: PathBuf, reason: Reason },
    /// Problem with the frame `index`, counted from 0, of the list in `path`; `file` is the frame's
    /// name in that list.
    #[error(
        "{}: frame {index} ({}): {}",
        path_text(path), printable(&shortened(file)), printable(&reason.to_string())
    )]
    Frame { path: PathBuf, index: usize, file: String, reason: Reason },
    #[error("{}", printable(&.0.to_string()))]
    Pixels(pixels::PixelError),
}

/// Returns what was found instead of a data set, or what was expected.
fn hint(finding: Option<&String>) -> String {
    match finding {
        Some(finding) => printable(finding).into_owned(),
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
        matches!(self.0, Problem::Unrecognised { finding: None, .. })
    }

    pub(crate) fn io(path: &Path, source: io::Error) -> Self {
        Self(Problem::Io { path: path.to_path_buf(), source })
    }

    pub(crate) fn format(path: &Path, reason: impl Into<Reason>) -> Self {
        Self(Problem::Format { path: path.to_path_buf(), reason: reason.into() })
    }

    pub(crate) fn frame(path: &Path, index: usize, file: &str, reason: Reason) -> Self {
        let (path, file) = (path.to_path_buf(), file.to_owned());
        Self(Problem::Frame { path, index, file, reason })
    }
}

/// Reason why a file or a frame is invalid. Text of the data set is unescaped here;
/// [`DatasetError`] escapes it.
#[derive(Debug, PartialEq)]
pub(crate) struct Reason(String);

impl Reason {
    pub(crate) fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// Adds the position of the problem in the file.
    pub(crate) fn at(self, position: impl Display) -> Self {
        Self(format!("{position}: {self}"))
    }

    /// Adds what to do.
    pub(crate) fn with_remedy(self, remedy: &str) -> Self {
        Self(format!("{self}; {remedy}"))
    }

    /// Returns the reason for a missing or unusable image, mask or depth image.
    pub(crate) fn unusable(problem: &FileProblem, remedy: &str) -> Self {
        let is_ignored = matches!(problem, FileProblem::IgnoredName { .. });
        Self(format!("{problem}; {}", if is_ignored { "rename the file" } else { remedy }))
    }

    /// Returns the reason for a side of an image that isn't a number of pixels.
    pub(crate) fn invalid_side(name: &str, value: f64) -> Self {
        let value = format_number(value);
        Self(format!("{name} is {value}; an image has 1 to {} pixels per side", u32::MAX))
    }

    /// Returns the reason for a file none of whose images exists. `folder` is the folder
    /// in which all were expected, if there is a single one.
    pub(crate) fn images_missing(count: usize, folder: Option<&Path>, first: &str) -> Self {
        let folder = folder.map(|folder| format!(" in {}", path_text(folder))).unwrap_or_default();
        let first = shortened(first);
        Self(format!("none of the {count} images exists{folder} (first missing: {first})"))
    }
}

impl Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl<E: std::error::Error> From<E> for Reason {
    fn from(error: E) -> Self {
        Self(error.to_string())
    }
}

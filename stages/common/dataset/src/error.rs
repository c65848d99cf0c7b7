use std::io;
use std::path::{Path, PathBuf};

use artifact::{printable, shortened};

use crate::file_reason::FileReason;
use crate::format::signs;
use crate::frame_reason::FrameReason;
use crate::misplaced::{Misplaced, shown};
use crate::nearby::Nearby;

/// A data set that can't be used.
///
/// Reasons aren't sources: whoever prints a chain of errors would print a file's text as it is.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder has none of the forms.
    #[error("{}: no data set; {}", shown(path), instead(nearby.as_ref()))]
    Unknown {
        /// The folder.
        path: PathBuf,
        /// What the folder contains instead.
        nearby: Option<Nearby>,
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
        "{}: frame {index} ({}): {}", shown(path), printable(&shortened(file)), printable(&reason.to_string())
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

/// Returns what was found instead of a data set, or what was expected.
fn instead(nearby: Option<&Nearby>) -> String {
    match nearby {
        Some(nearby) => printable(&nearby.to_string()).into_owned(),
        None => format!("expected {}", signs()),
    }
}

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

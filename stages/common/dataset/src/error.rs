use std::io;
use std::path::{Path, PathBuf};

use artifact::printable;

use crate::format::signs;

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
    #[error("{reason}")]
    Place {
        /// What stands where, and what was expected.
        reason: String,
    },
    /// A file isn't of its form.
    #[error("{}: {}", shown(path), printable(reason))]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong, with its place, and what to do.
        reason: String,
    },
    /// Something about one frame.
    #[error("{}: frame {index} ({}): {}", shown(path), printable(file), printable(reason))]
    Frame {
        /// The file that lists the frames.
        path: PathBuf,
        /// The frame, counted from 0.
        index: usize,
        /// What that file calls it.
        file: String,
        /// What is wrong and what to do.
        reason: String,
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
    pub(crate) fn format(path: &Path, reason: impl Into<String>) -> Self {
        Self::Format { path: path.to_path_buf(), reason: reason.into() }
    }

    pub(crate) fn frame(path: &Path, index: usize, file: &str, reason: String) -> Self {
        Self::Frame { path: path.to_path_buf(), index, file: file.to_owned(), reason }
    }
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

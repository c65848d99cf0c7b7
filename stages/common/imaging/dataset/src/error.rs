use std::path::Path;

use artifact::{format_count, one_line, printable, shortened};

use crate::file_status::path_text;

/// Error returned when a data set can't be read; its message names the file and the remedy.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder contains neither a data set nor a sign of one.
    #[error("{0}")]
    Unrecognised(String),
    /// The folder has a data set that is invalid, or something else instead of a data set.
    #[error("{0}")]
    Invalid(String),
}

impl From<anyhow::Error> for DatasetError {
    fn from(error: anyhow::Error) -> Self {
        error.downcast().unwrap_or_else(|error| Self::Invalid(one_line(&error)))
    }
}

/// Names the frame `index`, counted from 0, of a list; `file` is the frame's name in that list.
pub(crate) fn frame_label(list: &Path, index: usize, file: &str) -> String {
    format!("{}: frame {index} ({})", path_text(list), printable(&shortened(file)))
}

/// Returns the error of a list none of whose images exists. `folder` is the folder in which all
/// were expected, if there is a single one.
pub(crate) fn images_missing(count: usize, folder: Option<&Path>, first: &str) -> anyhow::Error {
    let folder = folder.map(|folder| format!(" in {}", path_text(folder))).unwrap_or_default();
    let first = shortened(first);
    let images = format_count(count, "image");
    anyhow::anyhow!("{images} listed, none found{folder} (first missing: {first})")
}

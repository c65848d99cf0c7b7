use std::path::PathBuf;

/// An image that can't be read or written.
#[derive(Debug, thiserror::Error)]
pub enum PixelError {
    /// The file is not there, or reading or writing failed.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is no image of the kind, is cut short or damaged.
    #[error("{path}: {reason}; export the image again")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The file is an image of a format that isn't read.
    #[error("{path} is a {format} image, which is not read; convert: {command}")]
    Unread {
        /// The file.
        path: PathBuf,
        /// Name of the format.
        format: &'static str,
        /// Shell command that converts the file.
        command: String,
    },
    /// An image that is larger than any that is read.
    #[error(
        "{path}: {width}×{height} pixels; at most {MAX_PIXELS} are read (16384×16384, for \
        example): make the image smaller"
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// A sample that isn't finite was about to be written.
    #[error("{path}: channel {channel} holds {value} at pixel ({x}, {y}); nothing was written")]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The channel.
        channel: String,
        /// Column.
        x: usize,
        /// Row.
        y: usize,
        /// The sample.
        value: f32,
    },
    /// A file has a sample that isn't finite.
    #[error(
        "{path}: channel {channel} is {value} at column {x}, row {y}; such a pixel has no colour \
        or depth: export the image again without it"
    )]
    NotFiniteInput {
        /// The file.
        path: PathBuf,
        /// The channel.
        channel: String,
        /// Column.
        x: usize,
        /// Row.
        y: usize,
        /// The sample.
        value: f32,
    },
}

/// More pixels than any image has; a header that says so is damaged or hostile.
pub const MAX_PIXELS: usize = 1 << 28;

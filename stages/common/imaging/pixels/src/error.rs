use std::path::{Path, PathBuf};

/// Error returned when an image can't be read or written.
#[derive(Debug, thiserror::Error)]
pub enum PixelError {
    /// The operating system reported an error.
    #[error("{path}: {source}")]
    Io {
        /// Path of the image.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file is not an image of the expected format, or is truncated or damaged.
    #[error("{path}: {reason}; export the image again")]
    Format {
        /// Path of the image.
        path: PathBuf,
        /// Reason, as a sentence fragment.
        reason: String,
    },
    /// The image format is not supported.
    #[error("{path} is a {format} image, which is not supported; convert: {command}")]
    Unsupported {
        /// Path of the image.
        path: PathBuf,
        /// Name of the format.
        format: &'static str,
        /// Shell command that converts the file.
        command: String,
    },
    /// The image has more than [`MAX_PIXELS`] pixels.
    #[error(
        "{path}: {width}×{height} pixels exceed the limit of {MAX_PIXELS} (such as 16384×16384); \
        make the image smaller"
    )]
    TooLarge {
        /// Path of the image.
        path: PathBuf,
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// A sample to write is NaN or infinite.
    #[error(
        "{path}: channel {channel} is {value} at column {x}, row {y}; the file was not written"
    )]
    NotFinite {
        /// Path of the image.
        path: PathBuf,
        /// Name of the channel.
        channel: String,
        /// Column of the pixel.
        x: usize,
        /// Row of the pixel.
        y: usize,
        /// Value of the sample.
        value: f32,
    },
    /// A sample of a file is NaN or infinite.
    #[error(
        "{path}: channel {channel} is {value} at column {x}, row {y}; export the image again with \
        finite samples"
    )]
    NotFiniteInput {
        /// Path of the image.
        path: PathBuf,
        /// Name of the channel.
        channel: String,
        /// Column of the pixel.
        x: usize,
        /// Row of the pixel.
        y: usize,
        /// Value of the sample.
        value: f32,
    },
}

impl PixelError {
    /// Returns a conversion of an error of the operating system.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { path: path.to_path_buf(), source }
    }

    /// Creates the error of a file in another or a damaged format.
    pub fn format(path: &Path, reason: impl Into<String>) -> Self {
        Self::Format { path: path.to_path_buf(), reason: reason.into() }
    }
}

/// Maximum number of pixels of an image: a header that claims more is damaged or hostile.
pub const MAX_PIXELS: usize = 1 << 28;

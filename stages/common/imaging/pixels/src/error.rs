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
    /// The image format is not supported, the image has more than [`MAX_PIXELS`] pixels, or a
    /// sample is NaN or infinite.
    #[error("{0}")]
    Unsupported(String),
}

impl PixelError {
    /// Returns a function that adds the path to an error of the operating system.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { path: path.to_path_buf(), source }
    }

    /// Fails if an image has more than [`MAX_PIXELS`] pixels.
    pub fn check_size(path: &Path, (width, height): (usize, usize)) -> Result<(), Self> {
        if width.saturating_mul(height) <= MAX_PIXELS {
            return Ok(());
        }
        Err(Self::Unsupported(format!(
            "{}: {width}×{height} pixels exceed the limit of {MAX_PIXELS} (such as 16384×16384); \
            make the image smaller",
            path.display()
        )))
    }

    /// Creates the error of a file that is damaged or has another format.
    pub fn format(path: &Path, reason: impl Into<String>) -> Self {
        Self::Format { path: path.to_path_buf(), reason: reason.into() }
    }
}

/// Maximum number of pixels of an image, chosen by hand. A header with more is usually damaged or
/// hostile.
pub const MAX_PIXELS: usize = 1 << 28;

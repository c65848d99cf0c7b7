use artifact::{Failure, format_number};
use dataset::Frame;

use crate::bounds::SpaceError;
use crate::sizes::{SizeError, Sizes};

/// Returns `frame NAME`, the prefix of messages about a frame.
pub(crate) fn frame_label(frame: &Frame) -> String {
    format!("frame {}", frame.name)
}

/// Error returned when parameters don't suit the data set; converts into [`Failure::Usage`].
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(crate) enum ParameterError {
    #[error("parameter split: the data set has no split of its own; choose holdout or paper")]
    NoSplit,
    #[error("parameter kernel: photographs cannot have kernel average; choose box")]
    AssumedAverage,
    /// Kernel `average` with a fractional scale: it averages whole pixels only.
    #[error(
        "parameter kernel: average requires an integer scale, found {:?} → {:?}; choose box",
        .0.hr, .0.lr
    )]
    FractionalAverage(Sizes),
    #[error("parameters: {0}")]
    Sizes(SizeError),
    #[error(transparent)]
    Space(#[from] SpaceError),
    #[error(
        "parameter {name}: {} is not a valid distance; choose at most 1e18",
        format_number(*value)
    )]
    InvalidDistance { name: &'static str, value: f64 },
    #[error(
        "parameter near: {} is not less than far = {}",
        format_number(*near), format_number(*far)
    )]
    NearAndFar { near: f64, far: f64 },
}

impl From<ParameterError> for Failure {
    fn from(error: ParameterError) -> Self {
        Self::Usage(error.to_string())
    }
}

/// Error returned when all training views have equal poses.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "all {views} training views have the same pose: depth cannot be estimated; check the poses"
)]
pub(crate) struct SamePose {
    /// Number of training views.
    pub(crate) views: usize,
}

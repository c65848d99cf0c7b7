use artifact::{Failure, number};

use crate::bounds::SpaceError;
use crate::sizes::{SizeError, Sizes};

/// Parameters that a data set can't have. Functions fail with a [`Failure`] made of it, which has
/// the exit code.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(crate) enum ParameterError {
    #[error(
        "parameter split: the data set doesn't say which views are for testing; choose holdout or \
        paper"
    )]
    NoSplit,
    #[error(
        "parameter lr_width: with lr_source photographs their own width is the LR width; leave \
        lr_width out"
    )]
    WidthOfPhotographs,
    #[error("parameter kernel: average makes LR images and can't be assumed; choose box")]
    AssumedAverage,
    /// The kernel takes the mean of whole pixels.
    #[error(
        "parameter kernel: average needs a whole scale, not {:?} → {:?}; choose box",
        .0.hr, .0.lr
    )]
    UnevenAverage(Sizes),
    #[error("parameters: {0}")]
    Sizes(SizeError),
    #[error(transparent)]
    Space(#[from] SpaceError),
    #[error("parameter {name}: {} is not a distance", number(*value))]
    NoDistance { name: &'static str, value: f64 },
    #[error("parameter near: {} is not before far = {}", number(*near), number(*far))]
    NearAndFar { near: f64, far: f64 },
}

impl From<ParameterError> for Failure {
    fn from(error: ParameterError) -> Self {
        Self::Usage(error.to_string())
    }
}

/// Training views that were all taken by the same camera at the same place.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "all {views} training views have the same pose: nothing tells how far anything is; are the \
    poses right?"
)]
pub(crate) struct SamePose {
    /// How many there are.
    pub(crate) views: usize,
}

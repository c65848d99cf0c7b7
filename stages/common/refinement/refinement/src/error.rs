use std::fmt::Display;

/// Error of a refiner that can't be read, written, applied or trained.
#[derive(Debug, thiserror::Error)]
pub enum RefinementError {
    /// A libtorch operation failed.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// A weights file can't be used.
    #[error(transparent)]
    Weights(#[from] nets::WeightsError),
    /// A network, a view or the size of patches can't be used.
    #[error("{0}")]
    Unusable(String),
    /// A step's loss or gradient isn't finite.
    #[error("step {step}: loss or gradient is not finite; lower the learning rate")]
    NotFinite {
        /// Index of the step.
        step: u64,
    },
}

impl RefinementError {
    /// Returns the error for a view that can't be used.
    pub(crate) fn view(name: &str, reason: impl Display) -> Self {
        Self::Unusable(format!("view {name}: {reason}"))
    }
}

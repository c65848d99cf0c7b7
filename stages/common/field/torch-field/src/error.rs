use std::path::PathBuf;

/// Error of a libtorch field that can't be read, written, rendered or trained.
#[derive(Debug, thiserror::Error)]
pub enum TorchFieldError {
    /// A libtorch operation failed.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// A weights file can't be used.
    #[error(transparent)]
    Weights(#[from] nets::WeightsError),
    /// The file isn't a field.
    #[error("{path}: {reason}")]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Reason, as a sentence fragment.
        reason: String,
    },
    /// The gradient wasn't finite in two of 100 steps.
    #[error(
        "step {step}: the gradient is not finite, for the second time within 100 steps; lower the \
        learning rate"
    )]
    NotFinite {
        /// Index of the step.
        step: u64,
    },
    /// A network's output no longer depends on the ray, so it gets no useful gradient.
    #[error("step {step}: the {network} network has collapsed: {reason}; try another seed")]
    Collapsed {
        /// Index of the step.
        step: u64,
        /// Name of the network: `coarse` or `fine`.
        network: &'static str,
        /// Kind of collapse.
        reason: &'static str,
    },
}

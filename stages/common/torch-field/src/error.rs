use std::path::PathBuf;

/// A field that can't be read, written, rendered or trained.
#[derive(Debug, thiserror::Error)]
pub enum TorchFieldError {
    /// libtorch refused.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// A file of weights can't be used.
    #[error(transparent)]
    Weights(#[from] nets::WeightsError),
    /// The file isn't a field.
    #[error("{path}: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Numbers went wrong twice within a hundred steps.
    #[error(
        "step {step}: the gradient is not finite, for the second time within 100 steps; lower the \
        rate"
    )]
    NotFinite {
        /// The step.
        step: u64,
    },
    /// A network sees the same whatever the ray, and can't learn any more.
    #[error("step {step}: the {network} network has collapsed: {why}; try another seed")]
    Collapsed {
        /// The step.
        step: u64,
        /// Which network.
        network: &'static str,
        /// What it sees instead.
        why: &'static str,
    },
}

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
    /// The gradient wasn't finite in two of 100 steps, or a network's output no longer depends on
    /// the ray.
    #[error("step {step}: {problem}")]
    Diverged {
        /// Index of the step.
        step: u64,
        /// Problem and remedy.
        problem: String,
    },
}

impl TorchFieldError {
    /// Returns the error of a second step within 100 whose gradient isn't finite.
    pub(crate) fn not_finite(step: u64) -> Self {
        let problem = "the gradient is not finite, for the second time within 100 steps; lower the \
            learning rate";
        Self::Diverged { step, problem: problem.to_owned() }
    }
}

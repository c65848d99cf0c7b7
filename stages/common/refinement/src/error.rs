/// A refiner that can't be read, written, used or trained.
#[derive(Debug, thiserror::Error)]
pub enum RefinementError {
    /// libtorch refused.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// A file of weights can't be used.
    #[error(transparent)]
    Weights(#[from] nets::WeightsError),
    /// A network that can't be.
    #[error("a network {channels} wide with {blocks} blocks: not one of ours")]
    Architecture {
        /// Its width.
        channels: u32,
        /// Its blocks.
        blocks: u32,
    },
    /// A view can't be used.
    #[error("view {name}: {reason}")]
    View {
        /// Which.
        name: String,
        /// What is wrong.
        reason: String,
    },
    /// A view isn't one.
    #[error("a view of {channels} channels where {expected} are expected")]
    Channels {
        /// How many it has.
        channels: usize,
        /// How many the network takes.
        expected: usize,
    },
    /// Numbers went wrong.
    #[error("step {step}: the gradient is not finite; lower the rate")]
    NotFinite {
        /// The step.
        step: u64,
    },
}

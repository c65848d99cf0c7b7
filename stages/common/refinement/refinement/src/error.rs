/// Error of a refiner that can't be read, written, applied or trained.
#[derive(Debug, thiserror::Error)]
pub enum RefinementError {
    /// A libtorch operation failed.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// A weights file can't be used.
    #[error(transparent)]
    Weights(#[from] nets::WeightsError),
    /// The network's size is out of range.
    #[error("unsupported network: {channels} channels, {blocks} blocks")]
    Architecture {
        /// Number of channels.
        channels: u32,
        /// Number of residual blocks.
        blocks: u32,
    },
    /// A view can't be used.
    #[error("view {name}: {reason}")]
    View {
        /// Name of the view.
        name: String,
        /// Reason, as a sentence fragment.
        reason: String,
    },
    /// The network can't divide patches of this size.
    #[error("a patch size of {size} pixels is not a multiple of {multiple}")]
    PatchSize {
        /// Side of a patch in pixels.
        size: usize,
        /// Number that must divide the side.
        multiple: usize,
    },
    /// A view has the wrong number of channels.
    #[error("expected a view of {expected} channels, found {channels}")]
    Channels {
        /// Number of channels of the view.
        channels: usize,
        /// Number of channels that the network takes.
        expected: usize,
    },
    /// A step's loss or gradient isn't finite.
    #[error("step {step}: the gradient is not finite; lower the learning rate")]
    NotFinite {
        /// Index of the step.
        step: u64,
    },
}

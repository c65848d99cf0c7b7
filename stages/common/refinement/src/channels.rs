/// Channels of a rendered view: colour and opacity.
pub(crate) const INPUTS: usize = 4;
/// The same with the difference to references, their confidence, and what their own views lack.
pub(crate) const REFERENCE_INPUTS: usize = 11;
/// Channels of an image.
pub(crate) const OUTPUTS: usize = 3;

/// Whether rays take a sample at every step, or one of double length at every other step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Strides {
    /// At every step: to render.
    Even,
    /// At every other step in thin cells: to train, where samples of other rays lie in between.
    ByCell,
    /// At every other step: to begin a training, while density is smooth and little is known.
    Double,
}

impl Strides {
    /// Whether samples in a thin cell, or in a dense one, stand for two steps.
    pub(crate) fn are_double_in(self, thin: bool) -> bool {
        match self {
            Self::Even => false,
            Self::ByCell => thin,
            Self::Double => true,
        }
    }
}

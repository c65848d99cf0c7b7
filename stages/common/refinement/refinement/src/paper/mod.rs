//! The paper's own refinement network: 30 million weights that redraw a patch of a rendered view,
//! given patches of HR references of the same surface.
//!
//! The network is here for comparison. It is trained for one scene, on the rendered view of a
//! reference and the reference itself, both warped by random perspectives: as published, 46,875
//! steps of 32 patches. Each step takes a minute or two on two cores.
//!
//! * [`PaperRefiner`]: the network (Choi et al. 2019's maximum over references, batch
//!   normalisation, tanh). [`PaperRefiner::refine`] redraws a view in overlapping patches and
//!   blends them; depth gives the positions of the reference patches.
//! * [`PaperTrainer`], [`PaperTrainingOptions`]: training with L1 and, if VGG-19's weights are
//!   given, [`PerceptualLoss`].
//!
//! Colours are display-encoded sRGB composited on the background, 0..1 outside and -1..1 inside.
//! Faults of the authors' code are not repeated: that code takes reference patches from one column
//! of eight pixels, doesn't test for occlusion, drops a remainder of patches, and overlaps patches
//! without blending (design note 024).
//!
//! ```
//! use refinement::paper::PaperRefiner;
//! let published = PaperRefiner::new(128, 0)?;
//! assert_eq!(published.parameter_count(), 30_253_187);
//! # Ok::<(), refinement::RefinementError>(())
//! ```

#[cfg(test)]
mod goldens;
mod loss;
mod network;
mod patches;
mod perspective;
mod trainer;

pub use loss::PerceptualLoss;
pub use network::PaperRefiner;
pub use trainer::{PaperTrainer, PaperTrainingOptions};

//! The paper's own refinement network: 30 million weights that redraw a patch of a rendered view,
//! given patches of HR references of the same surface.
//!
//! The network is here for comparison. It is trained for one scene, on rendered views and their
//! ground truth, both warped by random perspectives: as published, 46,875 steps of 32 patches. Each
//! step takes a minute or two on two cores.
//!
//! * [`PaperRefiner`]: the network (maximum over references as in Choi et al. 2019, "Extreme
//!   View Synthesis"; batch normalisation, tanh). [`PaperRefiner::refine`] redraws a view in
//!   overlapping patches and blends them; depth gives the positions of the reference patches.
//! * [`PaperTrainer`]: training with L1 and, if VGG-19's weights are given, [`PerceptualLoss`].
//!
//! Colours are display-encoded sRGB composited on the background, 0..1 outside and -1..1 inside.
//! Faults of the authors' code are not repeated: that code takes reference patches from the first
//! eight pixels of one column, and doesn't test for occlusion (design note 024).
//!
//! ```
//! use refinement::paper::PaperRefiner;
//! let (width, seed) = (128, 0);
//! let published = PaperRefiner::new(width, seed)?;
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
pub use trainer::PaperTrainer;

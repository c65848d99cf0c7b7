//! The paper's own refinement: a network of 30 million weights that redraws a patch of a rendered
//! view, given patches of HR references that show the same.
//!
//! It is here to be compared with. A training is for one scene, on the rendered view of a reference
//! beside the reference itself, both warped by random perspectives; 46,875 steps of 32 patches are
//! published, each of which takes a minute or two on two cores.
//!
//! * [`PaperRefiner`]: the network (Choi et al. 2019's maximum over references, batch
//!   normalisation, tanh). [`PaperRefiner::refine`] goes through a view by patches that overlap and
//!   are blended, with reference patches where geometry says that they show the same.
//! * [`PaperTrainer`], [`PaperTraining`]: its training: L1 and, where VGG-19's weights are given,
//!   [`PerceptualLoss`].
//!
//! Colours are display-encoded sRGB on the background that is shown, 0..1 outside and -1..1 inside.
//! The reference's code takes its patches from one column of eight pixels, doesn't test whether
//! anything stands between, drops a remainder of patches and lets them overlap without blending;
//! none of that is repeated.
//!
//! ```
//! use paper_refiner::PaperRefiner;
//! let published = PaperRefiner::new(128, 0)?;
//! assert_eq!(published.weights(), 30_253_187);
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
pub use patches::OVERLAP;
pub use trainer::{PaperTrainer, PaperTraining};

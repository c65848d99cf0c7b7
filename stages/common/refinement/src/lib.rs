//! Refinement of rendered views: a small network that gives them the detail they systematically
//! lack.
//!
//! A field that was trained from LR images renders edges softer than they are, and the same way
//! everywhere in a scene. The network sees a rendered view and predicts what to add. It learns that
//! one size down, where the truth is known: a field trained from LR images that were shrunk once
//! more renders views of LR size, whose truth the LR images are.
//!
//! Where true images of some views are known at HR, references, a reference-based network sees what
//! they show of each pixel, too. The field's depth says where they show it, and whether they see it
//! at all.
//!
//! * [`Rendered`]: a view as a field rendered it; [`KnownView`]: the same with its true image, an
//!   example or a reference.
//! * [`Refiner`]: the network; [`Refiner::refine`] refines a view, tile by tile.
//! * [`with_references`]: a view as a reference-based network takes it; [`Guidance`] says how
//!   references are looked at.
//! * [`LrObservations`]: LR images that views are made consistent with (data consistency).
//! * [`RefinerTrainer`], [`RefinerTraining`]: learning from examples, a [`Training`].
//! * [`RefinerFile`]: what a folder with a refiner says of it.
//!
//! Colours are display-encoded sRGB, composited on the background that is shown.
//!
//! Convolutions go through libtorch, each tile and each shard of a step in one thread; gradients
//! are added in order, so bytes don't depend on the number of threads.
//!
//! ```
//! use pixels::Image;
//! use refinement::{Refiner, RefinerArchitecture};
//! nets::deterministic();
//! let refiner = Refiner::new(RefinerArchitecture { channels: 8, blocks: 1, guidance: None }, 7)?;
//! let view = Image::new(9, 5, 4, vec![0.5; 9 * 5 * 4]);
//! // A network that hasn't learnt anything adds nothing.
//! assert_eq!(refiner.refine(&view)?.data, vec![0.5; 9 * 5 * 3]);
//! # Ok::<(), refinement::RefinementError>(())
//! ```

mod align;
mod channels;
mod consistency;
mod error;
mod folded;
mod guidance;
mod refiner;
mod sums;
mod trainer;
mod view;
mod warped_pixel;
mod warped_reference;

pub use consistency::LrObservations;
pub use error::RefinementError;
pub use guidance::Guidance;
pub use refiner::{Network, REFINER_FILE, Refiner, RefinerArchitecture, RefinerFile, WEIGHTS_FILE};
pub use trainer::{RefinerScores, RefinerTrainer, RefinerTraining, Training};
pub use view::{KnownView, Rendered};
pub use warped_reference::{ConditionedView, Use, with_references};

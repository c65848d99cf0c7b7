//! Refinement of rendered views: a small network that adds the detail that they systematically
//! lack.
//!
//! A field trained on LR images renders edges too soft, and in the same way everywhere in a scene.
//! The network takes a rendered view and predicts the residual. The network is trained
//! at a smaller size, at which ground truth exists: a second field, trained on LR images that are
//! downscaled once more, renders views of LR size, whose ground truth is the LR images.
//!
//! If HR images of some views are known (references), a reference-based network also takes the
//! references' colours at each pixel's surface point. The field's depth gives the point's position
//! in a reference, and whether it is visible there.
//!
//! * [`Rendered`]: a view rendered from a field; [`KnownView`]: a rendered view with its ground
//!   truth; serves as an example or as a reference.
//! * [`Refiner`]: the network; [`Refiner::refine`] refines a view, tile by tile.
//! * [`with_references`]: adds reference features to a view; [`WarpOptions`] has the options.
//! * [`LrObservations`]: LR photographs that views are made consistent with (data consistency).
//! * [`RefinerTrainer`]: a [`Training`] on examples; [`TrainingOptions`] has its options.
//! * [`RefinerFile`]: description of a refiner in its artifact.
//! * [`paper`]: the paper's own network, for comparison.
//!
//! Colours are display-encoded sRGB, composited on the background.
//!
//! Convolutions use Winograd's algorithm in SIMD code of sixteen lanes. Gradients of shards are
//! added in order, so bytes don't depend on the number of threads.
//!
//! ```
//! use pixels::Image;
//! use refinement::{Refiner, RefinerArchitecture};
//! nets::deterministic();
//! let refiner = Refiner::new(RefinerArchitecture { channels: 8, blocks: 1, guidance: None }, 7);
//! let view = Image::new(9, 5, 4, vec![0.5; 9 * 5 * 4]);
//! // An untrained network adds nothing.
//! assert_eq!(refiner.refine(&view)?.data, vec![0.5; 9 * 5 * 3]);
//! # Ok::<(), refinement::RefinementError>(())
//! ```

mod adam;
mod consistency;
mod convolution;
mod error;
mod folded;
mod network;
pub mod paper;
mod refiner;
mod sums;
mod trainer;
mod view;
mod warped_pixel;
mod warped_reference;

pub use consistency::LrObservations;
pub use error::RefinementError;
pub use refiner::{Network, REFINER_FILE, Refiner, RefinerArchitecture, RefinerFile, WEIGHTS_FILE};
pub use trainer::{RefinerTrainer, Training, TrainingOptions};
pub use view::{KnownView, Rendered};
pub use warped_reference::{ConditionedView, ReferenceStatistics, WarpOptions, with_references};

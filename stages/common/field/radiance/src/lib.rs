//! The fast radiance field: a multi-resolution grid with small MLPs, written for the CPU. No
//! autograd, no torch.
//!
//! * [`RayField`]: trait of fields that render rays.
//! * [`TrainingLog`]: record of a training, stored as a file in a field artifact.
//! * [`Field`]: parameters and occupancy grid; [`Field::render`] returns colour, opacity and depth
//!   of rays.
//! * [`Trainer`]: fused forward and backward passes and lazy Adam, driven by a [`Supervisor`] that
//!   casts rays and computes the loss of their colours.
//! * [`TrainingState`], [`Occupancy`], [`NormalizedRay`]: training progress, occupied cells and
//!   rays in the unit cube, shared with the hash grid of `torch-field`.
//! * [`regularisers`]: losses on a ray other than its colour error.
//! * [`spec`]: constants shared with the hash grid of `torch-field`.
//! * [`Passes`]: one forward and backward pass without an optimiser, for benchmarks.
//! * [`PointField`]: trait of fields that are evaluated at points, for baking.
//! * [`Architecture`]: sizes of a field; [`scene::Bounds`]: its position in the world.
//!
//! Shading is deferred (SNeRG, Hedman et al. 2021): a sample has a density, a raw colour and view
//! features. A ray composites its samples' view features. From the composited features and the
//! ray's direction, the view network computes a raw colour. This colour is added to the raw colour
//! of each of the ray's samples.
//!
//! A step's rays are cut into shards by index. A shard's samples go through encoding, density,
//! compositing, shading and back in chunks that fit the cache. Gradients of the samples'
//! features are stored until the step's end; then two tasks per level, for even and odd z, add them
//! to the grid's gradients. All sums have a fixed order, so results have equal bits at any thread
//! count. Kernels work on 16 logical lanes on any machine and fuse all multiply-adds, so AVX-512,
//! AVX2 and portable code give equal bits, too.
//!
//! Units: rays and depths are in scene units; positions inside the field are in the unit cube.
//! Colours are display-encoded sRGB.
//!
//! ```
//! use radiance::{Architecture, Field, Ray};
//! let bounds = scene::Bounds::cube(1.0, 2.0, 6.0);
//! let field = Field::new(Architecture::default(), bounds, 7);
//! let ray = Ray { origin: [0.0, 0.0, 4.0], direction: [0.0, 0.0, -1.0], background: [1.0; 3] };
//! let pixel = field.render(&[ray])[0];
//! assert!(pixel.opacity > 0.0 && pixel.depth > 2.0 && pixel.depth < 6.0);
//! ```

mod adam;
mod aligned;
mod architecture;
mod chunk;
mod composite;
mod field;
mod grid;
mod march;
mod math;
mod mlp;
mod occupancy;
mod passes;
mod points;
mod ray;
#[cfg(test)]
mod reference;
pub mod regularisers;
mod render;
mod samples;
mod shading;
pub mod spec;
mod specks;
#[cfg(test)]
mod stability_tests;
mod tensors;
mod trainer;
mod training_log;
mod training_state;

pub use architecture::{Architecture, CELLS_PER_PIXEL, DescriptionError, GivenSizes, check_ranges};
pub use field::Field;
pub use math::spherical_harmonics;
pub use occupancy::{CellHit, Occupancy};
pub use passes::Passes;
pub use points::{PointField, PointSamples};
pub use ray::{MAX_SPEED, NormalizedRay, Ray, RayMap, clip};
pub use regularisers::Regularisers;
pub use render::{Pixel, RayField, RenderError};
pub use spec::Strides;
pub use tensors::FieldError;
pub use trainer::{
    NETWORK_DECAY, Phase, PhaseClock, PhaseTimes, RenderedBundles, Step, StepReport, Supervisor,
    Trainer, TrainingError, TrainingOptions,
};
pub use training_log::{CurvePoint, TRAINING_FILE, TrainingLog};
pub use training_state::TrainingState;

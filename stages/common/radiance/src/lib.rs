//! The fast radiance field: a multi-resolution grid with small MLPs, written for the CPU. No
//! autograd, no torch.
//!
//! * [`RayField`]: whatever rays can be cast through; [`FieldFile`] says what an artifact holds.
//! * [`Field`]: parameters and occupancy; [`Field::render`] gives colour, opacity and depth of
//!   rays.
//! * [`Trainer`]: fused forward and backward passes and lazy Adam, driven by a [`Supervisor`] that
//!   casts rays and judges colours.
//! * [`Tally`], [`Occupancy`], [`NormalizedRay`]: what a training of the same field elsewhere
//!   (`torch-field`) shares: how far it has come, where there may be something, how rays run
//!   through the unit cube.
//! * [`regularisers`]: what a training asks of rays beside their colours.
//! * [`spec`]: the constants that the libtorch twin shares.
//! * [`Passes`]: one forward and backward pass alone, for benchmarks.
//! * [`PointSample`]: what a field holds at a place, for whoever bakes it into something else.
//! * [`Architecture`]: what a field is made of; [`scene::Bounds`]: where it lies.
//!
//! Shading is deferred (SNeRG, Hedman et al. 2021): a sample has a density, a raw colour and view
//! features. A ray composites its samples' view features, and the view network makes of them and
//! the direction a raw colour that is added to those of all its samples.
//!
//! Layout of the work: rays are cut into shards by index; a shard's samples go through encoding,
//! density, compositing, shading and back in chunks that stay in the cache; gradients of the grid
//! are kept and added level by level, in sample order. So sums have one order, and results are
//! equal bits at any thread count. Kernels work on 16 logical lanes whatever the machine has, and
//! multiply-adds are fused everywhere, so AVX-512, AVX2 and portable code give equal bits, too.
//!
//! Units: rays and depths are in scene units; inside, the scene's box is scaled to the unit cube.
//! Colours are display-encoded sRGB.
//!
//! ```
//! use radiance::{Architecture, Field, Ray};
//! let bounds = scene::Bounds {
//!     min: [-1.0; 3],
//!     max: [1.0; 3],
//!     near: 2.0,
//!     far: 6.0,
//!     ..Default::default()
//! };
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
mod field_file;
mod grid;
mod march;
mod math;
mod mlp;
mod occupancy;
mod passes;
mod points;
mod ranges;
mod ray;
#[cfg(test)]
mod reference;
pub mod regularisers;
mod render;
mod samples;
mod shading;
mod simd;
pub mod spec;
mod specks;
mod spherical;
mod strides;
mod supervisor;
mod tally;
mod tensors;
mod trainer;

pub use architecture::Architecture;
pub use field::Field;
pub use field_file::{
    FIELD_FILE, FIELD_FORMAT, FieldFile, FieldFileError, FieldModel, MlpArchitecture,
};
pub use occupancy::{Met, Occupancy};
pub use passes::Passes;
pub use points::PointSample;
pub use ranges::OutOfRange;
pub use ray::{NormalizedRay, Ray, RayMap, clip};
pub use regularisers::Regularisers;
pub use render::{Pixel, RayField, RenderError};
pub use simd::{Family, set_family};
pub use spherical::spherical_harmonics;
pub use strides::Strides;
pub use supervisor::Supervisor;
pub use tally::Tally;
pub use tensors::{FieldError, FieldProblem};
pub use trainer::{StepReport, Trainer, TrainingError, TrainingOptions};

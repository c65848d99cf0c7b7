//! Number of rays and peak memory of stages: rules that a stage follows and that the runner
//! estimates a run with, before the stage's inputs exist.
//!
//! * [`RayBudget`]: rays of a training, from the LR pixels.
//! * [`TrainingMemory`], [`preparation_bytes`], [`export_bytes`]: peak memory.

mod export;
mod preparation;
mod rays;
mod training;

pub use export::{SURFACE_PIXEL_BYTES, SURFEL_SAMPLE_BYTES, export_bytes, export_scale};
pub use preparation::preparation_bytes;
pub use rays::RayBudget;
pub use training::{ImageSize, PixelStorage, TrainingMemory, grid_training_bytes, program_bytes};

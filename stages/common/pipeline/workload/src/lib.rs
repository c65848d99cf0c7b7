//! Number of rays and peak memory of stages: rules that a stage follows and that the runner
//! estimates a run with, before the stage's inputs exist.
//!
//! * [`RayBudget`]: rays of a training, from the LR pixels.
//! * [`TrainingMemory`], [`preparation_bytes`], [`ExportViews`]: peak memory.

mod export;
mod preparation;
mod rays;
mod training;

pub use export::{ExportViews, SURFACE_PIXEL_BYTES, SURFEL_SAMPLE_BYTES};
pub use preparation::preparation_bytes;
pub use rays::RayBudget;
pub use training::{ImageSize, PixelStorage, TrainingMemory, grid_training_bytes, program_bytes};

//! Radiance fields in libtorch, with autograd, on the CPU or on CUDA.
//!
//! * [`Mlp`]: NeRF-SR's own field as published (Wang et al. 2022; Mildenhall et al. 2020):
//!   positional encoding, a coarse and a fine network of eight layers, stratified and importance
//!   sampling. [`Mlp::render`] returns colour, opacity and depth of rays.
//! * [`MlpPoints`]: the paper's field at points, for baking.
//! * [`MlpArchitecture`]: sizes of the paper's field; the only item without feature `torch`.
//! * [`MlpTrainer`], [`MlpTraining`]: training of the paper's field, driven by the same
//!   [`radiance::Supervisor`] as the hash-grid field's.
//! * [`TorchGrid`], [`GridTrainer`]: the hash-grid field of `radiance` and its training, on the
//!   same parameters: a check of the hand-written engine, and its way to CUDA.
//!
//! On the CPU a batch is cut into shards by index. Each shard runs in one thread, and gradients are
//! added in order, so bytes don't depend on the number of threads. On CUDA results agree to a
//! tolerance.
//!
//! Units: positions and distances are scene units, directions have unit length, colours are
//! display-encoded sRGB.
//!
//! ```no_run
//! use radiance::Ray;
//! use torch_field::{Mlp, MlpArchitecture};
//! let bounds = scene::Bounds::cube(1.0, 2.0, 6.0);
//! let field = Mlp::new(MlpArchitecture::default(), bounds, 7, nets::device("cpu")?)?;
//! let ray = Ray { origin: [0.0, 0.0, 4.0], direction: [0.0, 0.0, -1.0], background: [1.0; 3] };
//! let pixel = field.render(&[ray])?[0];
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod architecture;
#[cfg(feature = "torch")]
mod composite;
#[cfg(feature = "torch")]
mod error;
#[cfg(all(test, feature = "torch"))]
mod goldens;
#[cfg(feature = "torch")]
mod grid;
#[cfg(feature = "torch")]
mod grid_trainer;
#[cfg(feature = "torch")]
mod mlp;
#[cfg(feature = "torch")]
mod mlp_points;
#[cfg(feature = "torch")]
mod mlp_trainer;
#[cfg(feature = "torch")]
mod network;
#[cfg(feature = "torch")]
mod ray_tensors;
#[cfg(feature = "torch")]
mod regularisers;
#[cfg(feature = "torch")]
mod sampling;
#[cfg(feature = "torch")]
mod step;

pub use architecture::MlpArchitecture;
#[cfg(feature = "torch")]
pub use {
    error::TorchFieldError, grid::TorchGrid, grid_trainer::GridTrainer, mlp::Mlp,
    mlp_points::MlpPoints, mlp_trainer::MlpTrainer, mlp_trainer::MlpTraining,
};

//! Radiance fields through libtorch's operations and autograd, on the CPU or on CUDA.
//!
//! * [`Mlp`]: NeRF-SR's own field as published (Wang et al. 2022; Mildenhall et al. 2020):
//!   positional encoding, a coarse and a fine network of eight layers, stratified and importance
//!   sampling. [`Mlp::render`] gives colour, opacity and depth of rays.
//! * [`MlpTrainer`], [`MlpTraining`], [`Schedule`]: its training, driven by the same
//!   [`radiance::Supervisor`] as the fast field's.
//!
//! * [`TorchGrid`], [`GridTrainer`]: the fast field of `radiance` and its training, on the same
//!   numbers: their judge, and their way to CUDA.
//!
//! On the CPU a batch is cut into shards by index, each of which goes through libtorch in one
//! thread, and their gradients are added in order: bytes don't depend on the number of threads. On
//! CUDA results hold to a tolerance.
//!
//! Units: positions and distances are scene units, directions have unit length, colours are
//! display-encoded sRGB.
//!
//! ```no_run
//! use radiance::{MlpArchitecture, Ray};
//! let bounds = scene::Bounds {
//!     min: [-1.0; 3],
//!     max: [1.0; 3],
//!     near: 2.0,
//!     far: 6.0,
//!     ..Default::default()
//! };
//! let field = torch_field::Mlp::new(MlpArchitecture::default(), bounds, 7, nets::device("cpu")?)?;
//! let ray = Ray { origin: [0.0, 0.0, 4.0], direction: [0.0, 0.0, -1.0], background: [1.0; 3] };
//! let pixel = field.render(&[ray])?[0];
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod composite;
mod encoding;
#[cfg(test)]
mod goldens;
mod grid;
mod grid_trainer;
mod mlp;
mod mlp_trainer;
mod network;
mod ray_maps;
mod regularisers;
mod sampling;
mod schedule;
mod step;
mod transfer;

use std::path::PathBuf;

pub use grid::TorchGrid;
pub use grid_trainer::GridTrainer;
pub use mlp::Mlp;
pub use mlp_trainer::{MlpTrainer, MlpTraining};
pub use schedule::Schedule;

/// A field that can't be read, written, rendered or trained.
#[derive(Debug, thiserror::Error)]
pub enum TorchFieldError {
    /// libtorch refused.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// A file of weights can't be used.
    #[error(transparent)]
    Weights(#[from] nets::WeightsError),
    /// The file isn't a field.
    #[error("{path}: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Numbers went wrong twice within a hundred steps.
    #[error(
        "step {step}: the gradient is not finite, for the second time within 100 steps; lower the \
        rate"
    )]
    NotFinite {
        /// The step.
        step: u64,
    },
    /// A network sees the same whatever the ray, and can't learn any more.
    #[error("step {step}: the {network} network has collapsed: {why}; try another seed")]
    Collapsed {
        /// The step.
        step: u64,
        /// Which network.
        network: &'static str,
        /// What it sees instead.
        why: &'static str,
    },
}

//! Number of rays and peak memory of stages. A stage follows these rules, and the runner estimates
//! a run by them before the stage's inputs exist.
//!
//! * [`RayBudget`]: rays of a training, from the LR pixels.
//! * [`TrainingMemory`], [`preparation_bytes`], [`export_bytes`]: peak memory.

mod rays;
mod training;

pub use rays::RayBudget;
pub use training::{ImageSize, PixelStorage, TrainingMemory, grid_training_bytes, program_bytes};

/// Bytes per pixel of a photograph while it is resized: RGBA, premultiplied RGBA, and RGBA resized
/// along one axis.
const PHOTOGRAPH_BYTES: u64 = 12;
/// Bytes per pixel of the HR image: RGBA, and its encoded file.
const HR_BYTES: u64 = 8;

/// Returns the peak memory of preparing a view in `prep`, with `reading` bytes for reading its
/// photograph and `hr_pixels` of its HR image, 0 without one.
pub fn preparation_bytes(reading: u64, photograph_pixels: u64, hr_pixels: u64) -> u64 {
    reading.max(PHOTOGRAPH_BYTES * photograph_pixels + HR_BYTES * hr_pixels)
}

/// Maximum number of pixels of all views that `export` renders, unless their width is given; chosen
/// by hand.
const MAX_PIXELS: f64 = 16e6;
/// Maximum size of the rendered views relative to the cameras: a supersampled field has more detail
/// than the cameras' pixels (design note 043).
const MAX_SCALE: f64 = 2.0;
/// Bytes per node of the mesh's lattice: a signed distance.
const BYTES_PER_NODE: u64 = size_of::<f32>() as u64;
/// Bytes of a rendered pixel.
pub const SURFACE_PIXEL_BYTES: u64 = 24;
/// Bytes of a sample that is merged into a surfel.
pub const SURFEL_SAMPLE_BYTES: u64 = 20;

/// Returns the size of the views that `export` renders without a given width, relative to cameras
/// with `camera_pixels` in all.
pub fn export_scale(camera_pixels: u64) -> f64 {
    (MAX_PIXELS / camera_pixels as f64).sqrt().min(MAX_SCALE)
}

/// Returns the peak memory of an export whose views have `pixels` in all: all pixels, and the
/// larger of the merged samples and the lattice of a mesh.
pub fn export_bytes(pixels: u64, lattice_nodes: u64) -> u64 {
    // Two copies of each sample exist while samples are collected.
    let merged = 2 * SURFEL_SAMPLE_BYTES * pixels;
    SURFACE_PIXEL_BYTES * pixels + merged.max(BYTES_PER_NODE * lattice_nodes)
}

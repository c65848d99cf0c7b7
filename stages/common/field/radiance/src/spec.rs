//! Constants of the field, shared by the fused passes, the f64 reference and torch-field's hash
//! grid.

/// Number of features of a grid vertex.
pub const FEATURES: usize = 4;
/// Number of vertices of a brick, 2³, which are contiguous in memory.
pub const BRICK: usize = 8;
/// Factors of a brick's y and z coordinates in its hash (Müller et al. 2022, eq. 4); x has 1.
pub const HASH_FACTORS: [u32; 2] = [2_654_435_761, 805_459_861];

/// Number of outputs of the density network: raw density, raw red, green and blue, view features.
pub const DENSITY_OUTPUTS: usize = 16;
/// Index of the first raw colour among the density network's outputs.
pub const FIRST_RAW_COLOUR: usize = 1;
/// Index of the first view feature among the density network's outputs.
pub const FIRST_VIEW_FEATURE: usize = 4;
/// Number of view features. Composited along a ray, view features are inputs of the view network.
pub const VIEW_FEATURES: usize = DENSITY_OUTPUTS - FIRST_VIEW_FEATURE;
/// Number of spherical harmonics of a direction, up to degree 2.
pub const BASIS: usize = 9;
/// Number of inputs of the view network: view features and spherical harmonics.
pub const VIEW_INPUTS: usize = VIEW_FEATURES + BASIS;
/// Maximum raw density, to which larger values are clamped: a step is opaque long before e^15.
pub const MAX_RAW_DENSITY: f32 = 15.0;

/// Transmittance below which a ray ends: samples beyond have neither colour nor gradient. A larger
/// threshold costs PSNR (docs/design/006).
pub const MIN_TRANSMITTANCE: f32 = 1e-4;
/// Minimum weight of a sample that has colour and gradient. A larger threshold costs PSNR
/// (docs/design/006).
pub const MIN_WEIGHT: f32 = 1e-4;
/// Minimum total weight of a ray's samples for its depth to be their mean; chosen by hand.
pub const MIN_TOTAL_WEIGHT: f32 = 1e-4;
/// Optical depth at which a ray ends: -ln([`MIN_TRANSMITTANCE`]).
pub const MAX_OPTICAL_DEPTH: f32 = 9.210_34;
/// Maximum samples per ray in each marching round of a training step's forward pass; further rounds
/// use the last number (docs/design/006). Once a round finds a surface, the samples behind it are
/// never evaluated.
pub const TRAINING_ROUND_SAMPLES: [usize; 4] = [8, 8, 16, 32];

/// Maximum distance of a floater's colour from the background's (docs/design/013).
pub const MAX_FLOATER_COLOUR_DISTANCE: f32 = 0.1;

/// Cells of the occupancy grid along each axis of the unit cube.
pub const OCCUPANCY_CELLS: usize = 128;
/// Maximum optical depth of a step in a thin cell (docs/design/037), where training rays take a
/// sample of double length at every other step.
pub const MAX_THIN_OPTICAL_DEPTH: f32 = 0.05;
/// Maximum optical depth of a step in an empty cell. At a tenth of this threshold, the background
/// fills with faint density (docs/design/045).
pub const MAX_EMPTY_OPTICAL_DEPTH: f32 = 0.01;

/// Minimum weight of a training sample that raises its cell's density to the sample's own
/// (docs/design/037): random probes miss thin surfaces, and their cells would become empty.
pub const MIN_HIT_WEIGHT: f32 = 0.03;

/// Decay rates of Adam's two moments (Müller et al. 2022). The second is below the usual 0.999,
/// since a grid entry has a gradient in few steps.
pub const ADAM_BETA: [f64; 2] = [0.9, 0.99];
/// Numbers of low bits that are rounded off Adam's two moments, so that a weight's pair of moments
/// takes 32 bits (docs/design/006).
pub const ADAM_ROUNDED_BITS: [u32; 2] = [16, 15];
/// Term that keeps Adam's denominator above 0 (Müller et al. 2022).
pub const ADAM_EPSILON: f64 = 1e-15;

/// Choice between a sample at every step and one of double length at every other step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Strides {
    /// A sample at every step: for rendering.
    Single,
    /// Double strides in thin cells: for training, where other rays have samples in between.
    ByCell,
    /// Double strides everywhere: for a training's first steps, while density is smooth.
    Double,
}

impl Strides {
    /// Returns whether a sample in a thin or dense cell has double length.
    #[inline]
    pub(crate) fn are_double_in(self, thin: bool) -> bool {
        match self {
            Self::Single => false,
            Self::ByCell => thin,
            Self::Double => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_end_at_the_minimum_transmittance() {
        assert!((MAX_OPTICAL_DEPTH + MIN_TRANSMITTANCE.ln()).abs() < 1e-6);
    }
}

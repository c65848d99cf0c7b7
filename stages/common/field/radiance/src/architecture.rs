use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Sizes of a grid field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Architecture {
    /// Number of grid levels.
    pub n_levels: u32,
    /// Cells along an axis of the coarsest level.
    pub base_resolution: u32,
    /// Cells along an axis of the finest level.
    pub max_resolution: u32,
    /// Maximum number of cells along z, of any level: in NDC rays run along z, and cells thinner
    /// than the distance between samples train poorly.
    pub finest_z: u32,
    /// Base-2 logarithm of the maximum number of entries per level; finer levels are hashed.
    pub log2_hashmap_size: u32,
    /// Width of the hidden layers.
    pub hidden_dim: u32,
    /// Number of samples along the diagonal of the unit cube.
    pub march_steps: u32,
}

/// Maximum number of cells along an axis; chosen by hand.
const MAX_RESOLUTION: u32 = 4096;

impl Default for Architecture {
    fn default() -> Self {
        Self {
            n_levels: 8,
            base_resolution: 16,
            max_resolution: 256,
            finest_z: MAX_RESOLUTION,
            log2_hashmap_size: 17,
            hidden_dim: 64,
            march_steps: 512,
        }
    }
}

impl Architecture {
    /// Returns the distance between samples, in cube sides.
    pub fn march_step(&self) -> f32 {
        3.0f32.sqrt() / self.march_steps as f32
    }

    /// Fails with the first number that is out of range. The ranges are chosen by hand.
    pub fn check(&self) -> Result<(), DescriptionError> {
        check_ranges(&[
            ("n_levels", self.n_levels, 1, 16),
            ("base_resolution", self.base_resolution, 2, 512),
            ("max_resolution", self.max_resolution, self.base_resolution, MAX_RESOLUTION),
            ("finest_z", self.finest_z, 2, MAX_RESOLUTION),
            ("log2_hashmap_size", self.log2_hashmap_size, 8, 22),
            ("hidden_dim", self.hidden_dim, 16, 128),
            ("march_steps", self.march_steps, 16, 8192),
        ])
    }

    /// Returns the approximate number of samples of a ray through the whole cube: a training's
    /// estimate before its first step.
    pub fn samples_per_full_ray(&self) -> f64 {
        // The cube's side is 1/√3 = 0.577 of its diagonal; oblique rays are longer. Chosen by hand.
        f64::from(self.march_steps) * 0.6
    }
}

/// Sizes of a grid field as given by a user; a scene decides the others. Deserialised from the
/// parameters of `train-ss`.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct GivenSizes {
    /// Number of grid levels.
    pub n_levels: u32,
    /// Cells of the finest level for each LR pixel across the field's cube.
    pub cells_per_pixel: f64,
    /// Base-2 logarithm of the maximum number of entries per level.
    pub log2_hashmap_size: Option<u32>,
    /// Width of the hidden layers.
    pub hidden_dim: u32,
    /// Number of samples along the diagonal of the unit cube.
    pub march_steps: Option<u32>,
}

/// Default number of cells of the finest level for each LR pixel across the field's cube (design
/// note 006).
pub const CELLS_PER_PIXEL: f64 = 2.56;
/// Number of samples along the diagonal of the unit cube if the user gives none (design note 008).
const MARCH_STEPS: f64 = 512.0;
/// Number of these samples in NDC, where every ray crosses the whole cube (design note 008).
const MARCH_STEPS_IN_NDC: f64 = 256.0;
/// Power of a coarser field's resolution to which these samples are proportional (design note 048).
const MARCH_STEPS_EXPONENT: f64 = 1.0;
/// Power in NDC, where fewer samples cost little accuracy (design note 048).
const MARCH_STEPS_EXPONENT_IN_NDC: f64 = 1.5;
/// Range of the finest level's cells along an axis in [`GivenSizes::for_scene`]; chosen by hand.
const FINEST_RANGE: (f64, f64) = (32.0, 2048.0);
/// Range of the base-2 logarithm of a level's entries if the user gives none; chosen by hand.
const LOG2_HASHMAP_RANGE: (f64, f64) = (14.0, 20.0);

impl GivenSizes {
    /// Sets every size for a scene with `pixels_across` LR pixels across the field's cube.
    pub fn for_scene(&self, pixels_across: f64, is_ndc: bool) -> Architecture {
        let (low, high) = FINEST_RANGE;
        let finest = (self.cells_per_pixel * pixels_across).round().clamp(low, high);
        // The number of cells at surfaces grows with the square of the resolution. As by default,
        // a finest level of 256 cells has 2^17 entries.
        let (low, high) = LOG2_HASHMAP_RANGE;
        let by_finest = (17.0 + 2.0 * libm::log2(finest / 256.0)).round().clamp(low, high) as u32;
        let (by_space, exponent) = if is_ndc {
            (MARCH_STEPS_IN_NDC, MARCH_STEPS_EXPONENT_IN_NDC)
        } else {
            (MARCH_STEPS, MARCH_STEPS_EXPONENT)
        };
        let steps = self.march_steps.unwrap_or_else(|| {
            // Samples needn't be closer in a coarser field.
            let coarseness = (self.cells_per_pixel / CELLS_PER_PIXEL).min(1.0);
            (by_space * libm::pow(coarseness, exponent)).round().max(16.0) as u32
        });
        let Architecture { base_resolution, mut finest_z, .. } = Architecture::default();
        if is_ndc {
            // Samples along z across the cube: more cells would get none (design note 027).
            finest_z = finest_z.min((f64::from(steps) / 3.0f64.sqrt()).round() as u32);
        }
        Architecture {
            n_levels: self.n_levels,
            base_resolution,
            max_resolution: finest as u32,
            finest_z,
            log2_hashmap_size: self.log2_hashmap_size.unwrap_or(by_finest),
            hidden_dim: self.hidden_dim,
            march_steps: steps,
        }
    }
}

/// Error returned when a field's description can't be used, with the reason.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct DescriptionError(pub String);

/// Fails with the first of (name, value, minimum, maximum) whose value is out of range.
pub fn check_ranges(ranges: &[(&'static str, u32, u32, u32)]) -> Result<(), DescriptionError> {
    for &(name, value, low, high) in ranges {
        if !(low..=high).contains(&value) {
            return Err(DescriptionError(format!("{name} = {value} is not in {low}..={high}")));
        }
    }
    Ok(())
}

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Sizes of a grid field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Architecture {
    /// Number of grid levels.
    pub levels: u32,
    /// Cells along an axis of the coarsest level.
    pub coarsest: u32,
    /// Cells along an axis of the finest level.
    pub finest: u32,
    /// Maximum number of cells along z, of any level: in NDC rays run along z, and cells thinner
    /// than the distance between samples train poorly.
    pub finest_z: u32,
    /// Base-2 logarithm of the maximum number of entries per level; finer levels are hashed.
    pub log2_entries: u32,
    /// Width of the hidden layers.
    pub hidden: u32,
    /// Number of samples along the diagonal of the unit cube.
    pub steps: u32,
}

/// Maximum number of cells along an axis.
const MAX_RESOLUTION: u32 = 4096;

impl Default for Architecture {
    fn default() -> Self {
        Self {
            levels: 8,
            coarsest: 16,
            finest: 256,
            finest_z: MAX_RESOLUTION,
            log2_entries: 17,
            hidden: 64,
            steps: 512,
        }
    }
}

impl Architecture {
    /// Returns the distance between samples, in cube sides.
    pub fn step(&self) -> f32 {
        3.0f32.sqrt() / self.steps as f32
    }

    /// Fails with the first number that is out of range.
    pub fn check(&self) -> Result<(), OutOfRange> {
        check_ranges(&[
            ("levels", self.levels, 1, 16),
            ("coarsest", self.coarsest, 2, 512),
            ("finest", self.finest, self.coarsest, MAX_RESOLUTION),
            ("finest_z", self.finest_z, 2, MAX_RESOLUTION),
            ("log2_entries", self.log2_entries, 8, 22),
            ("hidden", self.hidden, 16, 128),
            ("steps", self.steps, 16, 8192),
        ])
    }

    /// Returns the approximate number of samples of a ray through the whole cube: a training's
    /// estimate before its first step.
    pub fn samples_per_full_ray(&self) -> f64 {
        // About 1/√3: the cube's side over its diagonal.
        f64::from(self.steps) * 0.6
    }
}

/// Error returned when a number is out of range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name} = {value} is not in {low}..={high}")]
pub struct OutOfRange {
    /// Name of the number.
    pub name: &'static str,
    /// Value found.
    pub value: u32,
    /// Minimum value.
    pub low: u32,
    /// Maximum value.
    pub high: u32,
}

/// Fails with the first of (name, value, minimum, maximum) whose value is out of range.
pub(crate) fn check_ranges(ranges: &[(&'static str, u32, u32, u32)]) -> Result<(), OutOfRange> {
    for &(name, value, low, high) in ranges {
        if !(low..=high).contains(&value) {
            return Err(OutOfRange { name, value, low, high });
        }
    }
    Ok(())
}

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ranges::{OutOfRange, in_ranges};

/// What a field is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Architecture {
    /// Levels of the grid.
    pub levels: u32,
    /// Cells along an axis of the coarsest level.
    pub coarsest: u32,
    /// Cells along an axis of the finest level.
    pub finest: u32,
    /// Cells along z at most, of any level: in NDC rays run along z, and cells that lie closer than
    /// their samples learn little each.
    pub finest_z: u32,
    /// Base-2 logarithm of the most entries a level may have; finer levels are hashed.
    pub log2_entries: u32,
    /// Width of the hidden layers.
    pub hidden: u32,
    /// Samples along the diagonal of the unit cube.
    pub steps: u32,
}

/// Cells along an axis, at most.
const MOST_CELLS: u32 = 4096;

impl Default for Architecture {
    fn default() -> Self {
        Self {
            levels: 8,
            coarsest: 16,
            finest: 256,
            finest_z: MOST_CELLS,
            log2_entries: 17,
            hidden: 64,
            steps: 512,
        }
    }
}

impl Architecture {
    /// Distance between samples, in cube sides.
    pub fn step(&self) -> f32 {
        3.0f32.sqrt() / self.steps as f32
    }

    /// Says which number can't be.
    pub fn check(&self) -> Result<(), OutOfRange> {
        let ranges = [
            ("levels", self.levels, 1, 16),
            ("coarsest", self.coarsest, 2, 512),
            ("finest", self.finest, self.coarsest, MOST_CELLS),
            ("finest_z", self.finest_z, 2, MOST_CELLS),
            ("log2_entries", self.log2_entries, 8, 22),
            ("hidden", self.hidden, 16, 128),
            ("steps", self.steps, 16, 8192),
        ];
        in_ranges(&ranges)
    }

    /// Samples of a ray through all of the cube, more or less: what a training expects before it
    /// has seen any.
    pub fn full_ray(&self) -> f64 {
        f64::from(self.steps) * 0.6
    }
}

use radiance::{DescriptionError, check_ranges};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Sizes of the paper's field; defaults are the published ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MlpArchitecture {
    /// Octaves of the positional encoding of positions.
    pub position_frequencies: u32,
    /// Octaves of the positional encoding of directions.
    pub direction_frequencies: u32,
    /// Number of layers before density and colour branch; the fifth has a skip connection.
    pub layers: u32,
    /// Width of the layers before the branch.
    pub hidden_dim: u32,
    /// Number of samples per ray of the coarse network.
    pub coarse_samples: u32,
    /// Number of additional samples per ray of the fine network.
    pub fine_samples: u32,
    /// In a box, positions are relative to the box's middle, in [`scene::Bounds::unit`]s. If
    /// false, they are in scene units from the origin, as in the reference code, which expects
    /// scenes of a few units around the origin.
    pub scaled_positions: bool,
}

impl Default for MlpArchitecture {
    fn default() -> Self {
        Self {
            position_frequencies: 10,
            direction_frequencies: 4,
            layers: 8,
            hidden_dim: 256,
            coarse_samples: 64,
            fine_samples: 64,
            scaled_positions: false,
        }
    }
}

impl MlpArchitecture {
    /// Fails with the first number that is out of range.
    pub fn check(&self) -> Result<(), DescriptionError> {
        check_ranges(&[
            ("position_frequencies", self.position_frequencies, 0, 16),
            ("direction_frequencies", self.direction_frequencies, 0, 16),
            ("layers", self.layers, 1, 32),
            ("hidden_dim", self.hidden_dim, 2, 4096),
            ("coarse_samples", self.coarse_samples, 4, 4096),
            ("fine_samples", self.fine_samples, 1, 4096),
        ])
    }
}

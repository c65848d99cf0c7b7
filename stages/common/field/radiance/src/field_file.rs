use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use scene::Bounds;

use crate::architecture::Architecture;
use crate::architecture::{OutOfRange, check_ranges};

/// Name of the description in a field artifact. Each member's weights are next to it, in
/// [`FieldFile::member_file`].
pub const FIELD_FILE: &str = "field.json";

/// Format of the weights that this build reads and writes. Formats of grid fields differ in their
/// networks, the order of their entries and the names in [`FIELD_FILE`]; the paper's field has a
/// single format.
pub const FIELD_FORMAT: u32 = 3;

/// Oldest format of a grid field that this build reads: only its names differ.
const OLDEST_FORMAT: u32 = 2;

/// Description of a field artifact, `field.json`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FieldFile {
    /// [`FIELD_FORMAT`] of the build that trained the field; 1 if missing.
    #[serde(default = "first_format")]
    pub format: u32,
    /// Kind and sizes of the field.
    pub field: FieldModel,
    /// Number of fields, trained independently or fine-tuned from another member; their renders are
    /// averaged.
    #[schemars(range(min = 1, max = 16))]
    pub members: u32,
    /// Bounds of the field, in scene units.
    pub bounds: Bounds,
    /// Background behind the scene.
    pub background: scene::Background,
}

/// Returns the format of a file without `format`.
fn first_format() -> u32 {
    1
}

/// Error returned when a field's description is invalid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FieldFileError {
    /// A number is out of range.
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
    /// The file has another format.
    #[error(
        "field has format {0} of another build; this build reads formats {OLDEST_FORMAT} to \
        {FIELD_FORMAT}: train the field again"
    )]
    Format(u32),
}

impl FieldFile {
    /// Returns the name of a member's weights file, next to [`FIELD_FILE`].
    pub fn member_file(index: u32) -> String {
        format!("field-{index}.safetensors")
    }

    /// Fails with the first number that is out of range, or with a format that can't be read.
    pub fn check(&self) -> Result<(), FieldFileError> {
        check_ranges(&[("members", self.members, 1, 16)])?;
        match self.field {
            FieldModel::Grid(_) if !(OLDEST_FORMAT..=FIELD_FORMAT).contains(&self.format) => {
                Err(FieldFileError::Format(self.format))
            }
            FieldModel::Grid(architecture) => Ok(architecture.check()?),
            FieldModel::Mlp(architecture) => Ok(architecture.check()?),
        }
    }
}

/// Kind of a field, and its sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FieldModel {
    /// Multi-resolution grid with small MLPs, of this crate.
    Grid(Architecture),
    /// The paper's coarse and fine MLP, of `torch-field`.
    Mlp(MlpArchitecture),
}

/// Sizes of the paper's field; defaults are the published ones. Aliases are the names of format 2.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MlpArchitecture {
    /// Octaves of the positional encoding of positions.
    #[serde(alias = "position_octaves")]
    pub position_frequencies: u32,
    /// Octaves of the positional encoding of directions.
    #[serde(alias = "direction_octaves")]
    pub direction_frequencies: u32,
    /// Number of layers before density and colour branch; the fifth has a skip connection.
    #[serde(alias = "depth")]
    pub layers: u32,
    /// Width of the layers before the branch.
    #[serde(alias = "width")]
    pub hidden_dim: u32,
    /// Number of samples per ray of the coarse network.
    pub coarse_samples: u32,
    /// Number of additional samples per ray of the fine network.
    pub fine_samples: u32,
    /// In NDC, colours depend on the NDC direction from the near to the far plane, not normalised,
    /// as in the reference code; if false, on the world direction.
    pub ndc_directions: bool,
    /// In a box, positions are relative to the box's middle, in [`Bounds::unit`]s. If false, they
    /// are in scene units from the origin, as in the reference code, which expects scenes of a few
    /// units around the origin.
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
            ndc_directions: false,
            scaled_positions: false,
        }
    }
}

impl MlpArchitecture {
    /// Fails with the first number that is out of range.
    pub fn check(&self) -> Result<(), OutOfRange> {
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

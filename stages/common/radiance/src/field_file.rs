use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use scene::Bounds;

use crate::architecture::Architecture;
use crate::ranges::{OutOfRange, in_ranges};

/// Name of the description in a field's artifact; the weights lie beside it, each member's in
/// [`FieldFile::member`].
pub const FIELD_FILE: &str = "field.json";

/// Format of the weights that this build writes: grid fields of another one it can't read, since
/// their networks and the order of their entries differ. The paper's field has had one format.
pub const FIELD_FORMAT: u32 = 2;

/// `field.json`: what a reader of the weights must know.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FieldFile {
    /// [`FIELD_FORMAT`] of the build that trained it; files from before there was such a number
    /// have none, and format 1.
    #[serde(default = "first_format")]
    pub format: u32,
    /// Which field, and what it is made of.
    pub field: FieldModel,
    /// How many there are, trained apart or one on from another: what they render is averaged.
    #[schemars(range(min = 1, max = 16))]
    pub members: u32,
    /// Where it lies, in scene units.
    pub bounds: Bounds,
    /// What lies behind the scene.
    pub background: scene::Background,
}

/// Format of files that don't say it.
fn first_format() -> u32 {
    1
}

/// A description of a field that no field can have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FieldFileError {
    /// A number out of its bounds.
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
    /// The file has another format.
    #[error(
        "another build trained this field, in format {0}; this build reads format {FIELD_FORMAT}: \
        train it again"
    )]
    Format(u32),
}

impl FieldFile {
    /// Name of a member's weights, beside [`FIELD_FILE`].
    pub fn member(index: u32) -> String {
        format!("field-{index}.safetensors")
    }

    /// Says which number can't be.
    pub fn check(&self) -> Result<(), FieldFileError> {
        in_ranges(&[("members", self.members, 1, 16)])?;
        match self.field {
            FieldModel::Grid(_) if self.format != FIELD_FORMAT => {
                Err(FieldFileError::Format(self.format))
            }
            FieldModel::Grid(architecture) => Ok(architecture.check()?),
            FieldModel::Mlp(architecture) => Ok(architecture.check()?),
        }
    }
}

/// A kind of field, and what it is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FieldModel {
    /// Multi-resolution grid with small MLPs: this crate's.
    Grid(Architecture),
    /// The paper's own two MLPs.
    Mlp(MlpArchitecture),
}

/// What the paper's field is made of; the defaults are the published ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MlpArchitecture {
    /// Octaves of the positions' encoding.
    pub position_octaves: u32,
    /// Octaves of the directions' encoding.
    pub direction_octaves: u32,
    /// Layers before density and colour part; positions join in again at the fifth.
    pub depth: u32,
    /// Width of those layers.
    pub width: u32,
    /// Samples of the coarse network along a ray.
    pub coarse_samples: u32,
    /// Samples that the fine network has besides those.
    pub fine_samples: u32,
    /// In NDC: colours depend on the ray's direction there, from the near to the far plane and not
    /// of unit length, as the reference's code has it; without it on its direction in the world.
    pub ndc_directions: bool,
    /// In a box: positions are counted from the box's middle, in [`Bounds::unit`]s. Without it they
    /// are scene units from the origin, as in the reference's code, which expects scenes of a few
    /// units around the origin.
    pub scaled_positions: bool,
}

impl Default for MlpArchitecture {
    fn default() -> Self {
        Self {
            position_octaves: 10,
            direction_octaves: 4,
            depth: 8,
            width: 256,
            coarse_samples: 64,
            fine_samples: 64,
            ndc_directions: false,
            scaled_positions: false,
        }
    }
}

impl MlpArchitecture {
    /// Says which number can't be.
    pub fn check(&self) -> Result<(), OutOfRange> {
        let ranges = [
            ("position_octaves", self.position_octaves, 0, 16),
            ("direction_octaves", self.direction_octaves, 0, 16),
            ("depth", self.depth, 1, 32),
            ("width", self.width, 2, 4096),
            ("coarse_samples", self.coarse_samples, 4, 4096),
            ("fine_samples", self.fine_samples, 1, 4096),
        ];
        in_ranges(&ranges)
    }
}

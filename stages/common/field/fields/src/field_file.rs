use radiance::{Architecture, DescriptionError, check_ranges};
use scene::{Background, Bounds};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use torch_field::MlpArchitecture;

/// Name of the description in a field artifact. Each member's weights are next to it, in
/// [`FieldFile::member_file`].
pub const FIELD_FILE: &str = "field.json";

/// Format of the weights that this build reads and writes. Formats of grid fields differ in their
/// networks, the order of their entries and the names in [`FIELD_FILE`]; the paper's field has a
/// single format.
pub const FIELD_FORMAT: u32 = 3;

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
    pub background: Background,
}

/// Returns the format of a file without `format`.
fn first_format() -> u32 {
    1
}

impl FieldFile {
    /// Returns the name of a member's weights file, next to [`FIELD_FILE`].
    pub fn member_file(index: u32) -> String {
        format!("field-{index}.safetensors")
    }

    /// Fails with the first number that is out of range, or with a format that can't be read.
    pub fn check(&self) -> Result<(), DescriptionError> {
        check_ranges(&[("members", self.members, 1, 16)])?;
        match self.field {
            FieldModel::Grid(_) if self.format != FIELD_FORMAT => Err(DescriptionError(format!(
                "field has format {} of another build; this build reads format {FIELD_FORMAT}: \
                train the field again",
                self.format
            ))),
            FieldModel::Grid(architecture) => architecture.check(),
            FieldModel::Mlp(architecture) => architecture.check(),
        }
    }
}

/// Kind of a field, and its sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FieldModel {
    /// Multi-resolution grid with small MLPs, of `radiance`.
    Grid(Architecture),
    /// The paper's coarse and fine MLP, of `torch-field`.
    Mlp(MlpArchitecture),
}

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use scene::Bounds;

use crate::{Architecture, Field, FieldError};

/// Name of the description in a field's artifact; the weights lie beside it, each member's in [`FieldFile::member`].
pub const FIELD_FILE: &str = "field.json";

/// `field.json`: what a reader of the weights must know.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FieldFile {
    /// Which kind of field.
    pub field: FieldKind,
    /// How many there are, trained apart on the same pictures: what they render is averaged.
    #[schemars(range(min = 1, max = 16))]
    pub members: u32,
    /// What it is made of.
    pub architecture: Architecture,
    /// Where it lies, in scene units.
    pub bounds: Bounds,
    /// What lies behind the scene.
    pub background: scene::Background,
}

impl FieldFile {
    /// Name of a member's weights, beside [`FIELD_FILE`].
    pub fn member(index: u32) -> String {
        format!("field-{index}.safetensors")
    }

    /// Reads all members; `path` says where a file of the artifact lies.
    pub fn read_members(&self, path: impl Fn(&str) -> PathBuf) -> Result<Vec<Field>, FieldError> {
        if !(1..=16).contains(&self.members) {
            let reason = format!("members = {} is not in 1..=16", self.members);
            return Err(FieldError::Format { path: path(FIELD_FILE), reason });
        }
        (0..self.members).map(|i| Field::read(&path(&Self::member(i)), self.architecture, self.bounds)).collect()
    }
}

/// The kinds of field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FieldKind {
    /// Multi-resolution grid with small MLPs: this crate's.
    Grid,
}

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use scene::Bounds;

use crate::Architecture;

/// Name of the description in a field's artifact; the weights lie beside it, in `field.safetensors`.
pub const FIELD_FILE: &str = "field.json";

/// `field.json`: what a reader of the weights must know.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FieldFile {
    /// Which kind of field.
    pub field: FieldKind,
    /// What it is made of.
    pub architecture: Architecture,
    /// Where it lies, in scene units.
    pub bounds: Bounds,
    /// What lies behind the scene.
    pub background: scene::Background,
}

/// The kinds of field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FieldKind {
    /// Multi-resolution grid with small MLPs: this crate's.
    Grid,
}

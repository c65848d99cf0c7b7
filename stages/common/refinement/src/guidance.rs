use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How references are looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Guidance {
    /// Whether a reference shows only what it sees by its own depth; without it also what something
    /// stands before.
    pub occlusion: bool,
    /// Whether what a reference shows is moved, by up to two pixels, to fit what is rendered.
    pub alignment: bool,
}

impl Default for Guidance {
    /// By its own depth, and where geometry puts it.
    fn default() -> Self {
        Self { occlusion: true, alignment: false }
    }
}

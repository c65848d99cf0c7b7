use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `report`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Maximum number of views with pictures, spread evenly over the test views. A page of many
    /// results has room for fewer.
    #[schemars(range(min = 1, max = 1000))]
    pub views: u32,
    /// Name of the view that the page shows first.
    #[schemars(extend("x-default" = "the first"))]
    pub compare: Option<String>,
    /// Square of that view to show first: x, y and side, in pixels.
    #[schemars(extend("x-default" = "the whole view"))]
    pub crop: Option<[u32; 3]>,
}

impl Default for Params {
    fn default() -> Self {
        Self { views: 50, compare: None, crop: None }
    }
}

use paper_refiner::OVERLAP;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `refine`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Share of the predicted residual that is added. Default: the best share for views that the
    /// refiner's training left out.
    #[schemars(range(min = 0.0, max = 2.0), extend("x-default" = "by refiner"))]
    pub residual_weight: Option<f64>,
    /// Maximum number of HR references: the first ones of input `references` are used.
    #[schemars(extend("x-default" = "all"))]
    pub max_references: Option<u32>,
    /// Turned and mirrored versions of a view whose residuals are averaged (geometric
    /// self-ensemble). Time grows with their number.
    #[schemars(range(min = 1, max = 8))]
    pub self_ensemble: u32,
    /// For refiners of `net: paper`: pixels by which patches of 64 pixels overlap.
    #[schemars(range(min = 0, max = 32))]
    pub overlap: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            residual_weight: None,
            max_references: None,
            self_ensemble: 4,
            overlap: OVERLAP as u32,
        }
    }
}

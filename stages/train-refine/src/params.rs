use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `train-refine`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Kind of network: ours, or the paper's, whose training takes weeks on a CPU.
    #[schemars(extend("x-group" = "network"))]
    pub net: Net,
    /// Seed of all random numbers.
    #[schemars(extend("x-group" = "sampling"))]
    pub seed: u64,
}

/// Kind of network, with the parameters of that kind.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Net {
    /// Ours: small, trained by internal learning, with or without references.
    Compact(CompactParams),
    /// NeRF-SR's: 30 million weights, trained on patches of HR references.
    Paper(PaperParams),
}

impl Default for Net {
    fn default() -> Self {
        Self::Compact(CompactParams::default())
    }
}

/// Parameters of our network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CompactParams {
    /// Number of training steps.
    #[schemars(range(min = 1), extend("x-group" = "optimiser"))]
    pub steps: u64,
    /// Number of patches per step.
    #[schemars(range(min = 1, max = 4096), extend("x-group" = "sampling"))]
    pub batch_size: u32,
    /// Pixels along each side of a patch, even.
    #[schemars(range(min = 8, max = 1024), extend("x-group" = "sampling"))]
    pub patch_size: u32,
    /// Highest learning rate.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "optimiser"))]
    pub learning_rate: f64,
    /// Number of features of the hidden layers.
    #[schemars(range(min = 1, max = 512), extend("x-group" = "network"))]
    pub features: u32,
    /// Number of residual blocks, of two layers each.
    #[schemars(range(min = 0, max = 64), extend("x-group" = "network"))]
    pub blocks: u32,
    /// Number of references per view during training, which should equal that during refinement. 0
    /// trains a network without references.
    #[schemars(range(min = 0, max = 64), extend("x-group" = "data"))]
    pub references_per_view: u32,
}

impl Default for CompactParams {
    fn default() -> Self {
        Self {
            steps: 3_500,
            batch_size: 8,
            patch_size: 64,
            learning_rate: 1e-3,
            features: 32,
            blocks: 4,
            references_per_view: 0,
        }
    }
}

/// Parameters of the paper's network, with the published settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PaperParams {
    /// Number of training steps.
    #[schemars(range(min = 1), extend("x-group" = "optimiser"))]
    pub steps: u64,
    /// Number of patches per step.
    #[schemars(range(min = 1, max = 4096), extend("x-group" = "sampling"))]
    pub batch_size: u32,
    /// Pixels along each side of a patch, a multiple of 8.
    #[schemars(range(min = 8, max = 1024), extend("x-group" = "sampling"))]
    pub patch_size: u32,
    /// Highest learning rate.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "optimiser"))]
    pub learning_rate: f64,
    /// Number of features of the first layer.
    #[schemars(range(min = 1, max = 512), extend("x-group" = "network"))]
    pub features: u32,
    /// Number of reference patches that the network gets with each patch.
    #[schemars(range(min = 1, max = 64), extend("x-group" = "data"))]
    pub patches: u32,
}

impl Default for PaperParams {
    fn default() -> Self {
        Self {
            steps: 46_875,
            batch_size: 32,
            patch_size: 64,
            learning_rate: 5e-4,
            features: 128,
            patches: 8,
        }
    }
}

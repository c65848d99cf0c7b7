use radiance::{Architecture, MlpArchitecture};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{Order, Supervision};

/// Parameters of `train-ss`. Those that stay unset get a default from the scene ([`Params::resolve`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Kind of field: the hash grid, or the paper's MLPs, which take hours on a CPU.
    #[schemars(extend("x-group" = "field"))]
    pub field: FieldParams,
    /// Sub-pixel rays along each side of an LR pixel, the paper's s; 1 is plain NeRF. It needn't be the scale of the views to render: few rays leave
    /// more of the budget for other pixels. For `supervision: kernel`, HR pixels along each side; a fraction is rounded up for the rays.
    #[schemars(range(min = 1.0, max = 16.0), extend("x-group" = "sampling"))]
    pub supersample: f64,
    /// What an LR pixel is compared with. Default: `kernel` for `grid` where the scene names its kernel and has a background, else `average`.
    #[schemars(extend("x-group" = "loss", "x-default" = BY_SCENE))]
    pub supervision: Option<Supervision>,
    /// Finds a factor for red, green and blue of each photograph, for photographs with several exposures or white balances. Views have the mean
    /// exposure.
    #[schemars(extend("x-group" = "data"))]
    pub exposure: bool,
    /// Moves cameras while the field learns, for poses that aren't exact. The motion that all cameras share stays out. Each field of an `ensemble`
    /// finds its own poses. `nerf-sr run registered` then renders test views from registered cameras.
    #[schemars(extend("x-group" = "data"))]
    pub pose_refinement: bool,
    /// Most HR references that are used: the first ones of input `references`.
    #[schemars(extend("x-group" = "data", "x-default" = "all"))]
    pub max_references: Option<u32>,
    /// Fields to train apart, each with its share of the rays. Their rendered images are averaged. Field m is trained as `seed` + m alone would be.
    #[schemars(range(min = 1, max = 16), extend("x-group" = "output"))]
    pub ensemble: u32,
    /// How the initial field (input `init`) and the fine-tuned one are used. Default: `average_weights` in NDC, where all cameras see the same side;
    /// `ensemble` elsewhere, where one reference tells nothing about the scene's other sides.
    #[schemars(extend("x-group" = "output", "x-default" = BY_SCENE))]
    pub combine: Option<Combine>,
    /// Seed of all random numbers.
    #[schemars(extend("x-group" = "sampling"))]
    pub seed: u64,
}

/// Stands for the default of a parameter that the scene decides.
const BY_SCENE: &str = "by scene";

impl Default for Params {
    fn default() -> Self {
        Self {
            field: FieldParams::default(),
            supersample: 2.0,
            supervision: None,
            exposure: false,
            pose_refinement: false,
            max_references: None,
            ensemble: 1,
            combine: None,
            seed: 0,
        }
    }
}

/// The kinds of field, each with its own parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FieldParams {
    /// Multi-resolution hash grid with small MLPs.
    Grid(GridParams),
    /// The paper's coarse and fine MLP, through libtorch.
    Mlp(MlpParams),
}

impl Default for FieldParams {
    fn default() -> Self {
        Self::Grid(GridParams::default())
    }
}

/// Parameters of a hash grid and its training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GridParams {
    /// Rays to train with, every sub-pixel ray counted, over the whole ensemble.
    #[schemars(range(min = 1), extend("x-group" = "sampling"))]
    pub rays: u64,
    /// Most rays in a step.
    #[schemars(range(min = 1, max = 1_048_576), extend("x-group" = "sampling"))]
    pub max_rays_per_step: u32,
    /// Samples that a step aims at: steps have fewer rays while space is full of semi-transparent density.
    #[schemars(range(min = 1024, max = 16_777_216), extend("x-group" = "sampling"))]
    pub samples_per_step: u32,
    /// Order of the pixels.
    #[schemars(extend("x-group" = "sampling"))]
    pub order: Order,
    /// How much more often a pixel with detail around it is drawn than a flat one, with `order: random`. Its weight falls by that factor, so the
    /// expected loss stays. Default: 10 with `order: random`, else 1.
    #[schemars(range(min = 1.0, max = 100.0), extend("x-group" = "sampling", "x-default" = "10"))]
    pub pixel_importance: Option<f64>,
    /// Share of the rays at the start with fewer sub-pixel rays: one a side, then two, doubling up to `supersample`.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "sampling"))]
    pub supersample_warmup: f64,
    /// Steps at the start that draw pixels from the middle half of each image's width and height alone.
    #[schemars(extend("x-group" = "sampling"))]
    pub precrop_steps: u32,
    /// Samples along the diagonal of the unit cube. Default: 256 in NDC, where every ray crosses the whole cube; else 512.
    #[schemars(range(min = 16, max = 8192), extend("x-group" = "sampling", "x-default" = BY_SCENE))]
    pub march_steps: Option<u32>,
    /// Weight of the distortion loss, which draws the weights along a ray together. Default: 0.004 in NDC with an opaque background, where density
    /// else fills empty space; 0 elsewhere, where the loss costs detail.
    #[schemars(range(min = 0.0, max = 10.0), extend("x-group" = "loss", "x-default" = BY_SCENE))]
    pub distortion: Option<f64>,
    /// Weight of the floater loss: opacity that has the background's colour, which no image can tell from empty space. Default: 0.001 before white
    /// or black, else 0.
    #[schemars(range(min = 0.0, max = 10.0), extend("x-group" = "loss", "x-default" = BY_SCENE))]
    pub floater_loss: Option<f64>,
    /// Highest learning rate of the grid's coarsest level.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "optimiser"))]
    pub learning_rate: f64,
    /// Learning rate of a level over that of the next coarser one. Below 1, coarse levels explain the images first.
    #[schemars(range(min = 0.01, max = 2.0), extend("x-group" = "optimiser"))]
    pub level_rate: f64,
    /// Highest learning rate of the MLPs.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "optimiser"))]
    pub mlp_learning_rate: f64,
    /// Learning rates at the end, as a share of the highest ones. They fall exponentially.
    #[schemars(range(min = 1e-6, max = 1.0), extend("x-group" = "optimiser"))]
    pub learning_rate_decay: f64,
    /// Share that the moving average of the weights keeps at each of its steps, late in the training; 0 takes the last weights.
    #[schemars(range(min = 0.0, max = 0.999), extend("x-group" = "optimiser"))]
    pub ema_decay: f64,
    /// Weight decay of the MLPs.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "optimiser"))]
    pub network_decay: f64,
    /// Levels of the grid.
    #[schemars(range(min = 1, max = 16), extend("x-group" = "field"))]
    pub n_levels: u32,
    /// Cells along an axis of the coarsest level.
    #[schemars(range(min = 2, max = 512), extend("x-group" = "field"))]
    pub base_resolution: u32,
    /// Cells along an axis of the finest level. Default: 2.56 for each LR pixel across the field, at least `base_resolution`.
    #[schemars(range(min = 2, max = 4096), extend("x-group" = "field", "x-default" = BY_SCENE))]
    pub max_resolution: Option<u32>,
    /// Most cells along z, of any level. Default: in NDC, where rays run along z, no more than a ray has samples; elsewhere no limit.
    #[schemars(range(min = 2, max = 4096), extend("x-group" = "field", "x-default" = BY_SCENE))]
    pub finest_z: Option<u32>,
    /// Base-2 logarithm of the most entries of a level. Default: 17 for a `max_resolution` of 256, and two more for each doubling of it.
    #[schemars(range(min = 8, max = 22), extend("x-group" = "field", "x-default" = BY_SCENE))]
    pub log2_hashmap_size: Option<u32>,
    /// Width of the MLPs' hidden layers.
    #[schemars(range(min = 16, max = 128), extend("x-group" = "field"))]
    pub hidden_dim: u32,
}

impl Default for GridParams {
    fn default() -> Self {
        let grid = Architecture::default();
        Self {
            rays: 30_000_000,
            max_rays_per_step: 4_096,
            samples_per_step: 65_536,
            order: Order::Random,
            pixel_importance: None,
            supersample_warmup: 0.3,
            precrop_steps: 0,
            march_steps: None,
            distortion: None,
            floater_loss: None,
            learning_rate: 4e-2,
            level_rate: 0.8,
            mlp_learning_rate: 1e-2,
            learning_rate_decay: 0.25,
            ema_decay: 0.97,
            network_decay: 1e-6,
            n_levels: grid.levels,
            base_resolution: grid.coarsest,
            max_resolution: None,
            finest_z: None,
            log2_hashmap_size: None,
            hidden_dim: grid.hidden,
        }
    }
}

/// Parameters of the paper's two MLPs and their training, with the published settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MlpParams {
    /// Rays to train with, every sub-pixel ray counted, over the whole ensemble. Default: those of 20 epochs, or of 30 in NDC.
    #[schemars(range(min = 1), extend("x-group" = "sampling", "x-default" = BY_SCENE))]
    pub rays: Option<u64>,
    /// Most rays in a step.
    #[schemars(range(min = 1, max = 1_048_576), extend("x-group" = "sampling"))]
    pub max_rays_per_step: u32,
    /// Order of the pixels.
    #[schemars(extend("x-group" = "sampling"))]
    pub order: Order,
    /// How much more often a pixel with detail around it is drawn than a flat one, with `order: random`. Its weight falls by that factor, so the
    /// expected loss stays.
    #[schemars(range(min = 1.0, max = 100.0), extend("x-group" = "sampling"))]
    pub pixel_importance: f64,
    /// Share of the rays at the start with fewer sub-pixel rays: one a side, then two, doubling up to `supersample`.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "sampling"))]
    pub supersample_warmup: f64,
    /// Steps at the start that draw pixels from the middle half of each image's width and height alone. Default: 0 in NDC, else 1000.
    #[schemars(extend("x-group" = "sampling", "x-default" = BY_SCENE))]
    pub precrop_steps: Option<u32>,
    /// Samples of the coarse MLP along a ray.
    #[schemars(range(min = 4, max = 4096), extend("x-group" = "sampling"))]
    pub coarse_samples: u32,
    /// Further samples along a ray, for the fine MLP.
    #[schemars(range(min = 1, max = 4096), extend("x-group" = "sampling"))]
    pub fine_samples: u32,
    /// Standard deviation of the noise on raw densities. Default: 1 in NDC, else 0.
    #[schemars(range(min = 0.0, max = 100.0), extend("x-group" = "loss", "x-default" = BY_SCENE))]
    pub density_noise_std: Option<f64>,
    /// Highest learning rate.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "optimiser"))]
    pub learning_rate: f64,
    /// Learning rate at the end, as a share of the highest one.
    #[schemars(range(min = 1e-6, max = 1.0), extend("x-group" = "optimiser"))]
    pub learning_rate_decay: f64,
    /// How the learning rate falls. A training shorter than the published one goes through its whole schedule in fewer steps.
    #[schemars(extend("x-group" = "optimiser"))]
    pub schedule: RateSchedule,
    /// How often an MLP that has collapsed (to the background, or to a wall before every camera) may start over with the next seed.
    #[schemars(range(min = 0, max = 100), extend("x-group" = "optimiser"))]
    pub restarts: u32,
    /// Octaves of the encoding of positions.
    #[schemars(range(min = 0, max = 16), extend("x-group" = "field"))]
    pub position_frequencies: u32,
    /// Octaves of the encoding of directions.
    #[schemars(range(min = 0, max = 16), extend("x-group" = "field"))]
    pub direction_frequencies: u32,
    /// In NDC: colours depend on the ray's direction there, as in the reference code, and not on its direction in the world.
    #[schemars(extend("x-group" = "field"))]
    pub ndc_directions: bool,
    /// Layers before density and colour part.
    #[schemars(range(min = 1, max = 32), extend("x-group" = "field"))]
    pub layers: u32,
    /// Width of the hidden layers.
    #[schemars(range(min = 2, max = 1024), extend("x-group" = "field"))]
    pub hidden_dim: u32,
}

impl Default for MlpParams {
    fn default() -> Self {
        let mlp = MlpArchitecture::default();
        Self {
            rays: None,
            max_rays_per_step: 2_048,
            order: Order::Epochs,
            pixel_importance: 1.0,
            supersample_warmup: 0.0,
            precrop_steps: None,
            coarse_samples: mlp.coarse_samples,
            fine_samples: mlp.fine_samples,
            density_noise_std: None,
            learning_rate: 5e-4,
            learning_rate_decay: 0.01,
            schedule: RateSchedule::Code,
            restarts: 0,
            position_frequencies: mlp.position_octaves,
            direction_frequencies: mlp.direction_octaves,
            ndc_directions: mlp.ndc_directions,
            layers: mlp.depth,
            hidden_dim: mlp.width,
        }
    }
}

/// How the initial and the fine-tuned field are used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Combine {
    /// The mean of their weights is kept (Wortsman et al. 2022, "Robust fine-tuning"): one field to render.
    AverageWeights,
    /// Their rendered images are averaged: better, and as slow as two fields.
    Ensemble,
}

/// How the learning rate of the paper's MLPs falls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum RateSchedule {
    /// As in the reference code: by epochs, flat until the last ten.
    Code,
    /// As in the paper's text: exponentially throughout.
    Paper,
}

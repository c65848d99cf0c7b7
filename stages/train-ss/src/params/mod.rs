//! Parameters of `train-ss`, and the defaults that depend on the scene.

mod resolve;
mod resolved;
mod scene_facts;

use radiance::Architecture;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use torch_field::MlpArchitecture;

pub use resolved::{Exposure, Resolved, ResolvedField};
pub use scene_facts::SceneFacts;

/// Parameters of `train-ss`. [`Params::resolve`] replaces `None` with a default for the scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Kind of field: the hash grid, or the paper's MLPs, which are slow on a CPU.
    #[schemars(extend("x-group" = "field"))]
    pub field: FieldParams,
    /// Sub-pixel rays along each side of an LR pixel, called s in the paper; 1 is plain NeRF. The
    /// number may differ from the views' scale; a smaller number covers more pixels with the same
    /// `rays`. With `supervision: kernel`, it is the number of HR pixels along each side of an LR
    /// pixel, and may be fractional: at 1.5, an LR pixel casts 2 × 2 rays.
    #[schemars(range(min = 1.0, max = 16.0), extend("x-group" = "sampling"))]
    pub supersample: f64,
    /// Fraction of the rays that are cast before each LR pixel gets all of its sub-pixel rays: 1
    /// per side at first, then 2, 4 and so on, up to `supersample`. Default: 0.3, or 0 with
    /// `field: mlp`. A fine-tuning (input `init`) ignores this parameter and uses 0.
    #[schemars(range(min = 0.0, max = 1.0))]
    #[schemars(extend("x-group" = "sampling", "x-default" = BY_SCENE))]
    pub supersample_warmup: Option<f64>,
    /// Total number of rays, with every sub-pixel ray counted, over the whole ensemble. Default:
    /// from the number of LR pixels by `rays_per_pixel`, `min_rays` and `max_rays`. With
    /// `field: mlp`, 20 epochs, or 30 in NDC; an epoch is one pass over all pixels.
    #[schemars(range(min = 1), extend("x-group" = "sampling", "x-default" = BY_SCENE))]
    pub rays: Option<u64>,
    /// Maximum number of rays in a step; with `field: grid`, values below 256 mean 256. Default:
    /// 8192, or 2048 with `field: mlp`.
    #[schemars(range(min = 1, max = 1_048_576))]
    #[schemars(extend("x-group" = "sampling", "x-default" = "by `field`"))]
    pub max_rays_per_step: Option<u32>,
    /// Highest learning rate of the paper's MLPs, or of the grid's coarsest level. The rate of each
    /// finer level is 0.8 times that of the level before. Default: 0.06, or 0.0005 with
    /// `field: mlp`.
    #[schemars(range(min = 0.0, max = 1.0))]
    #[schemars(extend("x-group" = "optimiser", "x-default" = "by `field`"))]
    pub learning_rate: Option<f64>,
    /// Comparison of an LR pixel with its rays. Default: `kernel` for `field: grid` if the scene
    /// states the kernel of the LR images and `background` isn't `alpha`; otherwise `average`.
    #[schemars(extend("x-group" = "loss", "x-default" = BY_SCENE))]
    pub supervision: Option<Supervision>,
    /// Estimates a gain for red, green and blue of each photograph, for photographs with several
    /// exposures or white balances. Rendered views have the mean exposure of the photographs.
    /// Default: false with `field: mlp`, background `alpha` or `pose_refinement`; otherwise the
    /// first 512 steps measure the gains. If the gains differ by more than a limit, training starts
    /// over and estimates them. The limit, usually 2 to 4 %, is a fifth of the field's relative
    /// error. In fine-tuning (input `init`), the default is the initial field's choice.
    #[schemars(extend("x-group" = "data", "x-default" = BY_SCENE))]
    pub exposure: Option<bool>,
    /// Optimises camera poses during training, for poses that aren't exact. Trains the first field
    /// twice, with refined and with given poses, and keeps the better poses. Motion that all
    /// cameras share is removed. Each field of an `ensemble` estimates its own poses.
    /// `nerf-sr run registered` then renders test views from registered cameras.
    #[schemars(extend("x-group" = "data"))]
    pub pose_refinement: bool,
    /// Carves the visual hull: a cell stays empty if at least one photograph has only transparent
    /// pixels there. Has an effect only with `field: grid`, photographs with alpha and space `box`,
    /// and not if `pose_refinement` moves the cameras.
    #[schemars(extend("x-group" = "data"))]
    pub silhouettes: bool,
    /// Maximum number of HR references: the first ones of input `references` are used.
    #[schemars(extend("x-group" = "data", "x-default" = "all"))]
    pub max_references: Option<u32>,
    /// Number of fields to train independently. `rays` is divided among them, and their rendered
    /// images are averaged. Field m equals a single field trained with seed `seed` + m.
    #[schemars(range(min = 1, max = 16), extend("x-group" = "output"))]
    pub ensemble: u32,
    /// Combination of the initial field (input `init`) with the fine-tuned field. Default:
    /// `average_weights` in NDC, where all cameras observe the same side of the scene; otherwise
    /// `ensemble`, since fine-tuning on a reference gives no information about the other sides.
    #[schemars(extend("x-group" = "output", "x-default" = BY_SCENE))]
    pub combine: Option<Combine>,
    /// Seed of all random numbers.
    #[schemars(extend("x-group" = "sampling"))]
    pub seed: u64,
}

/// Text in place of a default that depends on the scene.
const BY_SCENE: &str = "by scene";

impl Default for Params {
    fn default() -> Self {
        Self {
            field: FieldParams::default(),
            supersample: 2.0,
            supersample_warmup: None,
            rays: None,
            max_rays_per_step: None,
            learning_rate: None,
            supervision: None,
            exposure: None,
            pose_refinement: false,
            silhouettes: true,
            max_references: None,
            ensemble: 1,
            combine: None,
            seed: 0,
        }
    }
}

/// Kind of field, with the parameters of that kind.
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
    /// Rays for each LR pixel of all views, unless `rays` is given. Fine-tuning (input `init`)
    /// halves the resulting number of rays, even below `min_rays`.
    #[schemars(range(min = 0.001, max = 100_000.0), extend("x-group" = "sampling"))]
    pub rays_per_pixel: f64,
    /// Factor of `rays_per_pixel` with `background: opaque`. There each ray hits a surface and
    /// takes more time, especially early in training, while density is still semi-transparent.
    #[schemars(range(min = 0.01, max = 1.0), extend("x-group" = "sampling"))]
    pub opaque_ray_factor: f64,
    /// Minimum number of rays, if the number is derived from `rays_per_pixel`.
    #[schemars(range(min = 1), extend("x-group" = "sampling"))]
    pub min_rays: u64,
    /// Maximum number of rays, if the number is derived from `rays_per_pixel`, even if `min_rays`
    /// is larger. The maximum limits the time of a training on many or large photographs.
    #[schemars(range(min = 1), extend("x-group" = "sampling"))]
    pub max_rays: u64,
    /// Target number of samples in the first steps. The last steps have 8/3 times as many. Steps
    /// have fewer rays while space is full of semi-transparent density.
    #[schemars(range(min = 1024, max = 16_777_216), extend("x-group" = "sampling"))]
    pub samples_per_step: u32,
    /// Factor by which pixels with detail around them are drawn more often than flat pixels. In the
    /// loss, flat pixels have a weight larger by this factor, which keeps the expected loss
    /// unchanged.
    #[schemars(range(min = 1.0, max = 100.0), extend("x-group" = "sampling"))]
    pub pixel_importance: f64,
    /// Samples along the diagonal of the unit cube. Default: 256 in NDC, where every ray crosses
    /// the whole cube; otherwise 512. Below a `cells_per_pixel` of 2.56, the default falls in
    /// proportion to `cells_per_pixel`, or to `cells_per_pixel`^1.5 in NDC.
    #[schemars(range(min = 16, max = 8192), extend("x-group" = "sampling", "x-default" = BY_SCENE))]
    pub march_steps: Option<u32>,
    /// Weight of the distortion loss, which concentrates the sample weights along a ray. Default:
    /// with `background: opaque`, where empty space would otherwise fill with density, 0.004 in NDC
    /// and 0.002 in a contraction; in all other cases 0, because the loss costs detail.
    #[schemars(range(min = 0.0, max = 10.0), extend("x-group" = "loss", "x-default" = BY_SCENE))]
    pub distortion: Option<f64>,
    /// Weight of the floater loss, which penalises semi-transparent density of the background's
    /// colour: images cannot distinguish such density from empty space. Default: 0.001 with a white
    /// or black background, otherwise 0.
    #[schemars(range(min = 0.0, max = 10.0), extend("x-group" = "loss", "x-default" = BY_SCENE))]
    pub floater_loss: Option<f64>,
    /// Highest learning rate of the MLPs.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "optimiser"))]
    pub mlp_learning_rate: f64,
    /// Final learning rates as a fraction of the highest ones. Learning rates fall exponentially.
    #[schemars(range(min = 1e-6, max = 1.0), extend("x-group" = "optimiser"))]
    pub learning_rate_decay: f64,
    /// Decay of the moving average of the weights, which starts late in training. 0 uses the final
    /// weights without averaging.
    #[schemars(range(min = 0.0, max = 0.999), extend("x-group" = "optimiser"))]
    pub ema_decay: f64,
    /// Levels of the grid.
    #[schemars(range(min = 1, max = 16), extend("x-group" = "field"))]
    pub n_levels: u32,
    /// Size of an LR pixel in cells of the finest level, which has 32 to 2048 cells along each
    /// axis.
    #[schemars(range(min = 0.1, max = 16.0), extend("x-group" = "field"))]
    pub cells_per_pixel: f64,
    /// Base-2 logarithm of the maximum number of entries per level. Default: 17 at 256 cells across
    /// the finest level, plus 2 for each doubling, but between 14 and 20.
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
            rays_per_pixel: 32.0,
            // The protocols 252x2 and 100x2 (`experiments/common.yaml`) have about this ratio.
            opaque_ray_factor: 0.6,
            min_rays: 8_000_000,
            max_rays: 80_000_000,
            samples_per_step: 24_576,
            // Design note 010.
            pixel_importance: 10.0,
            march_steps: None,
            distortion: None,
            floater_loss: None,
            mlp_learning_rate: 1e-2,
            learning_rate_decay: 0.16,
            ema_decay: 0.97,
            n_levels: grid.n_levels,
            cells_per_pixel: radiance::CELLS_PER_PIXEL,
            log2_hashmap_size: None,
            hidden_dim: grid.hidden_dim,
        }
    }
}

/// Parameters of the paper's two MLPs and their training, with the published settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MlpParams {
    /// Number of steps at the start that draw pixels only from the middle half of each image's
    /// width and height. Default: 0 in NDC, otherwise 1000. A fine-tuning (input `init`) ignores
    /// this parameter and uses 0.
    #[schemars(extend("x-group" = "sampling", "x-default" = BY_SCENE))]
    pub precrop_steps: Option<u32>,
    /// Samples of the coarse MLP along a ray.
    #[schemars(range(min = 4, max = 4096), extend("x-group" = "sampling"))]
    pub coarse_samples: u32,
    /// Additional samples along a ray, for the fine MLP.
    #[schemars(range(min = 1, max = 4096), extend("x-group" = "sampling"))]
    pub fine_samples: u32,
    /// Number of layers that density and colour share.
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
            precrop_steps: None,
            coarse_samples: mlp.coarse_samples,
            fine_samples: mlp.fine_samples,
            layers: mlp.layers,
            hidden_dim: mlp.hidden_dim,
        }
    }
}

/// Comparison of an LR pixel with its rays.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Supervision {
    /// Compares the mean of the rays, for LR images of any origin (the paper's eq. 4).
    Average,
    /// Renders HR pixels and shrinks them by the known degradation kernel.
    Kernel,
}

/// Combination of the initial with the fine-tuned field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Combine {
    /// Averages the weights (Wortsman et al. 2022, "Robust fine-tuning"): one field to render.
    AverageWeights,
    /// Averages the rendered images: better, and as slow as two fields.
    Ensemble,
}

//! Defaults that depend on the scene: decided here, once, and recorded in `training.json`.

use std::collections::BTreeMap;

use radiance::{Architecture, FieldModel, MlpArchitecture, Regularisers, TrainingOptions};
use scene::{Background, Intrinsics, Space, View, Views};
use serde_json::{Value, json};

use crate::params::{Combine, FieldParams, GridParams, MlpParams, Params};
use crate::pixel_sampler::Order;
use crate::sub_pixel_rays::{rays_per_side, warmup_stages};
use crate::supervision::Supervision;

/// Epochs of the published trainings: for Blender's scenes, and for photographs in NDC.
const EPOCHS: u64 = 20;
const EPOCHS_IN_NDC: u64 = 30;
/// Steps of precrop of the published training on Blender's scenes.
const PRECROP_STEPS: u32 = 1000;
/// Weights of the distortion loss before an opaque background, in NDC and in a contraction.
const DISTORTION_IN_NDC: f64 = 0.004;
const DISTORTION_IN_CONTRACTION: f64 = 0.002;
/// Weight of the floater loss before a background that has one colour.
const FLOATER_LOSS: f64 = 0.001;
/// How much more often detail is drawn, in random order.
const PIXEL_IMPORTANCE: f64 = 10.0;
/// Steps in which the learning rates of a grid rise.
const WARM_UP_STEPS: u64 = 100;
/// Gradients shorter than so many times the mean are drawn at random.
const ROULETTE: f32 = 0.25;
/// Cells of the finest level for each LR pixel across the field.
const CELLS_PER_PIXEL: f64 = 2.56;

/// All that defaults depend on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneFacts {
    /// What the field's cube holds.
    pub space: Space,
    /// What lies behind the scene.
    pub background: Background,
    /// LR pixels across the field's cube, as the finest view sees it.
    pub pixels_across: f64,
    /// LR pixels of all views.
    pub lr_pixels: u64,
    /// Whether the scene names the kernel that made its LR images.
    pub has_kernel: bool,
    /// Whether the training starts from a trained field.
    pub is_fine_tuning: bool,
}

impl SceneFacts {
    /// Those of a scene whose training begins with nothing.
    pub fn of(views: &Views, has_kernel: bool) -> Self {
        let pixels =
            |v: &View| u64::from(v.camera.intrinsics.width) * u64::from(v.camera.intrinsics.height);
        Self {
            space: views.bounds.space,
            background: views.background,
            pixels_across: pixels_across(views),
            lr_pixels: views.views.iter().map(pixels).sum(),
            has_kernel,
            is_fine_tuning: false,
        }
    }

    fn is_ndc(&self) -> bool {
        matches!(self.space, Space::Ndc(_))
    }
}

fn pixels_across(views: &Views) -> f64 {
    let across = |view: &View| across(view.camera.intrinsics, views.bounds.space);
    views.views.iter().map(across).fold(0.0, f64::max)
}

/// LR pixels across the field's cube, as one view sees it.
fn across(k: Intrinsics, space: Space) -> f64 {
    match space {
        // The cube is about what a view sees.
        Space::Box => f64::from(k.width),
        Space::Ndc(f) => (f.max[0] - f.min[0]).max(f.max[1] - f.min[1]) * k.fx,
        // Half of it is, and the shell around it.
        Space::Contraction => 2.0 * f64::from(k.width),
    }
}

/// Parameters with every default decided.
#[derive(Clone, Debug, PartialEq)]
pub struct Resolved {
    /// The field and what its own training needs.
    pub field: ResolvedField,
    /// Sub-pixel rays along each side of an LR pixel.
    pub supersample: f64,
    /// Share of the rays with fewer sub-pixel rays.
    pub supersample_warmup: f64,
    /// What an LR pixel is compared with.
    pub supervision: Supervision,
    /// Whether exposures are found.
    pub exposure: bool,
    /// Whether cameras are moved.
    pub pose_refinement: bool,
    /// Order of the pixels.
    pub order: Order,
    /// How much more often detail is drawn.
    pub pixel_importance: f64,
    /// Steps that draw from the middle of the images alone.
    pub precrop_steps: u32,
    /// Fields to train apart.
    pub ensemble: u32,
    /// Rays over all fields of the ensemble.
    pub rays: u64,
    /// Most rays in a step.
    pub max_rays_per_step: u32,
    /// Rays through all sub-pixels of all views.
    pub epoch: u64,
    /// Most HR references that are used.
    pub max_references: usize,
    /// How the initial and the fine-tuned field are used.
    pub combine: Combine,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// A field with every default decided.
#[derive(Clone, Debug, PartialEq)]
pub enum ResolvedField {
    /// A hash grid.
    Grid {
        /// Its shape.
        architecture: Architecture,
        /// What is asked of its rays beside their colours.
        regularisers: ResolvedRegularisers,
        /// Its parameters as given.
        given: GridParams,
    },
    /// The paper's MLPs.
    Mlp {
        /// Their shape.
        architecture: MlpArchitecture,
        /// Standard deviation of the noise on raw densities.
        density_noise_std: f64,
        /// Their parameters as given.
        given: MlpParams,
    },
}

/// Weights of what is asked of a grid's rays, with every default decided.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ResolvedRegularisers {
    /// Weight of the distortion loss.
    pub distortion: f64,
    /// Weight of the floater loss.
    pub floater_loss: f64,
}

/// Parameters that can't be meant together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ParamsError {
    /// The coarsest level of a grid has more cells than the finest.
    #[error("parameter base_resolution: {base} is above max_resolution = {max}")]
    BaseAboveMax {
        /// Cells along an axis of the coarsest level.
        base: u32,
        /// Cells along an axis of the finest level.
        max: u32,
    },
}

impl Params {
    /// Fails on parameters that can't be meant together.
    pub fn check(&self) -> Result<(), ParamsError> {
        match self.field {
            FieldParams::Grid(GridParams {
                base_resolution: base,
                max_resolution: Some(max),
                ..
            }) if max < base => Err(ParamsError::BaseAboveMax { base, max }),
            _ => Ok(()),
        }
    }

    /// Sub-pixel rays along each side of an LR pixel, once all are cast.
    fn side(&self) -> u64 {
        rays_per_side(self.supersample)
    }

    /// Decides every default for a scene.
    pub fn resolve(&self, scene: &SceneFacts) -> Resolved {
        let epoch = scene.lr_pixels * self.side().pow(2);
        let has_background = scene.background != Background::Alpha;
        let (is_grid, sampling) = match &self.field {
            FieldParams::Grid(grid) => (true, grid.sampling()),
            FieldParams::Mlp(mlp) => (false, mlp.sampling(scene, epoch)),
        };
        let supervision = if is_grid && scene.has_kernel && has_background {
            Supervision::Kernel
        } else {
            Supervision::Average
        };
        let combine = if scene.is_ndc() { Combine::AverageWeights } else { Combine::Ensemble };
        // The rough shape of a field that is fine-tuned is known.
        let at_start = if scene.is_fine_tuning {
            (0.0, 0)
        } else {
            (sampling.supersample_warmup, sampling.precrop_steps)
        };
        Resolved {
            field: self.field.resolve(scene),
            supersample: self.supersample,
            supersample_warmup: at_start.0,
            supervision: self.supervision.unwrap_or(supervision),
            exposure: self.exposure,
            pose_refinement: self.pose_refinement,
            order: sampling.order,
            pixel_importance: sampling.pixel_importance,
            precrop_steps: at_start.1,
            ensemble: self.ensemble,
            rays: sampling.rays,
            max_rays_per_step: sampling.max_rays_per_step,
            epoch,
            max_references: self.max_references.map_or(usize::MAX, |most| most as usize),
            combine: self.combine.unwrap_or(combine),
            seed: self.seed,
        }
    }
}

/// What both fields say of how rays are drawn.
struct Sampling {
    rays: u64,
    max_rays_per_step: u32,
    order: Order,
    pixel_importance: f64,
    supersample_warmup: f64,
    precrop_steps: u32,
}

impl GridParams {
    fn sampling(&self) -> Sampling {
        let importance = if self.order == Order::Random { PIXEL_IMPORTANCE } else { 1.0 };
        Sampling {
            rays: self.rays,
            max_rays_per_step: self.max_rays_per_step,
            order: self.order,
            pixel_importance: self.pixel_importance.unwrap_or(importance),
            supersample_warmup: self.supersample_warmup,
            precrop_steps: self.precrop_steps,
        }
    }

    fn architecture(&self, scene: &SceneFacts) -> Architecture {
        let by_width = (CELLS_PER_PIXEL * scene.pixels_across).round().clamp(64.0, 2048.0) as u32;
        let finest = self.max_resolution.unwrap_or(by_width.max(self.base_resolution));
        // Surfaces grow with the square of the resolution.
        let by_finest =
            (17.0 + 2.0 * (f64::from(finest) / 256.0).log2()).round().clamp(14.0, 20.0) as u32;
        let steps = self.march_steps.unwrap_or(if scene.is_ndc() { 256 } else { 512 });
        let unlimited = Architecture::default().finest_z;
        // Rays run along z in NDC: cells needn't lie closer than their samples.
        let by_steps = (f64::from(steps) / 3.0f64.sqrt()).round() as u32;
        let finest_z = if scene.is_ndc() { by_steps.min(unlimited) } else { unlimited };
        Architecture {
            levels: self.n_levels,
            coarsest: self.base_resolution,
            finest,
            finest_z: self.finest_z.unwrap_or(finest_z),
            log2_entries: self.log2_hashmap_size.unwrap_or(by_finest),
            hidden: self.hidden_dim,
            steps,
        }
    }

    fn regularisers(&self, scene: &SceneFacts) -> ResolvedRegularisers {
        let distortion = match (scene.background, scene.space) {
            (Background::Opaque, Space::Ndc(_)) => DISTORTION_IN_NDC,
            (Background::Opaque, Space::Contraction) => DISTORTION_IN_CONTRACTION,
            (_, Space::Ndc(_) | Space::Contraction | Space::Box) => 0.0,
        };
        let has_colour = matches!(scene.background, Background::White | Background::Black);
        ResolvedRegularisers {
            distortion: self.distortion.unwrap_or(distortion),
            floater_loss: self.floater_loss.unwrap_or(if has_colour { FLOATER_LOSS } else { 0.0 }),
        }
    }
}

impl MlpParams {
    fn sampling(&self, scene: &SceneFacts, epoch: u64) -> Sampling {
        let (epochs, precrop_steps) =
            if scene.is_ndc() { (EPOCHS_IN_NDC, 0) } else { (EPOCHS, PRECROP_STEPS) };
        Sampling {
            rays: self.rays.unwrap_or(epochs * epoch),
            max_rays_per_step: self.max_rays_per_step,
            order: self.order,
            pixel_importance: self.pixel_importance,
            supersample_warmup: self.supersample_warmup,
            precrop_steps: self.precrop_steps.unwrap_or(precrop_steps),
        }
    }

    fn architecture(&self) -> MlpArchitecture {
        MlpArchitecture {
            position_octaves: self.position_frequencies,
            direction_octaves: self.direction_frequencies,
            ndc_directions: self.ndc_directions,
            scaled_positions: true,
            depth: self.layers,
            width: self.hidden_dim,
            coarse_samples: self.coarse_samples,
            fine_samples: self.fine_samples,
        }
    }
}

impl FieldParams {
    fn resolve(&self, scene: &SceneFacts) -> ResolvedField {
        match self {
            Self::Grid(grid) => ResolvedField::Grid {
                architecture: grid.architecture(scene),
                regularisers: grid.regularisers(scene),
                given: grid.clone(),
            },
            Self::Mlp(mlp) => ResolvedField::Mlp {
                architecture: mlp.architecture(),
                density_noise_std: mlp.density_noise_std.unwrap_or(if scene.is_ndc() {
                    1.0
                } else {
                    0.0
                }),
                given: mlp.clone(),
            },
        }
    }
}

impl Resolved {
    /// The parameters whose defaults the scene decides, by name, with the values in use: for
    /// `training.json`.
    pub fn record(&self) -> BTreeMap<String, Value> {
        let common = json!({
            "combine": self.combine,
            "pixel_importance": self.pixel_importance,
            "precrop_steps": self.precrop_steps,
            "rays": self.rays,
            "supersample_warmup": self.supersample_warmup,
            "supervision": self.supervision,
        });
        let own = match &self.field {
            ResolvedField::Grid { architecture, regularisers, .. } => json!({
                "distortion": regularisers.distortion,
                "finest_z": architecture.finest_z,
                "floater_loss": regularisers.floater_loss,
                "log2_hashmap_size": architecture.log2_entries,
                "march_steps": architecture.steps,
                "max_resolution": architecture.finest,
            }),
            ResolvedField::Mlp { density_noise_std, .. } => {
                json!({ "density_noise_std": density_noise_std })
            }
        };
        let entries = [common, own].into_iter().filter_map(|values| values.as_object().cloned());
        entries.flatten().collect()
    }

    /// What is trained.
    pub fn model(&self) -> FieldModel {
        match &self.field {
            ResolvedField::Grid { architecture, .. } => FieldModel::Grid(*architecture),
            ResolvedField::Mlp { architecture, .. } => FieldModel::Mlp(*architecture),
        }
    }

    /// How often a training may start over.
    pub(crate) fn restarts(&self) -> u32 {
        match &self.field {
            ResolvedField::Grid { .. } => 0,
            ResolvedField::Mlp { given, .. } => given.restarts,
        }
    }

    /// Parameters by which a field of the ensemble is trained as if it were alone, with its share
    /// of the rays.
    #[must_use]
    pub fn member(&self, index: u32) -> Self {
        let members = u64::from(self.ensemble.max(1));
        let own = self.rays / members + u64::from(u64::from(index) < self.rays % members);
        Self {
            ensemble: 1,
            rays: own,
            seed: self.seed.wrapping_add(u64::from(index)),
            ..self.clone()
        }
    }

    /// Bundles of rays that are drawn from the middle of the images: those of the first
    /// `precrop_steps` steps.
    pub fn precrop_bundles(&self) -> u64 {
        let (batch, side) = (u64::from(self.max_rays_per_step), rays_per_side(self.supersample));
        let doublings = warmup_stages(side);
        let steps_of_stage = (self.supersample_warmup * self.rays as f64
            / f64::from(doublings.max(1))) as u64
            / batch;
        let stages = (0..doublings).map(|i| (steps_of_stage, 1 << i)).chain([(u64::MAX, side)]);
        let mut left = u64::from(self.precrop_steps);
        let mut bundles = 0;
        for (steps, side) in stages {
            let steps = left.min(steps);
            left -= steps;
            bundles += steps * (batch / (side * side)).max(1);
        }
        bundles
    }

    /// How a grid is trained.
    pub fn grid_training(
        &self,
        grid: &GridParams,
        regularisers: &ResolvedRegularisers,
    ) -> TrainingOptions {
        TrainingOptions {
            rays: self.rays,
            max_rays_per_step: self.max_rays_per_step as usize,
            samples_per_step: grid.samples_per_step as usize,
            learning_rate: grid.learning_rate,
            level_rate: grid.level_rate,
            mlp_learning_rate: grid.mlp_learning_rate,
            learning_rate_decay: grid.learning_rate_decay,
            warm_up: WARM_UP_STEPS,
            ema_decay: grid.ema_decay as f32,
            regularisers: Regularisers {
                distortion: regularisers.distortion as f32,
                floater_loss: regularisers.floater_loss as f32,
            },
            network_decay: grid.network_decay as f32,
            roulette: ROULETTE,
            seed: self.seed,
        }
    }

    /// How the paper's field is trained.
    #[cfg(feature = "torch")]
    pub fn mlp_training(
        &self,
        mlp: &MlpParams,
        density_noise_std: f64,
    ) -> torch_field::MlpTraining {
        use crate::params::RateSchedule;
        let epochs = self.rays.div_ceil(self.epoch.max(1));
        torch_field::MlpTraining {
            rays: self.rays,
            max_rays_per_step: self.max_rays_per_step as usize,
            learning_rate: mlp.learning_rate,
            learning_rate_decay: mlp.learning_rate_decay,
            schedule: match mlp.schedule {
                RateSchedule::Code => torch_field::Schedule::Epochs { epochs },
                RateSchedule::Paper => torch_field::Schedule::Exponential,
            },
            density_noise_std,
            seed: self.seed,
        }
    }
}

#[cfg(test)]
mod tests {
    use scene::Frustum;
    use stage::Stage as _;

    use super::*;

    fn facts(space: Space, background: Background) -> SceneFacts {
        SceneFacts {
            space,
            background,
            pixels_across: 340.0,
            lr_pixels: 25,
            has_kernel: true,
            is_fine_tuning: false,
        }
    }

    fn ndc() -> Space {
        Space::Ndc(Frustum {
            camera_to_world: [[0.0; 4]; 3],
            min: [0.0; 2],
            max: [1.0; 2],
            near: 1.0,
            far: 2.0,
        })
    }

    fn value(params: &Params, scene: &SceneFacts, name: &str) -> Value {
        params.resolve(scene).record().remove(name).unwrap_or(Value::Null)
    }

    /// A default holds where nothing else is said, for its own field alone.
    #[test]
    fn scenes_decide_defaults() {
        let (grid, mlp) = (
            Params::default(),
            Params { field: FieldParams::Mlp(MlpParams::default()), ..Params::default() },
        );
        let said =
            |field: GridParams| Params { field: FieldParams::Grid(field), ..Params::default() };
        let own = GridParams {
            distortion: Some(0.5),
            march_steps: Some(999),
            finest_z: Some(60),
            order: Order::Epochs,
            ..GridParams::default()
        };
        let forward = facts(ndc(), Background::Opaque);
        let boxed = facts(Space::Box, Background::White);
        let open = facts(Space::Box, Background::Alpha);
        for (params, scene, name, expected) in [
            (&grid, forward, "distortion", json!(0.004)),
            (&grid, forward, "floater_loss", json!(0.0)),
            (&grid, forward, "march_steps", json!(256)),
            (&grid, forward, "finest_z", json!(148)),
            (&grid, forward, "combine", json!("average_weights")),
            (&grid, boxed, "distortion", json!(0.0)),
            (&grid, boxed, "floater_loss", json!(0.001)),
            (&grid, facts(ndc(), Background::White), "distortion", json!(0.0)),
            (&grid, facts(ndc(), Background::White), "floater_loss", json!(0.001)),
            (&grid, facts(Space::Contraction, Background::Opaque), "distortion", json!(0.002)),
            (&grid, facts(Space::Contraction, Background::White), "distortion", json!(0.0)),
            (&grid, facts(Space::Box, Background::Opaque), "distortion", json!(0.0)),
            (&grid, facts(Space::Box, Background::Black), "floater_loss", json!(0.001)),
            (&grid, boxed, "march_steps", json!(512)),
            (&grid, boxed, "finest_z", json!(Architecture::default().finest_z)),
            (&grid, boxed, "max_resolution", json!(870)),
            (&grid, boxed, "log2_hashmap_size", json!(20)),
            (&grid, boxed, "pixel_importance", json!(10.0)),
            (&grid, boxed, "supersample_warmup", json!(0.3)),
            (&grid, boxed, "supervision", json!("kernel")),
            (&grid, boxed, "combine", json!("ensemble")),
            (&grid, open, "supervision", json!("average")),
            (&grid, SceneFacts { has_kernel: false, ..boxed }, "supervision", json!("average")),
            (&grid, SceneFacts { is_fine_tuning: true, ..boxed }, "supersample_warmup", json!(0.0)),
            (&said(own.clone()), forward, "distortion", json!(0.5)),
            (&said(own.clone()), forward, "march_steps", json!(999)),
            (&said(own.clone()), forward, "finest_z", json!(60)),
            (&said(own), forward, "pixel_importance", json!(1.0)),
            (&mlp, forward, "rays", json!(3000)),
            (&mlp, forward, "precrop_steps", json!(0)),
            (&mlp, forward, "density_noise_std", json!(1.0)),
            (&mlp, forward, "distortion", json!(null)),
            (&mlp, forward, "supervision", json!("average")),
            (&mlp, boxed, "rays", json!(2000)),
            (&mlp, boxed, "precrop_steps", json!(1000)),
            (&mlp, boxed, "density_noise_std", json!(0.0)),
            (&mlp, SceneFacts { is_fine_tuning: true, ..boxed }, "precrop_steps", json!(0)),
        ] {
            assert_eq!(value(params, &scene, name), expected, "{name} of {params:?} for {scene:?}");
        }
        let many =
            said(GridParams { march_steps: Some(8192), ..GridParams::default() }).resolve(&forward);
        assert!(matches!(many.field, ResolvedField::Grid { architecture,
                .. } if architecture.check().is_ok()));
    }

    /// `training.json` says every default that `plan` leaves to the scene.
    #[test]
    fn what_is_by_scene_is_recorded() {
        let schema = contract::Schema::new(&crate::TrainSs::describe("", "").parameters).unwrap();
        let scene = facts(Space::Box, Background::White);
        for (name, field) in
            [("grid", FieldParams::default()), ("mlp", FieldParams::Mlp(MlpParams::default()))]
        {
            let recorded = Params { field, ..Params::default() }.resolve(&scene).record();
            let parameters =
                schema.resolve(&json!({ "field": name }).as_object().cloned().unwrap()).unwrap();
            let open = schema.by_scene(&parameters);
            assert!(open.len() > 3, "{open:?}");
            for name in open {
                assert!(recorded.contains_key(name), "{name} isn't recorded");
            }
        }
    }

    fn with_resolutions(base_resolution: u32, max_resolution: Option<u32>) -> Params {
        let grid = GridParams { base_resolution, max_resolution, ..GridParams::default() };
        Params { field: FieldParams::Grid(grid), ..Params::default() }
    }

    #[test]
    fn the_coarsest_level_is_no_finer_than_the_finest() {
        assert_eq!(with_resolutions(64, Some(64)).check(), Ok(()));
        assert_eq!(with_resolutions(64, None).check(), Ok(()));
        let problem = with_resolutions(64, Some(32)).check().unwrap_err();
        assert_eq!(problem, ParamsError::BaseAboveMax { base: 64, max: 32 });
        let words = "parameter base_resolution: 64 is above max_resolution = 32";
        assert_eq!(problem.to_string(), words);
    }

    fn bundles(resolved: &Resolved, supersample_warmup: f64, supersample: f64) -> u64 {
        Resolved { supersample_warmup, supersample, ..resolved.clone() }.precrop_bundles()
    }

    /// However many rays a bundle has at first, as many steps are drawn from the middle.
    #[test]
    fn precrop_steps_are_steps_whatever_is_cast() {
        let resolved = Params::default().resolve(&facts(Space::Box, Background::White));
        let resolved =
            Resolved { precrop_steps: 10, max_rays_per_step: 64, rays: 6400, ..resolved };
        // 16 bundles of 4 rays a step; 64 of one ray; 3 steps of those, 3 with 4 rays and 4 with
        // 16.
        assert_eq!(
            [
                bundles(&resolved, 0.0, 2.0),
                bundles(&resolved, 0.5, 2.0),
                bundles(&resolved, 0.06, 4.0)
            ],
            [160, 640, 3 * 64 + 3 * 16 + 4 * 4]
        );
    }

    /// The fields of an ensemble spend all rays between them, each with a seed of its own.
    #[test]
    fn members_share_the_rays() {
        let all = Params { ensemble: 3, seed: 7, ..Params::default() }
            .resolve(&facts(Space::Box, Background::White));
        let all = Resolved { rays: 100, ..all };
        let members: Vec<(u64, u64)> =
            (0..3).map(|i| all.member(i)).map(|own| (own.rays, own.seed)).collect();
        assert_eq!(members, [(34, 7), (33, 8), (33, 9)]);
    }
}

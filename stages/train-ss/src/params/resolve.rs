use radiance::{Architecture, GivenSizes, Regularisers};
use scene::{Background, Space};
use torch_field::MlpArchitecture;
use workload::RayBudget;

use super::{
    Combine, Exposure, FieldParams, GridParams, MlpParams, Params, Resolved, ResolvedField,
    SceneFacts, Supervision,
};
use crate::supersample::whole_supersample;

/// Epochs of the published training runs of Blender scenes (NeRF-SR).
const EPOCHS: u64 = 20;
/// Epochs of the published training runs of photographs in NDC (NeRF-SR).
const EPOCHS_IN_NDC: u64 = 30;
/// Precrop steps of the published training runs of Blender scenes (design note 022).
const PRECROP_STEPS: u32 = 1000;
/// Standard deviation of the noise on raw densities in published training runs of photographs in
/// NDC (NeRF-SR).
const DENSITY_NOISE_STD_IN_NDC: f64 = 1.0;
/// Fraction of a grid's rays that are cast before each LR pixel gets all of its sub-pixel rays
/// (design note 007).
const SUPERSAMPLE_WARMUP: f64 = 0.3;
/// Weight of the distortion loss with an opaque background in NDC (design note 012).
const DISTORTION_IN_NDC: f64 = 0.004;
/// Weight of the distortion loss with an opaque background in a contraction (design note 012).
const DISTORTION_IN_CONTRACTION: f64 = 0.002;
/// Weight of the floater loss with a background of one colour (design note 013).
const FLOATER_LOSS: f64 = 0.001;

impl Params {
    /// Sets every default for a scene. A fine-tuning ignores `supersample_warmup` and
    /// `precrop_steps`.
    pub fn resolve(&self, scene: &SceneFacts) -> Resolved {
        let rays_per_epoch = scene.lr_pixels * whole_supersample(self.supersample).pow(2);
        let mut settings = match &self.field {
            FieldParams::Grid(grid) => grid.training_settings(self.rays, scene),
            FieldParams::Mlp(mlp) => mlp.training_settings(self.rays, scene, rays_per_epoch),
        };
        settings.supersample_warmup =
            self.supersample_warmup.unwrap_or(settings.supersample_warmup);
        if scene.is_fine_tuning {
            // The initial field already has the scene's rough shape.
            (settings.supersample_warmup, settings.precrop_steps) = (0.0, 0);
        }
        let is_grid = matches!(self.field, FieldParams::Grid(_));
        let supervision = if is_grid && scene.has_kernel && scene.background != Background::Alpha {
            Supervision::Kernel
        } else {
            Supervision::Average
        };
        // While cameras move, measured gains differ even if exposures don't (design note 026).
        let can_measure = is_grid
            && scene.background != Background::Alpha
            && !scene.is_fine_tuning
            && !self.pose_refinement;
        let exposure = if can_measure { Exposure::ByScene } else { Exposure::Off };
        let combine = if scene.is_ndc() { Combine::AverageWeights } else { Combine::Ensemble };
        Resolved {
            field: settings.field,
            supersample: self.supersample,
            supersample_warmup: settings.supersample_warmup,
            supervision: self.supervision.unwrap_or(supervision),
            exposure: self.exposure.map_or(exposure, Exposure::from),
            pose_refinement: self.pose_refinement,
            silhouettes: self.silhouettes && is_grid,
            in_epochs: !is_grid,
            pixel_importance: settings.pixel_importance,
            precrop_steps: settings.precrop_steps,
            ensemble: self.ensemble,
            rays: settings.rays,
            max_rays_per_step: self.max_rays_per_step.unwrap_or(settings.max_rays_per_step),
            learning_rate: self.learning_rate.unwrap_or(settings.learning_rate),
            rays_per_epoch,
            max_references: self.max_references.map_or(usize::MAX, |count| count as usize),
            combine: self.combine.unwrap_or(combine),
            seed: self.seed,
        }
    }
}

/// Settings of a training that depend on the kind of field: given values or defaults.
struct FieldSettings {
    field: ResolvedField,
    rays: u64,
    max_rays_per_step: u32,
    learning_rate: f64,
    pixel_importance: f64,
    supersample_warmup: f64,
    precrop_steps: u32,
}

impl GridParams {
    fn training_settings(&self, rays: Option<u64>, scene: &SceneFacts) -> FieldSettings {
        let budget = RayBudget {
            rays,
            rays_per_pixel: self.rays_per_pixel,
            opaque_ray_factor: self.opaque_ray_factor,
            min_rays: self.min_rays,
            max_rays: self.max_rays,
        };
        let is_opaque = scene.background == Background::Opaque;
        FieldSettings {
            field: ResolvedField::Grid {
                architecture: self.architecture(scene),
                regularisers: self.regularisers(scene),
                given: self.clone(),
            },
            rays: budget.total(scene.lr_pixels, is_opaque, scene.is_fine_tuning),
            // Design note 007.
            max_rays_per_step: 8_192,
            learning_rate: 6e-2,
            pixel_importance: self.pixel_importance,
            supersample_warmup: SUPERSAMPLE_WARMUP,
            precrop_steps: 0,
        }
    }

    fn architecture(&self, scene: &SceneFacts) -> Architecture {
        let given = GivenSizes {
            n_levels: self.n_levels,
            cells_per_pixel: self.cells_per_pixel,
            log2_hashmap_size: self.log2_hashmap_size,
            hidden_dim: self.hidden_dim,
            march_steps: self.march_steps,
        };
        given.for_scene(scene.pixels_across, scene.is_ndc())
    }

    fn regularisers(&self, scene: &SceneFacts) -> Regularisers {
        let distortion = match (scene.background, scene.space) {
            (Background::Opaque, Space::Ndc(_)) => DISTORTION_IN_NDC,
            (Background::Opaque, Space::Contraction) => DISTORTION_IN_CONTRACTION,
            (_, Space::Ndc(_) | Space::Contraction | Space::Box) => 0.0,
        };
        let floater_loss = match scene.background {
            Background::White | Background::Black => FLOATER_LOSS,
            Background::Opaque | Background::Alpha => 0.0,
        };
        Regularisers {
            distortion: self.distortion.unwrap_or(distortion),
            floater_loss: self.floater_loss.unwrap_or(floater_loss),
        }
    }
}

impl MlpParams {
    fn training_settings(
        &self,
        rays: Option<u64>,
        scene: &SceneFacts,
        rays_per_epoch: u64,
    ) -> FieldSettings {
        let (epochs, precrop_steps, density_noise_std) = if scene.is_ndc() {
            (EPOCHS_IN_NDC, 0, DENSITY_NOISE_STD_IN_NDC)
        } else {
            (EPOCHS, PRECROP_STEPS, 0.0)
        };
        let architecture = MlpArchitecture {
            scaled_positions: true,
            layers: self.layers,
            hidden_dim: self.hidden_dim,
            coarse_samples: self.coarse_samples,
            fine_samples: self.fine_samples,
            ..MlpArchitecture::default()
        };
        FieldSettings {
            field: ResolvedField::Mlp { architecture, density_noise_std },
            rays: rays.unwrap_or(epochs * rays_per_epoch),
            // As in the paper's code.
            max_rays_per_step: 2_048,
            learning_rate: 5e-4,
            pixel_importance: 1.0,
            supersample_warmup: 0.0,
            precrop_steps: self.precrop_steps.unwrap_or(precrop_steps),
        }
    }
}

#[cfg(test)]
mod tests {
    use scene::Frustum;
    use serde_json::{Value, json};
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

    /// A default applies only if the parameter is omitted, and only to its own field.
    #[test]
    fn scenes_decide_defaults() {
        let (grid, mlp) = (
            Params::default(),
            Params { field: FieldParams::Mlp(MlpParams::default()), ..Params::default() },
        );
        let with_grid =
            |field: GridParams| Params { field: FieldParams::Grid(field), ..Params::default() };
        let own =
            GridParams { distortion: Some(0.5), march_steps: Some(999), ..GridParams::default() };
        let coarse = with_grid(GridParams { cells_per_pixel: 1.28, ..GridParams::default() });
        let forward = facts(ndc(), Background::Opaque);
        let boxed = facts(Space::Box, Background::White);
        let transparent = facts(Space::Box, Background::Alpha);
        for (params, scene, name, expected) in [
            (&grid, forward, "distortion", json!(0.004)),
            (&grid, forward, "floater_loss", json!(0.0)),
            (&grid, forward, "march_steps", json!(256)),
            (&coarse, forward, "march_steps", json!(91)),
            (&coarse, boxed, "march_steps", json!(256)),
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
            (&grid, boxed, "max_resolution", json!(870)),
            (&grid, boxed, "log2_hashmap_size", json!(20)),
            (&grid, boxed, "supersample_warmup", json!(0.3)),
            (&grid, boxed, "supervision", json!("kernel")),
            (&grid, boxed, "exposure", json!(null)),
            (&grid, transparent, "exposure", json!(false)),
            (&grid, SceneFacts { is_fine_tuning: true, ..boxed }, "exposure", json!(false)),
            (&mlp, boxed, "exposure", json!(false)),
            (&grid, boxed, "combine", json!("ensemble")),
            (&grid, transparent, "supervision", json!("average")),
            (&grid, SceneFacts { has_kernel: false, ..boxed }, "supervision", json!("average")),
            (&grid, SceneFacts { is_fine_tuning: true, ..boxed }, "supersample_warmup", json!(0.0)),
            (&with_grid(own.clone()), forward, "distortion", json!(0.5)),
            (&with_grid(own), forward, "march_steps", json!(999)),
            (&mlp, boxed, "supersample_warmup", json!(0.0)),
            (&mlp, forward, "rays", json!(3000)),
            (&mlp, forward, "precrop_steps", json!(0)),
            (&mlp, forward, "distortion", json!(null)),
            (&mlp, forward, "supervision", json!("average")),
            (&mlp, boxed, "rays", json!(2000)),
            (&mlp, boxed, "precrop_steps", json!(1000)),
            (&mlp, SceneFacts { is_fine_tuning: true, ..boxed }, "precrop_steps", json!(0)),
        ] {
            assert_eq!(value(params, &scene, name), expected, "{name} of {params:?} for {scene:?}");
        }
        let max_steps = with_grid(GridParams { march_steps: Some(8192), ..GridParams::default() })
            .resolve(&forward);
        assert!(matches!(max_steps.field, ResolvedField::Grid { architecture,
                .. } if architecture.check().is_ok()));
    }

    /// `training.json` contains every default that `plan` leaves to the scene.
    #[test]
    fn defaults_by_scene_are_recorded() {
        let schema = stage::Schema::new(&crate::TrainSs::describe("", "").parameters).unwrap();
        let scene = facts(Space::Box, Background::White);
        for (name, field) in
            [("grid", FieldParams::default()), ("mlp", FieldParams::Mlp(MlpParams::default()))]
        {
            let recorded = Params { field, ..Params::default() }.resolve(&scene).record();
            let parameters =
                schema.resolve(&json!({ "field": name }).as_object().cloned().unwrap()).unwrap();
            let by_scene = schema.by_scene(&parameters);
            assert!(by_scene.len() > 3, "{by_scene:?}");
            for name in by_scene {
                assert!(recorded.contains_key(name), "{name} isn't recorded");
            }
        }
    }

    /// Rays follow from LR pixels, unless they are given.
    #[test]
    fn rays_follow_from_the_pixels() {
        // 25 LR pixels.
        let white = facts(Space::Box, Background::White);
        let opaque = facts(Space::Box, Background::Opaque);
        let fine_tuning = SceneFacts { is_fine_tuning: true, ..white };
        for (rays, scene, expected) in [
            (None, white, 500),
            (None, opaque, 300),
            (None, fine_tuning, 250),
            (Some(7000), fine_tuning, 7000),
        ] {
            let grid = GridParams {
                rays_per_pixel: 20.0,
                min_rays: 100,
                max_rays: 1000,
                ..GridParams::default()
            };
            let params = Params { field: FieldParams::Grid(grid), rays, ..Params::default() };
            assert_eq!(value(&params, &scene, "rays"), json!(expected), "{params:?}");
            assert_eq!(params.resolve(&scene).rays, expected);
        }
    }

    fn bundles(resolved: &Resolved, supersample_warmup: f64, supersample: f64) -> u64 {
        Resolved { supersample_warmup, supersample, ..resolved.clone() }.precrop_bundles()
    }

    /// The number of steps drawn from the middle doesn't depend on the number of rays per bundle.
    #[test]
    fn precrop_steps_are_steps_for_any_bundle() {
        let resolved = Params::default().resolve(&facts(Space::Box, Background::White));
        let resolved =
            Resolved { precrop_steps: 10, max_rays_per_step: 64, rays: 6400, ..resolved };
        // 16 bundles of 4 rays a step; 64 of one ray; and 3 steps with one ray per bundle, 3 with 4
        // rays and 4 with 16.
        assert_eq!(
            [
                bundles(&resolved, 0.0, 2.0),
                bundles(&resolved, 0.5, 2.0),
                bundles(&resolved, 0.06, 4.0)
            ],
            [160, 640, 3 * 64 + 3 * 16 + 4 * 4]
        );
    }

    /// The fields of an ensemble share all rays, and each has a seed of its own.
    #[test]
    fn members_share_the_rays() {
        let ensemble = Params { ensemble: 3, seed: 7, ..Params::default() }
            .resolve(&facts(Space::Box, Background::White));
        let ensemble = Resolved { rays: 100, ..ensemble };
        let members: Vec<(u64, u64)> =
            (0..3).map(|i| ensemble.member(i)).map(|member| (member.rays, member.seed)).collect();
        assert_eq!(members, [(34, 7), (33, 8), (33, 9)]);
    }
}

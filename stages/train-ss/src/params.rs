use radiance::{Architecture, MlpArchitecture, TrainingOptions};
use scene::{Background, Space};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::supervision::coarse_stages;
use crate::{Order, Supervision};

/// Parameters of `train-ss`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Which field: ours, or the paper's own (hours on a CPU; with the published settings unless told otherwise).
    pub field: FieldKind,
    /// Sub-rays along each side of an LR pixel, the paper's s; 1 is plain NeRF. It needn't be the scale at which views will be
    /// rendered: few sub-rays leave more of the budget for other pixels. For `kernel`, the HR pixels along each side; where that
    /// isn't whole, sub-rays are cast for the next whole number.
    #[schemars(range(min = 1.0, max = 16.0))]
    pub supersample: f64,
    /// Share of the rays during which fewer sub-rays are cast: one, then two a side and so on, doubling up to `supersample`. Coarse
    /// pixels teach the rough shape from more views in the same time. Without it: 0.3 for `grid`, 0 for `mlp`.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub supersample_warmup: Option<f64>,
    /// What an LR pixel is compared with. Without it: for `grid`, `kernel` where the scene says what made it and has a background;
    /// else `average`.
    pub supervision: Option<Supervision>,
    /// Whether to find, while training, how bright each photograph is against the others (a factor for red, green and blue), for pictures
    /// taken with several exposures or white balances. Views come out in the mean exposure.
    pub exposure: bool,
    /// Whether to move cameras, while training, to where the field's renderings meet their photographs best, for poses that aren't exact. What all
    /// cameras share stays; each field of an `ensemble` finds its own. Test views are then better rendered from where `nerf-sr run registered` finds
    /// them to be taken from.
    pub pose_refinement: bool,
    /// In which order pixels are drawn. Without it: `random` for `grid`, `epochs` for `mlp`.
    pub order: Option<Order>,
    /// How many times as often a pixel with detail around it is drawn as a flat one, in random order. What a pixel teaches weighs less by
    /// as much, so that the expectation stays. Without it: 10 for `grid`, 1 for `mlp`, which goes through all pixels in turn.
    #[schemars(range(min = 1.0, max = 100.0))]
    pub pixel_importance: Option<f64>,
    /// Steps at the start that draw from the middle half of each picture's width and height alone, where something is to be seen.
    /// Without it: 0 for `grid`; 1000 for `mlp`, but 0 in NDC.
    #[schemars(range(min = 0))]
    pub precrop_steps: Option<u32>,
    /// How many fields to train apart, each with its share of the rays: what they render is averaged, and so is what each of them
    /// makes up where the pictures leave it open. Member m is what `seed` + m gives alone.
    #[schemars(range(min = 1, max = 16))]
    pub ensemble: u32,
    /// Rays to train with, sub-rays counted each, over all members. Without it: 30 million for `grid`; for `mlp` as many as 20 epochs
    /// have, or 30 in NDC.
    #[schemars(range(min = 1))]
    pub rays: Option<u64>,
    /// Most rays in a step. Without it: 4,096 for `grid`, 2,048 for `mlp`.
    #[schemars(range(min = 1, max = 1_048_576))]
    pub max_rays_per_step: Option<u32>,
    /// `grid`: samples a step aims at while space is full of fog and rays are expensive.
    #[schemars(range(min = 1024, max = 16_777_216))]
    pub samples_per_step: u32,
    /// Highest learning rate; of the grid's coarsest level. Without it: 0.04 for `grid`, 0.0005 for `mlp`.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub learning_rate: Option<f64>,
    /// `grid`: learning rate of a level over that of the next coarser one: below 1 what is coarse explains the pictures first.
    #[schemars(range(min = 0.01, max = 2.0))]
    pub level_rate: f64,
    /// `grid`: highest learning rate of the networks.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub mlp_learning_rate: f64,
    /// Learning rates at the end, as a share of the highest. Without it: 0.25 for `grid`, 0.01 for `mlp`.
    #[schemars(range(min = 1e-6, max = 1.0))]
    pub learning_rate_decay: Option<f64>,
    /// `mlp`: how the learning rate falls. (`grid`'s falls exponentially.) A training shorter than the published one goes through the same
    /// schedule in fewer steps.
    pub schedule: RateSchedule,
    /// `grid`: share that the weights' running average keeps at each of its steps, late in the training; 0 for the last weights.
    #[schemars(range(min = 0.0, max = 0.999))]
    pub ema_decay: f64,
    /// `grid`: weight of the distortion loss, which draws what stops a ray together: less haze and fewer samples. Without it: 0.004
    /// in NDC with nothing behind the scene (an opaque background), which else becomes fog; 0 elsewhere, where it costs detail.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub distortion: Option<f64>,
    /// `grid`: weight of the haze loss, the opacity of what has the background's colour and doesn't hide the background: before that colour no picture
    /// tells whether it is there, and from elsewhere it hides the scene. Without it: 0.001 before white or black, 0 before what has no colour of its own.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub floater_loss: Option<f64>,
    /// `grid`: weight decay of the networks.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub network_decay: f64,
    /// `grid`: levels of the grid.
    #[schemars(range(min = 1, max = 16))]
    pub n_levels: u32,
    /// `grid`: cells along an axis of the coarsest level.
    #[schemars(range(min = 2, max = 512))]
    pub base_resolution: u32,
    /// `grid`: cells along an axis of the finest level. Without it: 2.56 for every LR pixel across the field, at least `base_resolution`.
    #[schemars(range(min = 2, max = 4096))]
    pub max_resolution: Option<u32>,
    /// `grid`: cells along z at most, of any level. Without it: 148 of 256 `march_steps` in NDC, where rays run along z and cells needn't lie closer than
    /// their samples; no limit elsewhere.
    #[schemars(range(min = 2, max = 4096))]
    pub finest_z: Option<u32>,
    /// `grid`: base-2 logarithm of the most entries in a level. Without it: 17 for 256 cells along the finest level's axis, and two more
    /// for every doubling of those, since surfaces grow with the square.
    #[schemars(range(min = 8, max = 22))]
    pub log2_hashmap_size: Option<u32>,
    /// Width of the networks' hidden layers. Without it: 64 for `grid`, 256 for `mlp`.
    #[schemars(range(min = 2, max = 1024))]
    pub hidden_dim: Option<u32>,
    /// `grid`: samples along the diagonal of the scene's cube. Without it: 512, and 256 in NDC, where every ray crosses the whole cube and
    /// meets as many surfaces with half of them.
    #[schemars(range(min = 16, max = 8192))]
    pub march_steps: Option<u32>,
    /// `mlp`: octaves of the positions' encoding.
    #[schemars(range(min = 0, max = 16))]
    pub position_frequencies: u32,
    /// `mlp`: octaves of the directions' encoding.
    #[schemars(range(min = 0, max = 16))]
    pub direction_frequencies: u32,
    /// `mlp` in NDC: colours depend on the ray's direction there, as in the reference's code, instead of on its direction in the world.
    pub ndc_directions: bool,
    /// `mlp`: layers before density and colour part.
    #[schemars(range(min = 1, max = 32))]
    pub layers: u32,
    /// `mlp`: samples of the coarse network along a ray.
    #[schemars(range(min = 4, max = 4096))]
    pub coarse_samples: u32,
    /// `mlp`: samples that the fine network has besides those.
    #[schemars(range(min = 1, max = 4096))]
    pub fine_samples: u32,
    /// `mlp`: standard deviation of the noise on raw densities. Without it: 0, and 1 in NDC.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub density_noise_std: Option<f64>,
    /// `mlp`: how often a network that has collapsed (to the background, or to a wall before every camera) may start over, with the next seed.
    #[schemars(range(min = 0, max = 100))]
    pub restarts: u32,
    /// At most so many of the references given, the first. Without it: all.
    pub max_references: Option<u32>,
    /// How the initial field (input `init`) and the fine-tuned one are used. Without it: `average_weights` in NDC, where all cameras see the same and
    /// both are as good; `ensemble` elsewhere, where what one reference teaches says nothing of a scene's other sides.
    pub combine: Option<Combine>,
    /// Seed of everything that is drawn.
    pub seed: u64,
}

impl Default for Params {
    fn default() -> Self {
        let (grid, mlp) = (Architecture::default(), MlpArchitecture::default());
        Self {
            field: FieldKind::Grid,
            supersample: 2.0,
            supersample_warmup: None,
            supervision: None,
            exposure: false,
            pose_refinement: false,
            order: None,
            pixel_importance: None,
            precrop_steps: None,
            ensemble: 1,
            rays: None,
            max_rays_per_step: None,
            samples_per_step: 65_536,
            learning_rate: None,
            level_rate: 0.8,
            mlp_learning_rate: 1e-2,
            learning_rate_decay: None,
            schedule: RateSchedule::Code,
            ema_decay: 0.97,
            distortion: None,
            floater_loss: None,
            network_decay: 1e-6,
            n_levels: grid.levels,
            base_resolution: grid.coarsest,
            max_resolution: None,
            finest_z: None,
            log2_hashmap_size: None,
            hidden_dim: None,
            march_steps: None,
            position_frequencies: mlp.position_octaves,
            direction_frequencies: mlp.direction_octaves,
            ndc_directions: mlp.ndc_directions,
            layers: mlp.depth,
            coarse_samples: mlp.coarse_samples,
            fine_samples: mlp.fine_samples,
            density_noise_std: None,
            restarts: 0,
            max_references: None,
            combine: None,
            seed: 0,
        }
    }
}

/// The kinds of field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FieldKind {
    /// Multi-resolution grid with small MLPs.
    Grid,
    /// The paper's own two MLPs, through libtorch.
    Mlp,
}

/// How the initial and the fine-tuned field are used: what either makes up where images leave it open evens out, and little is
/// lost of what the initial one knew.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Combine {
    /// The mean of their weights is kept (Wortsman et al. 2022, "Robust fine-tuning"): one field to render.
    AverageWeights,
    /// Their rendered images are averaged: better, and as slow as two fields.
    Ensemble,
}

/// How the paper's learning rate falls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum RateSchedule {
    /// As the reference's code does it: by epochs, flat until the last ten.
    Code,
    /// As the paper's text has it: exponentially throughout.
    Paper,
}

/// Epochs of the published trainings: for Blender's scenes, and for photographs in NDC.
const EPOCHS: u64 = 20;
const EPOCHS_IN_NDC: u64 = 30;
/// Weight of the distortion loss in NDC with nothing behind the scene.
const DISTORTION_IN_NDC: f64 = 0.004;
/// Weight of the haze loss before a background that has one colour.
const HAZE: f64 = 0.001;

impl Params {
    /// Fails on parameters that can't be meant together.
    pub fn check(&self) -> Result<(), String> {
        if let Some(finest) = self.max_resolution.filter(|f| *f < self.base_resolution) {
            return Err(format!("parameter base_resolution: {} is above max_resolution = {finest}", self.base_resolution));
        }
        if self.field == FieldKind::Grid && self.hidden_dim.is_some_and(|h| !(16..=128).contains(&h)) {
            return Err("parameter hidden_dim: the grid's networks are 16 to 128 wide".to_owned());
        }
        if self.order() == Order::Epochs && self.pixel_importance.is_some_and(|d| d > 1.0) {
            return Err("parameter pixel_importance: an epoch goes through all pixels evenly; choose order random".to_owned());
        }
        // What belongs to the other field would be silently without effect.
        let default = Self::default();
        let foreign: &[(&str, bool)] = match self.field {
            FieldKind::Grid => &[
                ("schedule", self.schedule != default.schedule),
                ("position_frequencies", self.position_frequencies != default.position_frequencies),
                ("direction_frequencies", self.direction_frequencies != default.direction_frequencies),
                ("ndc_directions", self.ndc_directions != default.ndc_directions),
                ("layers", self.layers != default.layers),
                ("coarse_samples", self.coarse_samples != default.coarse_samples),
                ("fine_samples", self.fine_samples != default.fine_samples),
                ("density_noise_std", self.density_noise_std != default.density_noise_std),
                ("restarts", self.restarts != default.restarts),
            ],
            FieldKind::Mlp => &[
                ("samples_per_step", self.samples_per_step != default.samples_per_step),
                ("level_rate", self.level_rate != default.level_rate),
                ("mlp_learning_rate", self.mlp_learning_rate != default.mlp_learning_rate),
                ("ema_decay", self.ema_decay != default.ema_decay),
                ("distortion", self.distortion != default.distortion),
                ("floater_loss", self.floater_loss != default.floater_loss),
                ("network_decay", self.network_decay != default.network_decay),
                ("n_levels", self.n_levels != default.n_levels),
                ("base_resolution", self.base_resolution != default.base_resolution),
                ("max_resolution", self.max_resolution != default.max_resolution),
                ("finest_z", self.finest_z != default.finest_z),
                ("log2_hashmap_size", self.log2_hashmap_size != default.log2_hashmap_size),
                ("march_steps", self.march_steps != default.march_steps),
            ],
        };
        match foreign.iter().find(|(_, given)| *given) {
            Some((name, _)) => {
                Err(format!("parameter {name}: it belongs to the other field; leave it out, or choose that field"))
            }
            None => Ok(()),
        }
    }

    /// With what suits a scene where nothing else is said: the paper's field is trained otherwise on photographs in NDC, as published, and a grid
    /// is kept from becoming fog, there and before one colour. `epoch` counts the rays of all pixels.
    pub fn suited(&self, space: &Space, background: Background, epoch: u64) -> Self {
        match self.field {
            FieldKind::Mlp if matches!(space, Space::Ndc(_)) => Self {
                rays: self.rays.or(Some(EPOCHS_IN_NDC * epoch)),
                precrop_steps: self.precrop_steps.or(Some(0)),
                density_noise_std: self.density_noise_std.or(Some(1.0)),
                ..self.clone()
            },
            FieldKind::Grid if matches!(space, Space::Ndc(_)) && background == Background::Opaque => {
                Self { distortion: self.distortion.or(Some(DISTORTION_IN_NDC)), ..self.clone() }
            }
            FieldKind::Grid if matches!(background, Background::White | Background::Black) => {
                Self { floater_loss: self.floater_loss.or(Some(HAZE)), ..self.clone() }
            }
            _ => self.clone(),
        }
    }

    /// How the initial and the fine-tuned field are used.
    pub fn combine(&self, space: &Space) -> Combine {
        self.combine.unwrap_or(if matches!(space, Space::Ndc(_)) { Combine::AverageWeights } else { Combine::Ensemble })
    }

    /// How to go on from a field that the same parameters gave: its rough shape is known.
    pub fn going_on(&self) -> Self {
        Self { supersample_warmup: Some(0.0), precrop_steps: Some(0), ..self.clone() }
    }

    /// What is said for a field, or that field's own default.
    fn or<T>(&self, given: Option<T>, grid: T, mlp: T) -> T {
        given.unwrap_or(match self.field {
            FieldKind::Grid => grid,
            FieldKind::Mlp => mlp,
        })
    }

    /// Share of the rays with fewer sub-rays.
    pub fn supersample_warmup(&self) -> f64 {
        self.or(self.supersample_warmup, 0.3, 0.0)
    }

    /// Order of the pixels.
    pub fn order(&self) -> Order {
        self.or(self.order, Order::Random, Order::Epochs)
    }

    /// Most rays in a step.
    pub fn max_rays_per_step(&self) -> u32 {
        self.or(self.max_rays_per_step, 4_096, 2_048)
    }

    /// How much more often what has detail is drawn.
    pub fn pixel_importance(&self) -> f64 {
        if self.order() == Order::Epochs { 1.0 } else { self.or(self.pixel_importance, 10.0, 1.0) }
    }

    /// Sub-rays along each side of an LR pixel, once all are cast.
    pub fn side(&self) -> u64 {
        (self.supersample - 1e-6).ceil() as u64
    }

    /// Groups of rays that are drawn from the middle of the pictures: those of the first `precrop_steps` steps, where the training has so many
    /// rays.
    pub fn crop_groups(&self, rays: u64) -> u64 {
        let (batch, side) = (u64::from(self.max_rays_per_step()), self.side());
        let doublings = coarse_stages(side);
        let steps_of_stage = (self.supersample_warmup() * rays as f64 / f64::from(doublings.max(1))) as u64 / batch;
        let stages = (0..doublings).map(|i| (steps_of_stage, 1 << i)).chain([(u64::MAX, side)]);
        let mut left = u64::from(self.or(self.precrop_steps, 0, 1000));
        let groups = stages.map(|(steps, side): (u64, u64)| {
            let steps = steps.min(left);
            left -= steps;
            steps * (batch / (side * side)).max(1)
        });
        groups.sum()
    }

    /// Rays over all members, where an epoch has so many.
    pub fn rays(&self, epoch: u64) -> u64 {
        self.or(self.rays, 30_000_000, EPOCHS * epoch)
    }

    /// What grid they ask for in a space, with so many LR pixels across its cube.
    pub fn grid(&self, pixels: f64, space: &Space) -> Architecture {
        let by_width = (2.56 * pixels).round().clamp(64.0, 2048.0) as u32;
        let finest = self.max_resolution.unwrap_or(by_width.max(self.base_resolution));
        let by_finest = (17.0 + 2.0 * (f64::from(finest) / 256.0).log2()).round().clamp(14.0, 20.0) as u32;
        let is_ndc = matches!(space, Space::Ndc(_));
        let steps = self.march_steps.unwrap_or(if is_ndc { 256 } else { 512 });
        // There rays run along z: cells needn't lie closer than their samples.
        let unlimited = Architecture::default().finest_z;
        let by_steps = (f64::from(steps) / 3.0f64.sqrt()).round() as u32;
        let finest_z = if is_ndc { by_steps.min(unlimited) } else { unlimited };
        Architecture {
            levels: self.n_levels,
            coarsest: self.base_resolution,
            finest,
            finest_z: self.finest_z.unwrap_or(finest_z),
            log2_entries: self.log2_hashmap_size.unwrap_or(by_finest),
            hidden: self.or(self.hidden_dim, Architecture::default().hidden, 256),
            steps,
        }
    }

    /// What paper's field they ask for.
    pub fn mlp(&self) -> MlpArchitecture {
        MlpArchitecture {
            position_octaves: self.position_frequencies,
            direction_octaves: self.direction_frequencies,
            ndc_directions: self.ndc_directions,
            depth: self.layers,
            width: self.or(self.hidden_dim, 64, MlpArchitecture::default().width),
            coarse_samples: self.coarse_samples,
            fine_samples: self.fine_samples,
        }
    }

    /// How they ask for a grid to be trained, with so many rays.
    pub fn grid_training(&self, rays: u64) -> TrainingOptions {
        TrainingOptions {
            rays,
            batch: self.max_rays_per_step() as usize,
            samples: self.samples_per_step as usize,
            rate: self.or(self.learning_rate, 4e-2, 5e-4),
            level_rate: self.level_rate,
            network_rate: self.mlp_learning_rate,
            final_rate: self.or(self.learning_rate_decay, 0.25, 0.01),
            warm_up: 100,
            averaging: self.ema_decay as f32,
            distortion: self.distortion.unwrap_or(0.0) as f32,
            haze: self.floater_loss.unwrap_or(0.0) as f32,
            network_decay: self.network_decay as f32,
            seed: self.seed,
        }
    }

    /// How they ask for the paper's field to be trained, with so many rays, where an epoch has so many.
    #[cfg(feature = "torch")]
    pub fn mlp_training(&self, rays: u64, epoch: u64) -> torch_field::MlpTraining {
        let epochs = rays.div_ceil(epoch.max(1));
        torch_field::MlpTraining {
            rays,
            batch: self.max_rays_per_step() as usize,
            rate: self.or(self.learning_rate, 4e-2, 5e-4),
            final_rate: self.or(self.learning_rate_decay, 0.25, 0.01),
            schedule: match self.schedule {
                RateSchedule::Code => torch_field::Schedule::Epochs { epochs },
                RateSchedule::Paper => torch_field::Schedule::Exponential,
            },
            noise: self.density_noise_std.unwrap_or(0.0),
            seed: self.seed,
        }
    }

    /// Parameters by which a member is trained as if it were alone, with its share of the rays.
    pub fn member(&self, index: u32, rays: u64) -> Self {
        let members = u64::from(self.ensemble.max(1));
        let own = rays / members + u64::from(u64::from(index) < rays % members);
        Self { ensemble: 1, rays: Some(own), seed: self.seed.wrapping_add(u64::from(index)), ..self.clone() }
    }
}

#[cfg(test)]
mod tests {
    use scene::Frustum;

    use super::*;

    /// What suits a scene holds where nothing else is said, for that field alone: the published ones for photographs in NDC, and a
    /// loss against fog there.
    #[test]
    fn scenes_have_settings_of_their_own() {
        let ndc = Space::Ndc(Frustum { camera_to_world: [[0.0; 4]; 3], min: [0.0; 2], max: [1.0; 2], near: 1.0, far: 2.0 });
        let mlp = Params { field: FieldKind::Mlp, ..Params::default() };
        let there = mlp.suited(&ndc, Background::Opaque, 100);
        assert_eq!(
            (there.rays(100), there.crop_groups(3000), there.density_noise_std, there.distortion),
            (3000, 0, Some(1.0), None)
        );
        let here = mlp.suited(&Space::Box, Background::White, 100);
        assert_eq!((here.rays(100), here.crop_groups(2000), here.density_noise_std), (2000, 512_000, None));
        let said = Params { rays: Some(7), density_noise_std: Some(0.0), precrop_steps: Some(1), ..mlp };
        assert_eq!(said.suited(&ndc, Background::Opaque, 100), said);

        let grid = Params::default();
        assert!(grid.suited(&ndc, Background::Opaque, 100).distortion > Some(0.0));
        for (space, background) in [(&Space::Box, Background::Alpha), (&Space::Contraction, Background::Opaque)] {
            assert_eq!(grid.suited(space, background, 100), grid);
        }
        for (space, background) in [(&ndc, Background::White), (&Space::Box, Background::Black)] {
            let suited = grid.suited(space, background, 100);
            assert!(suited.floater_loss > Some(0.0) && Params { floater_loss: None, ..suited } == grid);
        }
        // No more cells along z there than there are samples.
        let cells = |params: &Params, space: &Space| params.grid(340.0, space).finest_z;
        assert_eq!((cells(&grid, &ndc), cells(&grid, &Space::Box)), (148, Architecture::default().finest_z));
        assert_eq!(cells(&Params { finest_z: Some(60), march_steps: Some(999), ..grid.clone() }, &ndc), 60);
        assert!(Params { march_steps: Some(8192), ..grid.clone() }.grid(340.0, &ndc).check().is_ok());
        let said = Params { distortion: Some(0.0), ..grid };
        assert_eq!(said.suited(&ndc, Background::Opaque, 100), said);
    }

    /// However many rays a group has at first, as many steps are drawn from the middle.
    #[test]
    fn crop_steps_are_steps_whatever_is_cast() {
        let params = Params { precrop_steps: Some(10), max_rays_per_step: Some(64), ..Params::default() };
        let crop =
            |coarse, side| Params { supersample_warmup: Some(coarse), supersample: side, ..params.clone() }.crop_groups(6400);
        // 16 groups of 4 rays a step; 64 of one ray; 3 steps of those, 3 with 4 rays and 4 with 16.
        assert_eq!([crop(0.0, 2.0), crop(0.5, 2.0), crop(0.06, 4.0)], [160, 640, 3 * 64 + 3 * 16 + 4 * 4]);
    }
}

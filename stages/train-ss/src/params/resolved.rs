use std::collections::BTreeMap;

use fields::FieldModel;
use radiance::{Architecture, Regularisers, TrainingOptions};
use serde_json::{Value, json};
use torch_field::MlpArchitecture;

use super::{Combine, GridParams, Supervision};
use crate::supersample::{warmup_doublings, whole_supersample};

/// Steps over which a grid's learning rates rise to their maximum; chosen by hand.
const LEARNING_RATE_WARMUP_STEPS: u64 = 100;
/// Gradient norm, relative to the mean, below which gradients go through Russian roulette (design
/// note 037).
const ROULETTE: f32 = 0.25;
/// Ratio of the MLPs' final learning rate to the initial one (NeRF-SR's code).
#[cfg(feature = "torch")]
const MLP_LEARNING_RATE_DECAY: f64 = 0.01;

/// Parameters with every default set.
#[derive(Clone, Debug, PartialEq)]
pub struct Resolved {
    /// Field and the parameters of that kind of field.
    pub field: ResolvedField,
    /// Sub-pixel rays along each side of an LR pixel.
    pub supersample: f64,
    /// Fraction of the rays that are cast before each LR pixel gets all of its sub-pixel rays.
    pub supersample_warmup: f64,
    /// Comparison of an LR pixel with its rays.
    pub supervision: Supervision,
    /// Estimation of exposures.
    pub exposure: Exposure,
    /// True if camera poses are optimised.
    pub pose_refinement: bool,
    /// True if photographs with alpha limit the cells of the grid.
    pub silhouettes: bool,
    /// True if each pixel is drawn once per epoch, as in the paper's code; if false, pixels are
    /// drawn independently.
    pub in_epochs: bool,
    /// Ratio of the draw rates of detailed and flat pixels.
    pub pixel_importance: f64,
    /// Number of steps that draw pixels only from the middle of the images.
    pub precrop_steps: u32,
    /// Number of independently trained fields.
    pub ensemble: u32,
    /// Number of rays over all fields of the ensemble.
    pub rays: u64,
    /// Maximum number of rays in a step.
    pub max_rays_per_step: u32,
    /// Highest learning rate.
    pub learning_rate: f64,
    /// Number of rays in an epoch: one through every sub-pixel of every view.
    pub rays_per_epoch: u64,
    /// Maximum number of HR references.
    pub max_references: usize,
    /// Combination of the initial with the fine-tuned field.
    pub combine: Combine,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// Estimation of exposures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exposure {
    /// Gains are 1.
    Off,
    /// Gains are estimated.
    On,
    /// Gains are measured in the first part of the training, and estimated if they differ.
    ByScene,
}

impl From<bool> for Exposure {
    fn from(is_estimated: bool) -> Self {
        if is_estimated { Self::On } else { Self::Off }
    }
}

/// Field with every default set.
#[derive(Clone, Debug, PartialEq)]
pub enum ResolvedField {
    /// Hash grid.
    Grid {
        /// Shape of the grid and its MLPs.
        architecture: Architecture,
        /// Weights of the regularisers.
        regularisers: Regularisers,
        /// Parameters as given.
        given: GridParams,
    },
    /// The paper's MLPs.
    Mlp {
        /// Shape of the MLPs.
        architecture: MlpArchitecture,
        /// Standard deviation of the noise on raw densities.
        density_noise_std: f64,
    },
}

impl Resolved {
    /// Returns the resolved values of the parameters whose defaults depend on the scene, by name,
    /// for `training.json`.
    pub fn record(&self) -> BTreeMap<String, Value> {
        let common = json!({
            "combine": self.combine,
            "exposure": match self.exposure {
                Exposure::Off => Some(false),
                Exposure::On => Some(true),
                // Known after the first part of the training.
                Exposure::ByScene => None,
            },
            "learning_rate": self.learning_rate,
            "max_rays_per_step": self.max_rays_per_step,
            "rays": self.rays,
            "supersample_warmup": self.supersample_warmup,
            "supervision": self.supervision,
        });
        let own = match &self.field {
            ResolvedField::Grid { architecture, regularisers, .. } => json!({
                "distortion": regularisers.distortion,
                "floater_loss": regularisers.floater_loss,
                "log2_hashmap_size": architecture.log2_hashmap_size,
                "march_steps": architecture.march_steps,
                "max_resolution": architecture.max_resolution,
            }),
            ResolvedField::Mlp { .. } => json!({ "precrop_steps": self.precrop_steps }),
        };
        let entries = [common, own].into_iter().filter_map(|values| values.as_object().cloned());
        entries.flatten().collect()
    }

    /// Returns the kind of field with its architecture.
    pub fn model(&self) -> FieldModel {
        match &self.field {
            ResolvedField::Grid { architecture, .. } => FieldModel::Grid(*architecture),
            ResolvedField::Mlp { architecture, .. } => FieldModel::Mlp(*architecture),
        }
    }

    /// Returns the parameters of one field of the ensemble: as if trained alone, with its part of
    /// the rays.
    #[must_use]
    pub fn member(&self, index: u32) -> Self {
        let members = u64::from(self.ensemble.max(1));
        let has_extra_ray = u64::from(index) < self.rays % members;
        Self {
            ensemble: 1,
            rays: self.rays / members + u64::from(has_extra_ray),
            seed: self.seed.wrapping_add(u64::from(index)),
            ..self.clone()
        }
    }

    /// Returns the number of rays, at first, while each LR pixel has one ray and later has several.
    pub fn single_rays(&self) -> f64 {
        match warmup_doublings(whole_supersample(self.supersample)) {
            0 => 0.0,
            doublings => self.supersample_warmup * self.rays as f64 / f64::from(doublings),
        }
    }

    /// Returns the number of bundles (the rays of one LR pixel) in the first `precrop_steps` steps,
    /// which are drawn from the middle of the images.
    pub fn precrop_bundles(&self) -> u64 {
        let batch = u64::from(self.max_rays_per_step);
        let supersample = whole_supersample(self.supersample);
        let doublings = warmup_doublings(supersample);
        let stage_steps = self.single_rays() as u64 / batch;
        let warmup = (0..doublings).map(|doubling| (stage_steps, 1 << doubling));
        let mut steps_left = u64::from(self.precrop_steps);
        let mut bundles = 0;
        for (steps, supersample) in warmup.chain([(u64::MAX, supersample)]) {
            let steps = steps_left.min(steps);
            steps_left -= steps;
            bundles += steps * (batch / (supersample * supersample)).max(1);
        }
        bundles
    }

    /// Returns the training options of a grid.
    pub fn grid_training(&self, grid: &GridParams, regularisers: Regularisers) -> TrainingOptions {
        TrainingOptions {
            rays: self.rays,
            max_rays_per_step: self.max_rays_per_step as usize,
            samples_per_step: grid.samples_per_step as usize,
            learning_rate: self.learning_rate,
            mlp_learning_rate: grid.mlp_learning_rate,
            learning_rate_decay: grid.learning_rate_decay,
            warm_up: LEARNING_RATE_WARMUP_STEPS,
            ema_decay: grid.ema_decay as f32,
            regularisers,
            roulette: ROULETTE,
            seed: self.seed,
        }
    }

    /// Returns the training options of the paper's MLPs.
    #[cfg(feature = "torch")]
    pub fn mlp_training(&self, density_noise_std: f64) -> torch_field::MlpTraining {
        torch_field::MlpTraining {
            rays: self.rays,
            max_rays_per_step: self.max_rays_per_step as usize,
            learning_rate: self.learning_rate,
            learning_rate_decay: MLP_LEARNING_RATE_DECAY,
            epochs: self.rays.div_ceil(self.rays_per_epoch.max(1)),
            density_noise_std,
            seed: self.seed,
        }
    }
}

use numerics::uniform;

use crate::chunk::Roulette;
use crate::ray::Ray;
use crate::regularisers::Regularisers;
use crate::trainer::PhaseClock;
use crate::training_state::TrainingState;

/// Training steps per update of the averaged weights; chosen by hand.
const AVERAGE_INTERVAL_STEPS: u64 = 4;
/// Fraction of the rays after which weights are averaged (docs/design/007).
const AVERAGE_START: f64 = 0.7;

/// Samples of the last step divided by those of the first (docs/design/037): small steps find the
/// shape early, large ones have less noise.
const STEP_GROWTH: f64 = 8.0 / 3.0;

/// Minimum number of rays per step, even if `max_rays_per_step` is smaller; chosen by hand.
const MIN_RAYS_PER_STEP: usize = 256;

/// Ratio of a level's learning rate to that of the next coarser level; chosen by hand.
const LEVEL_RATE_RATIO: f64 = 0.8;
/// Weight decay of the networks; chosen by hand.
pub const NETWORK_DECAY: f32 = 1e-6;

/// Options of a training run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainingOptions {
    /// Number of rays of the whole training run.
    pub rays: u64,
    /// Maximum number of rays per step; at least 256 are used.
    pub max_rays_per_step: usize,
    /// Target number of samples of the first step; the last step has 8/3 times as many. While space
    /// is full of semi-transparent density, steps have fewer rays.
    pub samples_per_step: usize,
    /// Maximum learning rate of the grid's coarsest level.
    pub learning_rate: f64,
    /// Maximum learning rate of the MLPs.
    pub mlp_learning_rate: f64,
    /// Final learning rate divided by the maximum.
    pub learning_rate_decay: f64,
    /// Number of steps of linear warm-up.
    pub warm_up: u64,
    /// Decay of the weights' exponential moving average per update; 0 disables the average.
    pub ema_decay: f32,
    /// Weights of the losses other than the colour error.
    pub regularisers: Regularisers,
    /// Threshold of Russian roulette, as a multiple of the mean gradient norm in a chunk; 0
    /// propagates all gradients. A sample whose gradient norm is a fraction f < 1 of the threshold
    /// propagates its gradient with probability f, divided by f, so the expected gradient is
    /// unchanged.
    pub roulette: f32,
    /// Seed of all random numbers.
    pub seed: u64,
}

impl TrainingOptions {
    /// Returns the target number of rays of a step.
    pub fn rays_of_step(&self, state: &TrainingState) -> usize {
        let growth = libm::pow(STEP_GROWTH, state.progress(self.rays));
        // Rays may have no samples; the limit is chosen by hand.
        let rays = self.samples_per_step as f64 * growth / state.samples_per_ray.max(0.1);
        (rays as usize).clamp(MIN_RAYS_PER_STEP, self.max_rays_per_step.max(MIN_RAYS_PER_STEP))
    }

    /// Returns the factor of all learning rates in a step: linear warm-up, then exponential decay.
    pub fn learning_rate_factor(&self, state: &TrainingState) -> f64 {
        let warm = ((state.steps + 1) as f64 / self.warm_up.max(1) as f64).min(1.0);
        state.learning_rate_scale
            * warm
            * libm::pow(self.learning_rate_decay, state.progress(self.rays))
    }

    /// Returns the fraction of a step by which a ray's samples are shifted. `ray` counts from 0
    /// over the whole training.
    pub fn offset(&self, ray: u64) -> f32 {
        // Streams 1 to 3 belong to the field's initialisation and the occupancy grid.
        uniform(self.seed, 4, ray)
    }

    /// Returns the roulette of a chunk, seeded by the index of its first ray.
    pub(super) fn roulette(&self, ray: u64) -> Roulette {
        Roulette { limit: self.roulette, draw: uniform(self.seed, 5, ray) }
    }

    /// Returns the learning rate of a level, given [`TrainingOptions::learning_rate_factor`].
    pub fn rate_of_level(&self, level: usize, factor: f64) -> f64 {
        self.learning_rate * factor * LEVEL_RATE_RATIO.powi(level as i32)
    }

    /// Returns whether the averaged weights are updated after this step.
    pub fn is_averaging_step(&self, state: &TrainingState) -> bool {
        self.ema_decay > 0.0
            && state.progress(self.rays) > AVERAGE_START
            && state.steps.is_multiple_of(AVERAGE_INTERVAL_STEPS)
    }
}

/// Source of training rays, and loss function of their colours. Rays come in bundles, each with one
/// loss: the s×s sub-pixel rays of an LR pixel are a pixel bundle.
pub trait Supervisor: Sync {
    /// Sets the fraction of the training's rays that have been cast. Called before every step; the
    /// size of a bundle may depend on nothing but this fraction.
    fn set_progress(&mut self, _progress: f64) {}
    /// Returns the number of rays per bundle in this step.
    fn rays_per_bundle(&self) -> usize;
    /// Casts the rays of a bundle. `bundle` counts from 0 over the whole training; random numbers
    /// may depend on nothing but `bundle`.
    fn sample_rays(&self, bundle: u64, rays: &mut [Ray]);
    /// Returns the bundle's mean squared error, given its rays' colours, and writes the gradient of
    /// the loss with respect to each colour. The training's PSNR is that of the error.
    fn loss_and_gradient(
        &self,
        bundle: u64,
        colours: &[[f32; 3]],
        gradients: &mut [[f32; 3]],
    ) -> f64;
    /// Stores a step's rendered colours. Called after each step that was applied, with all bundles
    /// in order. Parallel tasks must be run by [`PhaseClock::task`], which measures them.
    fn record_colours(&mut self, _rendered: &[RenderedBundles<'_>], _clock: &PhaseClock) {}
}

/// Rendered colours of consecutive bundles.
#[derive(Clone, Copy, Debug)]
pub struct RenderedBundles<'a> {
    /// Number of the first bundle.
    pub first_bundle: u64,
    /// Colour of each ray, bundle by bundle.
    pub colours: &'a [[f32; 3]],
}

impl<'a> RenderedBundles<'a> {
    /// Returns each bundle's number and colours.
    pub fn bundles(&self, rays_per_bundle: usize) -> impl Iterator<Item = (u64, &'a [[f32; 3]])> {
        (self.first_bundle..).zip(self.colours.chunks_exact(rays_per_bundle))
    }
}

use counter_rng::uniform;

use crate::chunk::Roulette;
use crate::regularisers::Regularisers;
use crate::tally::Tally;

/// Steps between those of the weights' average, and the share of the rays after which it begins.
const AVERAGE_EVERY: u64 = 4;
const AVERAGE_FROM: f64 = 0.7;

/// Samples of the last step over those of the first. Small steps find the shape early; later,
/// larger steps have less noise.
const STEP_GROWTH: f64 = 8.0 / 3.0;

/// How to train.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainingOptions {
    /// Rays in all.
    pub rays: u64,
    /// Most rays in a step.
    pub max_rays_per_step: usize,
    /// Samples that the first steps aim at; the last steps aim at 8/3 times as many. While space is
    /// full of semi-transparent density, steps have fewer rays.
    pub samples_per_step: usize,
    /// Learning rate of the grid's coarsest level at its highest.
    pub learning_rate: f64,
    /// Learning rate of a level over that of the next coarser one.
    pub level_rate: f64,
    /// Learning rate of the MLPs at its highest.
    pub mlp_learning_rate: f64,
    /// Learning rate at the end, as a share of the highest.
    pub learning_rate_decay: f64,
    /// Steps of linear warm-up.
    pub warm_up: u64,
    /// Share that the weights' exponential moving average keeps at each of its steps; 0 for no
    /// average.
    pub ema_decay: f32,
    /// What is asked of rays beside their colours.
    pub regularisers: Regularisers,
    /// Weight decay of the networks.
    pub network_decay: f32,
    /// Samples whose gradient is shorter than so many times the mean of those around go back to the
    /// grid at random, as often as their share of it says and lengthened by as much (Russian
    /// roulette): the expected gradient stays. 0 takes all back.
    pub roulette: f32,
    /// Seed of everything that is drawn.
    pub seed: u64,
}

impl TrainingOptions {
    /// Rays in a step, where a ray had so many samples in the one before.
    pub fn rays_of_step(&self, tally: &Tally, samples_per_ray: f64) -> usize {
        let samples = self.samples_per_step as f64 * libm::pow(STEP_GROWTH, tally.done(self.rays));
        let wanted = (samples / samples_per_ray.max(0.1)) as usize;
        wanted.clamp(256, self.max_rays_per_step.max(256))
    }

    /// What learning rates are multiplied with in a step: they rise at first, and fall
    /// exponentially.
    pub fn schedule(&self, tally: &Tally) -> f64 {
        let warm = ((tally.steps + 1) as f64 / self.warm_up.max(1) as f64).min(1.0);
        tally.rate_scale * warm * libm::pow(self.learning_rate_decay, tally.done(self.rays))
    }

    /// Share of a step by which the samples of a ray are shifted, by its number in the training.
    pub fn offset(&self, ray: u64) -> f32 {
        uniform(self.seed, 4, ray)
    }

    /// The draw of a chunk, by the number of its first ray.
    pub(super) fn roulette(&self, ray: u64) -> Roulette {
        Roulette { limit: self.roulette, draw: uniform(self.seed, 5, ray) }
    }

    /// Learning rate of a level, for a schedule.
    pub fn rate_of_level(&self, level: usize, schedule: f64) -> f64 {
        self.learning_rate * schedule * self.level_rate.powi(level as i32)
    }

    /// Whether weights go into their average now.
    pub fn averages(&self, tally: &Tally) -> bool {
        self.ema_decay > 0.0
            && tally.done(self.rays) > AVERAGE_FROM
            && tally.steps.is_multiple_of(AVERAGE_EVERY)
    }
}

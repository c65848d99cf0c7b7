use std::path::Path;

use nets::Adam;
use radiance::{StepReport, Supervision, Tally};
use rayon::prelude::*;
use tch::{Device, Kind, TchError, Tensor, no_grad};

use crate::mlp::{Batch, Mlp, SampleDraws};
use crate::step::Step;
use crate::{Schedule, TorchFieldError};

/// How to train an [`Mlp`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MlpTraining {
    /// Rays in all.
    pub rays: u64,
    /// Rays in a step, sub-rays counted each.
    pub batch: usize,
    /// Learning rate at the start.
    pub rate: f64,
    /// Learning rate at the end, as a share of that.
    pub final_rate: f64,
    /// How it gets there.
    pub schedule: Schedule,
    /// Standard deviation of what is added to raw densities.
    pub noise: f64,
    /// Seed of what is drawn.
    pub seed: u64,
}

/// Trains an [`Mlp`] by Adam (Kingma and Ba 2015, with PyTorch's defaults) on the loss of both networks.
pub struct MlpTrainer {
    field: Mlp,
    options: MlpTraining,
    adam: Adam,
    tally: Tally,
    /// Steps in a row in which a network stopped next to no light.
    dark_steps: u64,
}

/// Shards of a step on the CPU: by its rays alone, so that sums have one order at any thread count. Where a shard has few rays, libtorch's calls
/// cost more than what they compute.
fn shards(rays: usize) -> usize {
    const MOST: usize = 8;
    const RAYS: usize = 16;
    rays.div_ceil(RAYS).clamp(1, MOST)
}

/// Samples that go through the fine network at once: few, so that what they leave on their way stays in the cache, and enough to be worth
/// a call.
const CHUNK_SAMPLES: usize = 4096;
/// Steps with less opacity than this, so many in a row, are a collapse: the white background alone explains the pictures, and ReLU
/// has no gradient there.
const DARK_OPACITY: f64 = 1e-3;
const DARK_STEPS: u64 = 200;

/// What a piece of a step leaves.
struct Piece {
    gradients: Vec<Tensor>,
    colours: Vec<[f32; 3]>,
    loss: f64,
    /// Sum of the rays' opacities, by the coarse and the fine network.
    opacity: [f64; 2],
}

impl MlpTrainer {
    /// Starts from a field.
    pub fn new(field: Mlp, options: MlpTraining) -> Result<Self, TorchFieldError> {
        let adam = Adam::new(field.parameters())?;
        Ok(Self { field, options, adam, tally: Tally::default(), dark_steps: 0 })
    }

    /// The field as it is now.
    pub fn field(&self) -> &Mlp {
        &self.field
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.tally.steps
    }

    /// Rays cast so far.
    pub fn rays_done(&self) -> u64 {
        self.tally.rays
    }

    /// Takes a step; `None` once all rays are spent.
    pub fn step(&mut self, supervision: &mut impl Supervision) -> Result<Option<StepReport>, TorchFieldError> {
        let done = self.tally.done(self.options.rays);
        supervision.begin(done);
        let group = supervision.rays_per_group();
        let Some(groups) = self.tally.groups_of_step(self.options.rays, self.options.batch, group) else { return Ok(None) };
        let step = Step::new(&self.tally, groups, group);
        let pieces = self.pieces(&*supervision, step)?;
        let loss = pieces.iter().map(|p| p.loss).sum::<f64>() / groups as f64;
        let rays = groups * group;
        let opacity = [0, 1].map(|i| pieces.iter().map(|p| p.opacity[i]).sum::<f64>() / rays as f64);
        self.tally.cast(groups, group);
        let mut gradients = Vec::new();
        let mut colours = Vec::with_capacity(pieces.len());
        for piece in pieces {
            colours.push(piece.colours);
            if gradients.is_empty() {
                gradients = piece.gradients;
            } else {
                no_grad(|| gradients.iter_mut().zip(&piece.gradients).try_for_each(|(sum, g)| sum.f_add_(g).map(drop)))?;
            }
        }
        let skipped = !loss.is_finite() || !nets::all_finite(&gradients)?;
        if skipped {
            if !self.tally.forgives() {
                return Err(TorchFieldError::NotFinite { step: self.tally.steps });
            }
        } else {
            self.take(&gradients, done)?;
            step.remember(supervision, colours.iter().map(Vec::as_slice));
        }
        self.tally.steps += 1;
        self.dark_steps = if opacity.iter().any(|&o| o < DARK_OPACITY) { self.dark_steps + 1 } else { 0 };
        if self.dark_steps >= DARK_STEPS {
            let network = if opacity[0] < DARK_OPACITY { "coarse" } else { "fine" };
            return Err(TorchFieldError::Collapsed { step: self.tally.steps, network });
        }
        let samples = rays * (2 * self.field.architecture.coarse_samples + self.field.architecture.fine_samples) as usize;
        Ok(Some(StepReport { loss, rays, samples, skipped }))
    }

    /// Forward and backward: on the CPU in shards, in parallel; on a GPU in as few pieces as its memory allows.
    fn pieces(&self, supervision: &impl Supervision, step: Step) -> Result<Vec<Piece>, TorchFieldError> {
        let plan = Plan { step, seed: self.options.seed, noise: self.options.noise };
        if self.field.device != Device::Cpu {
            return step.in_pieces(|range| plan.run(&self.field, supervision, range));
        }
        let (groups, count) = (step.groups, shards(step.groups * step.group));
        let shards: Vec<(Mlp, std::ops::Range<usize>)> =
            (0..count).map(|i| (self.field.share(), groups * i / count..groups * (i + 1) / count)).collect();
        let pieces: Result<Vec<Option<Piece>>, TchError> =
            shards.into_par_iter().map(|(field, range)| plan.run_all(&field, supervision, range)).collect();
        Ok(pieces?.into_iter().flatten().collect())
    }

    /// Moves the parameters.
    pub(crate) fn take(&mut self, gradients: &[Tensor], done: f64) -> Result<(), TchError> {
        let rate = self.tally.rate_scale * self.options.schedule.rate(self.options.rate, self.options.final_rate, done);
        self.adam.step(self.field.parameters(), gradients, rate)
    }

    /// Writes all that a resumed training needs. The caller makes it atomic.
    pub fn write_checkpoint(&self, path: &Path) -> Result<(), TorchFieldError> {
        let [steps, groups, rays, scale, fault] = self.tally.counters();
        Ok(self.adam.write_checkpoint(path, self.field.named(), &[steps, groups, rays, scale, fault, self.dark_steps])?)
    }

    /// The step a checkpoint was written at.
    pub fn checkpoint_step(path: &Path) -> Result<u64, TorchFieldError> {
        let [steps, ..] = Adam::counts_of_checkpoint::<6>(path)?;
        Ok(steps)
    }

    /// Goes on from a checkpoint of a trainer made with the same field and options.
    pub fn resume(&mut self, path: &Path) -> Result<(), TorchFieldError> {
        let (adam, [tally @ .., dark_steps]): (Adam, [u64; 6]) = Adam::resume(path, &self.field.named())?;
        (self.adam, self.tally, self.dark_steps) = (adam, Tally::from_counters(tally), dark_steps);
        Ok(())
    }
}

/// What a piece of a step needs to know of the whole.
#[derive(Clone, Copy)]
struct Plan {
    step: Step,
    seed: u64,
    noise: f64,
}

impl Plan {
    /// A shard in chunks, one after the other.
    fn run_all(
        self,
        field: &Mlp,
        supervision: &impl Supervision,
        range: std::ops::Range<usize>,
    ) -> Result<Option<Piece>, TchError> {
        let samples = (field.architecture.coarse_samples + field.architecture.fine_samples) as usize;
        let chunk = (CHUNK_SAMPLES / (samples * self.step.group)).max(1);
        let mut whole: Option<Piece> = None;
        for start in range.clone().step_by(chunk) {
            let piece = self.run(field, supervision, start..(start + chunk).min(range.end))?;
            whole = Some(match whole {
                None => piece,
                Some(mut sum) => {
                    for (sum, g) in sum.gradients.iter_mut().zip(&piece.gradients) {
                        let _ = sum.f_add_(g)?;
                    }
                    sum.colours.extend(piece.colours);
                    sum.loss += piece.loss;
                    (0..2).for_each(|i| sum.opacity[i] += piece.opacity[i]);
                    sum
                }
            });
        }
        Ok(whole)
    }

    /// Some groups forward and back, at once.
    fn run(self, field: &Mlp, supervision: &impl Supervision, range: std::ops::Range<usize>) -> Result<Piece, TchError> {
        let rays = self.step.cast(supervision, &range);
        let draws = SampleDraws::new(field, self.seed, self.step.first_ray(&range), rays.len(), self.noise)?;
        let seen = field.see(&Batch::new(&rays, field)?, Some(&draws))?;
        let coarse = self.step.judge(supervision, &range, &seen.coarse.colour)?;
        let fine = self.step.judge(supervision, &range, &seen.fine.colour)?;
        let parameters: Vec<Tensor> = field.parameters().collect();
        let gradients = Tensor::f_run_backward(&[coarse.towards.f_add(&fine.towards)?], &parameters, false, false)?;
        let opacity = |weights: &Tensor| -> Result<f64, TchError> { weights.f_sum(Kind::Double)?.f_double_value(&[]) };
        let opacity = [opacity(&seen.coarse.weights)?, opacity(&seen.fine.weights)?];
        Ok(Piece { gradients, colours: fine.colours, loss: coarse.loss + fine.loss, opacity })
    }
}

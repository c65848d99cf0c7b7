use std::path::Path;

use nets::Adam;
use radiance::{Ray, StepReport, Supervision};
use rayon::prelude::*;
use tch::{Device, Kind, TchError, Tensor, no_grad};

use crate::mlp::{Batch, Mlp, SampleDraws, host};
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
    step: u64,
    groups: u64,
    rays: u64,
    rate_scale: f64,
    last_fault: Option<u64>,
    /// Steps in a row in which a network stopped next to no light.
    dark_steps: u64,
}

/// Shards of a step on the CPU: fixed, so that sums have one order at any thread count.
const SHARDS: usize = 8;
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
        Ok(Self { field, options, adam, step: 0, groups: 0, rays: 0, rate_scale: 1.0, last_fault: None, dark_steps: 0 })
    }

    /// The field as it is now.
    pub fn field(&self) -> &Mlp {
        &self.field
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// Rays cast so far.
    pub fn rays_done(&self) -> u64 {
        self.rays
    }

    /// Takes a step; `None` once all rays are spent.
    pub fn step(&mut self, supervision: &mut impl Supervision) -> Result<Option<StepReport>, TorchFieldError> {
        let done = self.rays as f64 / self.options.rays.max(1) as f64;
        supervision.begin(done.min(1.0));
        let group = supervision.rays_per_group();
        let left = self.options.rays.saturating_sub(self.rays) as usize / group;
        if left == 0 {
            return Ok(None);
        }
        let groups = (self.options.batch / group).clamp(1, left);
        let pieces = self.pieces(&*supervision, groups, group)?;
        let loss = pieces.iter().map(|p| p.loss).sum::<f64>() / groups as f64;
        let rays = groups * group;
        let opacity = [0, 1].map(|i| pieces.iter().map(|p| p.opacity[i]).sum::<f64>() / rays as f64);
        let first_group = self.groups;
        self.groups += groups as u64;
        self.rays += rays as u64;
        let mut gradients = Vec::new();
        let mut colours = Vec::with_capacity(rays);
        for piece in pieces {
            colours.extend(piece.colours);
            if gradients.is_empty() {
                gradients = piece.gradients;
            } else {
                no_grad(|| gradients.iter_mut().zip(&piece.gradients).try_for_each(|(sum, g)| sum.f_add_(g).map(drop)))?;
            }
        }
        let skipped = !loss.is_finite() || !nets::all_finite(&gradients)?;
        if skipped {
            if self.last_fault.is_some_and(|before| self.step - before < 100) {
                return Err(TorchFieldError::NotFinite { step: self.step });
            }
            self.last_fault = Some(self.step);
            self.rate_scale *= 0.5;
        } else {
            self.take(&gradients, done)?;
            (first_group..).zip(colours.chunks_exact(group)).for_each(|(group, colours)| supervision.remember(group, colours));
        }
        self.step += 1;
        self.dark_steps = if opacity.iter().any(|&o| o < DARK_OPACITY) { self.dark_steps + 1 } else { 0 };
        if self.dark_steps >= DARK_STEPS {
            let network = if opacity[0] < DARK_OPACITY { "coarse" } else { "fine" };
            return Err(TorchFieldError::Collapsed { step: self.step, network });
        }
        let samples = rays * (2 * self.field.architecture.coarse_samples + self.field.architecture.fine_samples) as usize;
        Ok(Some(StepReport { loss, rays, samples, skipped }))
    }

    /// Forward and backward: on the CPU in shards, in parallel; on a GPU in as few pieces as its memory allows.
    fn pieces(&self, supervision: &impl Supervision, groups: usize, group: usize) -> Result<Vec<Piece>, TorchFieldError> {
        if self.field.device == Device::Cpu {
            let shards: Vec<(Mlp, std::ops::Range<usize>)> =
                (0..SHARDS).map(|i| (self.field.share(), groups * i / SHARDS..groups * (i + 1) / SHARDS)).collect();
            let plan = self.plan(groups);
            let pieces: Result<Vec<Option<Piece>>, TchError> =
                shards.into_par_iter().map(|(field, range)| plan.run_all(&field, supervision, range, group)).collect();
            return Ok(pieces?.into_iter().flatten().collect());
        }
        let (mut pieces, mut next, mut size) = (Vec::new(), 0, groups);
        while next < groups {
            let range = next..(next + size).min(groups);
            match self.plan(groups).run(&self.field, supervision, range.clone(), group) {
                Ok(piece) => {
                    pieces.push(piece);
                    next = range.end;
                }
                Err(error) if size > 1 && nets::is_out_of_memory(&error) => size = size.div_ceil(2),
                Err(error) => return Err(error.into()),
            }
        }
        Ok(pieces)
    }

    fn plan(&self, groups: usize) -> Plan {
        let MlpTraining { seed, noise, .. } = self.options;
        Plan { first_group: self.groups, first_ray: self.rays, groups, seed, noise }
    }

    /// Moves the parameters.
    pub(crate) fn take(&mut self, gradients: &[Tensor], done: f64) -> Result<(), TchError> {
        let rate = self.rate_scale * self.options.schedule.rate(self.options.rate, self.options.final_rate, done);
        self.adam.step(self.field.parameters(), gradients, rate)
    }

    /// Writes all that a resumed training needs. The caller makes it atomic.
    pub fn write_checkpoint(&self, path: &Path) -> Result<(), TorchFieldError> {
        let fault = self.last_fault.map_or(-1, |s| s as i64);
        let counts = [self.step, self.adam.updates(), self.groups, self.rays, self.rate_scale.to_bits(), self.dark_steps];
        let counters: Vec<i64> = counts.iter().map(|&c| c as i64).chain([fault]).collect();
        let mut tensors = self.field.named();
        let names: Vec<String> = tensors.iter().map(|(name, _)| name.clone()).collect();
        tensors.extend(self.adam.named(&names));
        tensors.push((COUNTERS.to_owned(), Tensor::f_from_slice(&counters)?));
        nets::write(path, &tensors)?;
        Ok(())
    }

    /// The step a checkpoint was written at.
    pub fn checkpoint_step(path: &Path) -> Result<u64, TorchFieldError> {
        let counters = nets::Weights::read(path)?.integers(COUNTERS, 7)?;
        Ok(counters[0] as u64)
    }

    /// Goes on from a checkpoint of a trainer made with the same field and options.
    pub fn resume(&mut self, path: &Path) -> Result<(), TorchFieldError> {
        let weights = nets::Weights::read(path)?;
        let counters = weights.integers(COUNTERS, 7)?;
        let named = self.field.named();
        let device = self.field.device;
        let shapes: Vec<(String, Vec<i64>)> = named.iter().map(|(name, like)| (name.clone(), like.size())).collect();
        let read = |(name, shape): &(String, Vec<i64>)| weights.tensor(name, shape);
        let parameters = shapes.iter().map(read).collect::<Result<Vec<_>, _>>()?;
        let adam = Adam::read(&weights, &shapes, counters[1] as u64, device)?;
        no_grad(|| self.field.parameters().zip(&parameters).try_for_each(|(mut to, from)| to.f_copy_(from).map(drop)))?;
        self.adam = adam;
        let count = |i: usize| counters[i] as u64;
        (self.step, self.groups, self.rays) = (count(0), count(2), count(3));
        (self.rate_scale, self.dark_steps) = (f64::from_bits(count(4)), count(5));
        self.last_fault = u64::try_from(counters[6]).ok();
        Ok(())
    }
}

/// Name of a checkpoint's counters.
const COUNTERS: &str = "counters";

/// What a piece of a step needs to know of the whole.
#[derive(Clone, Copy)]
struct Plan {
    first_group: u64,
    first_ray: u64,
    groups: usize,
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
        group: usize,
    ) -> Result<Option<Piece>, TchError> {
        let samples = (field.architecture.coarse_samples + field.architecture.fine_samples) as usize;
        let chunk = (CHUNK_SAMPLES / (samples * group)).max(1);
        let mut whole: Option<Piece> = None;
        for start in range.clone().step_by(chunk) {
            let piece = self.run(field, supervision, start..(start + chunk).min(range.end), group)?;
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
    fn run(
        self,
        field: &Mlp,
        supervision: &impl Supervision,
        range: std::ops::Range<usize>,
        group: usize,
    ) -> Result<Piece, TchError> {
        let mut rays = vec![Ray::default(); range.len() * group];
        for (g, rays) in range.clone().zip(rays.chunks_exact_mut(group)) {
            supervision.cast(self.first_group + g as u64, rays);
        }
        let first = self.first_ray + (range.start * group) as u64;
        let draws = SampleDraws::new(field, self.seed, first, rays.len(), self.noise)?;
        let seen = field.see(&Batch::new(&rays, field.device)?, Some(&draws))?;
        let mut loss = 0.0;
        let mut judged = Vec::new();
        let mut colours = Vec::new();
        for colour in [&seen.coarse.colour, &seen.fine.colour] {
            colours = host(colour)?.as_chunks::<3>().0.to_vec();
            let mut gradients = vec![[0.0f32; 3]; colours.len()];
            for (g, (colours, gradients)) in range.clone().zip(colours.chunks_exact(group).zip(gradients.chunks_exact_mut(group)))
            {
                loss += supervision.judge(self.first_group + g as u64, colours, gradients);
            }
            let scaled: Vec<f32> = gradients.as_flattened().iter().map(|g| g / self.groups as f32).collect();
            let gradients = Tensor::f_from_slice(&scaled)?.f_reshape([colours.len() as i64, 3])?.f_to_device(field.device)?;
            judged.push(colour.f_mul(&gradients)?.f_sum(None::<Kind>)?);
        }
        let parameters: Vec<Tensor> = field.parameters().collect();
        let gradients = Tensor::f_run_backward(&[judged[0].f_add(&judged[1])?], &parameters, false, false)?;
        let opacity = |weights: &Tensor| -> Result<f64, TchError> { weights.f_sum(Kind::Double)?.f_double_value(&[]) };
        let opacity = [opacity(&seen.coarse.weights)?, opacity(&seen.fine.weights)?];
        Ok(Piece { gradients, colours, loss, opacity })
    }
}

use std::path::Path;

use nets::Adam;
use radiance::{StepReport, Supervisor, Tally};
use rayon::prelude::*;
use tch::{Device, Kind, TchError, Tensor, no_grad};

use crate::error::TorchFieldError;
use crate::mlp::{Batch, Mlp, SampleDraws};
use crate::schedule::Schedule;
use crate::step::Step;

/// How to train an [`Mlp`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MlpTraining {
    /// Rays in all.
    pub rays: u64,
    /// Most rays in a step, sub-pixel rays counted each.
    pub max_rays_per_step: usize,
    /// Learning rate at the start.
    pub learning_rate: f64,
    /// Learning rate at the end, as a share of that.
    pub learning_rate_decay: f64,
    /// How it gets there.
    pub schedule: Schedule,
    /// Standard deviation of what is added to raw densities.
    pub density_noise_std: f64,
    /// Seed of what is drawn.
    pub seed: u64,
}

/// Trains an [`Mlp`] by Adam (Kingma and Ba 2015, with PyTorch's defaults) on the loss of both
/// networks.
pub struct MlpTrainer {
    field: Mlp,
    options: MlpTraining,
    adam: Adam,
    tally: Tally,
    /// Steps in a row in which a network was stuck.
    stuck_steps: u64,
}

/// Shards of a step on the CPU: by its rays alone, so that sums have one order at any thread count.
/// Where a shard has few rays, libtorch's calls cost more than what they compute.
fn shards(rays: usize) -> usize {
    const MOST_SHARDS: usize = 8;
    const RAYS_PER_SHARD: usize = 16;
    rays.div_ceil(RAYS_PER_SHARD).clamp(1, MOST_SHARDS)
}

/// Samples that go through the fine network at once: few, so that what they leave on their way
/// stays in the cache, and enough to be worth a call.
const CHUNK_SAMPLES: usize = 4096;
/// So many steps in a row in which a network is stuck are a collapse: no gradient leads out of it.
const STUCK_STEPS: u64 = 200;
/// Less of the light than this stopped by all samples: the background alone explains the images,
/// and ReLU has no gradient there.
const LEAST_STOPPED_SHARE: f64 = 1e-3;
/// More of the light than this stopped by the first sample: what is left is of rays whose second
/// happens to be drawn close to it, and what lies behind gets no gradient.
const MOST_FIRST_STOPPED_SHARE: f64 = 0.9;

/// What a network makes of a step's rays, all together.
#[derive(Clone, Copy, Default)]
struct StoppedLight {
    /// Light that is stopped.
    all: f64,
    /// Light that the first sample stops.
    first: f64,
}

impl StoppedLight {
    fn by(weights: &Tensor) -> Result<Self, TchError> {
        let sum = |of: &Tensor| of.f_sum(Kind::Double)?.f_double_value(&[]);
        Ok(Self { all: sum(weights)?, first: sum(&weights.f_narrow(1, 0, 1)?)? })
    }

    fn add(self, other: Self) -> Self {
        Self { all: self.all + other.all, first: self.first + other.first }
    }

    /// Why nothing more is learnt, if that is so for as many rays.
    fn stuck(self, rays: f64) -> Option<&'static str> {
        match self {
            Self { all, .. } if all < LEAST_STOPPED_SHARE * rays => {
                Some("it sees nothing but the background, and its ReLU passes no gradient")
            }
            Self { first, .. } if first > MOST_FIRST_STOPPED_SHARE * rays => {
                Some("it sees a wall right before every camera, and nothing behind it")
            }
            _ => None,
        }
    }
}

/// What a piece of a step leaves.
struct MlpPiece {
    gradients: Vec<Tensor>,
    colours: Vec<[f32; 3]>,
    loss: f64,
    /// By the coarse and the fine network.
    stopped: [StoppedLight; 2],
}

impl MlpTrainer {
    /// Starts from a field.
    pub fn new(field: Mlp, options: MlpTraining) -> Result<Self, TorchFieldError> {
        let adam = Adam::new(field.parameters())?;
        Ok(Self { field, options, adam, tally: Tally::default(), stuck_steps: 0 })
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
    pub fn step(
        &mut self,
        supervision: &mut impl Supervisor,
    ) -> Result<Option<StepReport>, TorchFieldError> {
        let done = self.tally.done(self.options.rays);
        supervision.set_progress(done);
        let bundle = supervision.rays_per_bundle();
        let Some(bundles) =
            self.tally.bundles_of_step(self.options.rays, self.options.max_rays_per_step, bundle)
        else {
            return Ok(None);
        };
        let step = Step::new(&self.tally, bundles, bundle);
        let pieces = self.pieces(&*supervision, step)?;
        let loss = pieces.iter().map(|p| p.loss).sum::<f64>() / bundles as f64;
        let rays = bundles * bundle;
        let stopped = [0, 1].map(|i| {
            pieces.iter().map(|p| p.stopped[i]).fold(StoppedLight::default(), StoppedLight::add)
        });
        self.tally.count(bundles, bundle);
        let mut gradients = Vec::new();
        let mut colours = Vec::with_capacity(pieces.len());
        for piece in pieces {
            colours.push(piece.colours);
            if gradients.is_empty() {
                gradients = piece.gradients;
            } else {
                no_grad(|| {
                    gradients
                        .iter_mut()
                        .zip(&piece.gradients)
                        .try_for_each(|(sum, g)| sum.f_add_(g).map(drop))
                })?;
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
        let stuck = ["coarse", "fine"]
            .into_iter()
            .zip(stopped)
            .find_map(|(n, s)| Some((n, s.stuck(rays as f64)?)));
        self.stuck_steps = if stuck.is_some() { self.stuck_steps + 1 } else { 0 };
        if let Some((network, why)) = stuck.filter(|_| self.stuck_steps >= STUCK_STEPS) {
            return Err(TorchFieldError::Collapsed { step: self.tally.steps, network, why });
        }
        let samples = rays
            * (2 * self.field.architecture.coarse_samples + self.field.architecture.fine_samples)
                as usize;
        Ok(Some(StepReport { loss, rays, samples, skipped }))
    }

    /// Forward and backward: on the CPU in shards, in parallel; on a GPU in as few pieces as its
    /// memory allows.
    fn pieces(
        &self,
        supervision: &impl Supervisor,
        step: Step,
    ) -> Result<Vec<MlpPiece>, TorchFieldError> {
        let plan =
            StepContext { step, seed: self.options.seed, noise: self.options.density_noise_std };
        if self.field.device != Device::Cpu {
            return step.in_pieces(|range| plan.run(&self.field, supervision, range));
        }
        let (bundles, count) = (step.bundles, shards(step.bundles * step.bundle));
        let shards: Vec<(Mlp, std::ops::Range<usize>)> = (0..count)
            .map(|i| (self.field.share(), bundles * i / count..bundles * (i + 1) / count))
            .collect();
        let pieces: Result<Vec<Option<MlpPiece>>, TchError> = shards
            .into_par_iter()
            .map(|(field, range)| plan.run_all(&field, supervision, range))
            .collect();
        Ok(pieces?.into_iter().flatten().collect())
    }

    /// Moves the parameters.
    pub(crate) fn take(&mut self, gradients: &[Tensor], done: f64) -> Result<(), TchError> {
        let rate = self.tally.rate_scale
            * self.options.schedule.rate(
                self.options.learning_rate,
                self.options.learning_rate_decay,
                done,
            );
        self.adam.step(self.field.parameters(), gradients, rate)
    }

    /// Writes all that a resumed training needs. The caller makes it atomic.
    pub fn write_checkpoint(&self, path: &Path) -> Result<(), TorchFieldError> {
        let [steps, bundles, rays, scale, fault] = self.tally.counters();
        Ok(self.adam.write_checkpoint(
            path,
            self.field.named(),
            &[steps, bundles, rays, scale, fault, self.stuck_steps],
        )?)
    }

    /// The step a checkpoint was written at.
    pub fn checkpoint_step(path: &Path) -> Result<u64, TorchFieldError> {
        let [steps, ..] = Adam::counts_of_checkpoint::<6>(path)?;
        Ok(steps)
    }

    /// Goes on from a checkpoint of a trainer made with the same field and options.
    pub fn resume(&mut self, path: &Path) -> Result<(), TorchFieldError> {
        let (adam, [tally @ .., stuck_steps]): (Adam, [u64; 6]) =
            Adam::resume(path, &self.field.named())?;
        (self.adam, self.tally, self.stuck_steps) =
            (adam, Tally::from_counters(tally), stuck_steps);
        Ok(())
    }
}

/// What a piece of a step needs to know of the whole.
#[derive(Clone, Copy)]
struct StepContext {
    step: Step,
    seed: u64,
    noise: f64,
}

impl StepContext {
    /// A shard in chunks, one after the other.
    fn run_all(
        self,
        field: &Mlp,
        supervision: &impl Supervisor,
        range: std::ops::Range<usize>,
    ) -> Result<Option<MlpPiece>, TchError> {
        let samples =
            (field.architecture.coarse_samples + field.architecture.fine_samples) as usize;
        let chunk = (CHUNK_SAMPLES / (samples * self.step.bundle)).max(1);
        let mut whole: Option<MlpPiece> = None;
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
                    (0..2).for_each(|i| sum.stopped[i] = sum.stopped[i].add(piece.stopped[i]));
                    sum
                }
            });
        }
        Ok(whole)
    }

    /// Some bundles forward and back, at once.
    fn run(
        self,
        field: &Mlp,
        supervision: &impl Supervisor,
        range: std::ops::Range<usize>,
    ) -> Result<MlpPiece, TchError> {
        let rays = self.step.sample_rays(supervision, &range);
        let draws = SampleDraws::new(
            field,
            self.seed,
            self.step.first_ray(&range),
            rays.len(),
            self.noise,
        )?;
        let seen = field.see(&Batch::new(&rays, field)?, Some(&draws))?;
        let coarse = self.step.loss_and_gradient(supervision, &range, &seen.coarse.colour)?;
        let fine = self.step.loss_and_gradient(supervision, &range, &seen.fine.colour)?;
        let parameters: Vec<Tensor> = field.parameters().collect();
        let gradients = Tensor::f_run_backward(
            &[coarse.towards.f_add(&fine.towards)?],
            &parameters,
            false,
            false,
        )?;
        let stopped =
            [StoppedLight::by(&seen.coarse.weights)?, StoppedLight::by(&seen.fine.weights)?];
        Ok(MlpPiece { gradients, colours: fine.colours, loss: coarse.loss + fine.loss, stopped })
    }
}

#[cfg(test)]
mod tests {
    use radiance::{MlpArchitecture, Ray};
    use scene::Bounds;

    use super::*;
    use crate::network::MlpNetwork;

    /// Rays side by side, every other of which should be dark.
    struct Stripes;

    impl Supervisor for Stripes {
        fn rays_per_bundle(&self) -> usize {
            1
        }

        fn sample_rays(&self, bundle: u64, rays: &mut [Ray]) {
            let across = 0.2 * (bundle % 4) as f64;
            rays[0] = Ray {
                origin: [across, 0.0, 4.0],
                direction: [0.0, 0.0, -1.0],
                background: [1.0; 3],
            };
        }

        fn loss_and_gradient(
            &self,
            bundle: u64,
            colours: &[[f32; 3]],
            gradients: &mut [[f32; 3]],
        ) -> f64 {
            let off = colours[0].map(|x| x - (bundle % 2) as f32);
            gradients[0] = off.map(|x| 2.0 * x);
            off.iter().map(|&x| f64::from(x * x)).sum()
        }
    }

    /// How a training ends of which one network's raw densities are shifted, if not well.
    fn collapse(network: fn(&Mlp) -> &MlpNetwork, shift: f64) -> Option<String> {
        let architecture = MlpArchitecture {
            depth: 5,
            width: 16,
            coarse_samples: 16,
            fine_samples: 8,
            ..MlpArchitecture::default()
        };
        let bounds =
            Bounds { min: [-2.0; 3], max: [2.0; 3], near: 2.0, far: 6.0, ..Bounds::default() };
        let options = MlpTraining {
            rays: 8 * 250,
            max_rays_per_step: 8,
            learning_rate: 5e-4,
            learning_rate_decay: 0.1,
            schedule: Schedule::Exponential,
            density_noise_std: 0.0,
            seed: 0,
        };
        let raw_density = MlpNetwork::layers(&architecture)
            .iter()
            .position(|(name, ..)| name == "sigma")
            .unwrap();
        let field = Mlp::new(architecture, bounds, 1, Device::Cpu).unwrap();
        let _ = no_grad(|| {
            network(&field).parameters[2 * raw_density + 1].shallow_clone().f_add_scalar_(shift)
        })
        .unwrap();
        let mut trainer = MlpTrainer::new(field, options).unwrap();
        loop {
            match trainer.step(&mut Stripes) {
                Ok(Some(_)) => {}
                Ok(None) => return None,
                Err(error) => return Some(error.to_string()),
            }
        }
    }

    /// Whatever keeps a network from learning is told: nothing stops the light, or all of it is
    /// stopped at once. A sound field goes on.
    #[test]
    fn collapses_are_told() {
        assert_eq!(collapse(|f| &f.fine, 0.5), None);
        for (network, shift, said) in [
            (
                (|f| &f.coarse) as fn(&Mlp) -> &MlpNetwork,
                -300.0,
                "the coarse network has collapsed: it sees nothing but the background",
            ),
            (
                |f| &f.fine,
                300.0,
                "the fine network has collapsed: it sees a wall right before every camera",
            ),
        ] {
            let error = collapse(network, shift).expect("a collapse");
            assert!(error.contains("step 200") && error.contains(said), "{error}");
        }
    }
}

use std::ops::Range;
use std::path::Path;

use nets::Adam;
use radiance::{PhaseClock, Step, StepReport, Supervisor, TrainingState};
use rayon::prelude::*;
use tch::{Device, Kind, TchError, Tensor};

use crate::architecture::MlpArchitecture;
use crate::error::TorchFieldError;
use crate::mlp::{Batch, Mlp, SampleDraws};
use crate::step::{learning_rate, loss_of_bundles, run_in_pieces};

/// Options for training an [`Mlp`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MlpTraining {
    /// Total number of rays.
    pub rays: u64,
    /// Maximum number of rays in a step, counting every sub-pixel ray.
    pub max_rays_per_step: usize,
    /// Learning rate at the start.
    pub learning_rate: f64,
    /// Final learning rate as a fraction of the initial one.
    pub learning_rate_decay: f64,
    /// Number of epochs.
    pub epochs: u64,
    /// Standard deviation of the noise on raw densities.
    pub density_noise_std: f64,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// Trains an [`Mlp`] by Adam (Kingma and Ba 2015, with PyTorch's defaults) on the loss of both
/// networks.
pub struct MlpTrainer {
    field: Mlp,
    options: MlpTraining,
    adam: Adam,
    state: TrainingState,
    /// Number of consecutive steps in which a network was stuck.
    stuck_steps: u64,
}

/// Returns the number of shards of a step on the CPU. It depends only on the number of rays, so
/// that sums have one order at any thread count. In shards of few rays, libtorch's calls cost more
/// than what they compute: steps of 8 rays take a quarter less time in one shard (design note 022).
fn shard_count(rays: usize) -> usize {
    const MAX_SHARDS: usize = 8;
    const RAYS_PER_SHARD: usize = 16;
    rays.div_ceil(RAYS_PER_SHARD).clamp(1, MAX_SHARDS)
}

/// Number of samples that pass through the fine network together: few enough that activations stay
/// in the cache, enough to outweigh the overhead of a call; chosen by hand.
const CHUNK_SAMPLES: usize = 4096;
/// Number of consecutive stuck steps that count as a collapse (design note 022).
const MAX_STUCK_STEPS: u64 = 200;
/// Minimum mean opacity of the rays. Below this opacity, the background alone explains the images,
/// and ReLU passes no gradient (design note 022).
const MIN_MEAN_OPACITY: f64 = 1e-3;
/// Maximum mean weight of the rays' first samples. Above this weight, light passes only if the
/// second sample is drawn close to the first, and no later sample gets a gradient (design note
/// 022).
const MAX_MEAN_FIRST_WEIGHT: f64 = 0.9;

/// Sample weights of a network, summed over rays.
#[derive(Clone, Copy, Default)]
struct WeightSums {
    /// Sum of all samples' weights: the rays' opacities.
    opacity: f64,
    /// Sum of the weights of each ray's first sample.
    first: f64,
}

impl WeightSums {
    fn new(weights: &Tensor) -> Result<Self, TchError> {
        let first = weights.f_narrow(1, 0, 1)?;
        Ok(Self {
            opacity: weights.f_sum(Kind::Double)?.f_double_value(&[])?,
            first: first.f_sum(Kind::Double)?.f_double_value(&[])?,
        })
    }

    fn add(self, other: Self) -> Self {
        Self { opacity: self.opacity + other.opacity, first: self.first + other.first }
    }

    /// Returns the reason why the network is stuck; `None` if the network can train. The sums are
    /// over `rays` rays.
    fn stuck_reason(self, rays: f64) -> Option<&'static str> {
        if self.opacity < MIN_MEAN_OPACITY * rays {
            Some("only the background is rendered, and ReLU passes no gradient")
        } else if self.first > MAX_MEAN_FIRST_WEIGHT * rays {
            Some("a wall is rendered in front of every camera, and blocks all gradients behind")
        } else {
            None
        }
    }
}

/// Gradients and statistics of a piece of a step.
struct MlpPiece {
    gradients: Vec<Tensor>,
    /// Colours of the rays, from the fine network.
    colours: Vec<[f32; 3]>,
    /// Sum of the bundles' losses.
    loss: f64,
    /// Sample weights of the coarse and the fine network.
    weights: [WeightSums; 2],
}

impl MlpPiece {
    /// Adds the next piece.
    fn add(&mut self, other: Self) -> Result<(), TchError> {
        nets::add_gradients(&mut self.gradients, &other.gradients)?;
        self.colours.extend(other.colours);
        self.loss += other.loss;
        for i in 0..2 {
            self.weights[i] = self.weights[i].add(other.weights[i]);
        }
        Ok(())
    }
}

impl MlpTrainer {
    /// Creates a trainer of `field`.
    pub fn new(field: Mlp, options: MlpTraining) -> Result<Self, TorchFieldError> {
        let adam = Adam::new(field.parameters())?;
        // No estimate of the samples per ray: the number of rays of a step doesn't depend on it.
        let state = TrainingState::new(0.0);
        Ok(Self { field, options, adam, state, stuck_steps: 0 })
    }

    /// Returns the field in its current state.
    pub fn field(&self) -> &Mlp {
        &self.field
    }

    /// Returns the progress of the training.
    pub fn state(&self) -> &TrainingState {
        &self.state
    }

    /// Takes one step; returns `None` after all rays are used.
    pub fn step(
        &mut self,
        supervisor: &mut impl Supervisor,
    ) -> Result<Option<StepReport>, TorchFieldError> {
        let MlpTraining { rays, max_rays_per_step, .. } = self.options;
        let done = self.state.progress(rays);
        let step = Step::start(&self.state, supervisor, rays, max_rays_per_step);
        let Some(step) = step else { return Ok(None) };
        let pieces = self.run_step(&*supervisor, step)?;
        let rays = step.rays();
        let MlpArchitecture { coarse_samples, fine_samples, .. } = self.field.architecture;
        let samples = rays * (2 * coarse_samples + fine_samples) as usize;
        self.state.count(step, samples);
        let sum = sum_in_order(pieces.into_iter().map(Ok))?.expect("a step has a bundle");
        let loss = sum.loss / step.bundles as f64;
        let skipped = !loss.is_finite() || !nets::all_finite(&sum.gradients)?;
        if skipped {
            if !self.state.record_nonfinite_step() {
                return Err(TorchFieldError::not_finite(self.state.steps));
            }
        } else {
            self.apply_gradients(&sum.gradients, done)?;
            step.record_colours(supervisor, [sum.colours].iter(), &PhaseClock::start());
        }
        self.state.steps += 1;
        self.check_collapse(sum.weights, rays)?;
        Ok(Some(StepReport { loss, rays, samples, skipped }))
    }

    /// Counts consecutive stuck steps; fails if a network has collapsed.
    fn check_collapse(
        &mut self,
        [coarse, fine]: [WeightSums; 2],
        rays: usize,
    ) -> Result<(), TorchFieldError> {
        let coarse = coarse.stuck_reason(rays as f64).map(|reason| ("coarse", reason));
        let fine = fine.stuck_reason(rays as f64).map(|reason| ("fine", reason));
        let Some((network, reason)) = coarse.or(fine) else {
            self.stuck_steps = 0;
            return Ok(());
        };
        self.stuck_steps += 1;
        if self.stuck_steps >= MAX_STUCK_STEPS {
            let problem =
                format!("the {network} network has collapsed: {reason}; try another seed");
            return Err(TorchFieldError::Diverged { step: self.state.steps, problem });
        }
        Ok(())
    }

    /// Runs the forward and backward pass of a step: on the CPU in parallel shards, on a GPU in
    /// pieces that fit its memory.
    fn run_step(
        &self,
        supervisor: &impl Supervisor,
        step: Step,
    ) -> Result<Vec<MlpPiece>, TorchFieldError> {
        let context = StepContext {
            step,
            seed: self.options.seed,
            noise_std: self.options.density_noise_std,
        };
        if self.field.device != Device::Cpu {
            let run = |range| context.run(&self.field, supervisor, range);
            return run_in_pieces(step.bundles, step.bundles, 1, run);
        }
        let (bundles, count) = (step.bundles, shard_count(step.rays()));
        let shards: Vec<(Mlp, Range<usize>)> = (0..count)
            .map(|i| (self.field.shallow_clone(), bundles * i / count..bundles * (i + 1) / count))
            .collect();
        let pieces: Result<Vec<Option<MlpPiece>>, TchError> = shards
            .into_par_iter()
            .map(|(field, range)| context.run_shard(&field, supervisor, range))
            .collect();
        Ok(pieces?.into_iter().flatten().collect())
    }

    /// Updates the parameters when a fraction `done` of the training run is over.
    pub(crate) fn apply_gradients(
        &mut self,
        gradients: &[Tensor],
        done: f64,
    ) -> Result<(), TchError> {
        let MlpTraining { epochs, learning_rate: highest, learning_rate_decay, .. } = self.options;
        let learning_rate = self.state.learning_rate_scale
            * learning_rate(highest, learning_rate_decay, epochs, done);
        self.adam.step(self.field.parameters(), gradients, learning_rate)
    }

    /// Writes a checkpoint, from which training resumes. The caller makes the write atomic.
    pub fn write_checkpoint(&self, path: &Path) -> Result<(), TorchFieldError> {
        let counters = [&self.state.counters()[..], &[self.stuck_steps]].concat();
        Ok(self.adam.write_checkpoint(path, self.field.named_parameters(), &counters)?)
    }

    /// Resumes from a checkpoint of a trainer with the same field and options.
    pub fn resume(&mut self, path: &Path) -> Result<(), TorchFieldError> {
        let (adam, [counters @ .., stuck_steps]): (Adam, [u64; 7]) =
            Adam::resume(path, &self.field.named_parameters())?;
        self.adam = adam;
        self.state = TrainingState::from_counters(counters);
        self.stuck_steps = stuck_steps;
        Ok(())
    }
}

/// Adds up pieces in their order; returns `None` if there are none.
fn sum_in_order(
    pieces: impl Iterator<Item = Result<MlpPiece, TchError>>,
) -> Result<Option<MlpPiece>, TchError> {
    let mut sum = None::<MlpPiece>;
    for piece in pieces {
        match &mut sum {
            None => sum = Some(piece?),
            Some(sum) => sum.add(piece?)?,
        }
    }
    Ok(sum)
}

/// Values of a step that all its pieces need.
#[derive(Clone, Copy)]
struct StepContext {
    step: Step,
    seed: u64,
    noise_std: f64,
}

impl StepContext {
    /// Runs a shard in chunks, one after the other.
    fn run_shard(
        self,
        field: &Mlp,
        supervisor: &impl Supervisor,
        range: Range<usize>,
    ) -> Result<Option<MlpPiece>, TchError> {
        let samples =
            (field.architecture.coarse_samples + field.architecture.fine_samples) as usize;
        let chunk = (CHUNK_SAMPLES / (samples * self.step.rays_per_bundle)).max(1);
        sum_in_order(
            range
                .clone()
                .step_by(chunk)
                .map(|start| self.run(field, supervisor, start..(start + chunk).min(range.end))),
        )
    }

    /// Runs the forward and backward pass of a range of bundles.
    fn run(
        self,
        field: &Mlp,
        supervisor: &impl Supervisor,
        range: Range<usize>,
    ) -> Result<MlpPiece, TchError> {
        let mut rays = Vec::new();
        self.step.sample_rays(supervisor, &range, &mut rays);
        let draws = SampleDraws::new(
            field,
            self.seed,
            self.step.first_ray_of(&range),
            rays.len(),
            self.noise_std,
        )?;
        let forward = field.forward(&Batch::new(&rays, field)?, Some(&draws))?;
        let coarse = loss_of_bundles(self.step, supervisor, &range, &forward.coarse.colour)?;
        let fine = loss_of_bundles(self.step, supervisor, &range, &forward.fine.colour)?;
        let parameters: Vec<Tensor> = field.parameters().collect();
        let gradients = Tensor::f_run_backward(
            &[coarse.surrogate.f_add(&fine.surrogate)?],
            &parameters,
            false,
            false,
        )?;
        Ok(MlpPiece {
            gradients,
            colours: fine.colours,
            loss: coarse.sum + fine.sum,
            weights: [
                WeightSums::new(&forward.coarse.weights)?,
                WeightSums::new(&forward.fine.weights)?,
            ],
        })
    }
}

#[cfg(test)]
mod tests {
    use radiance::Ray;
    use scene::Bounds;
    use tch::no_grad;

    use super::*;
    use crate::network::MlpNetwork;

    /// Supervisor of four parallel rays, of which every other should be dark.
    struct Stripes;

    impl Supervisor for Stripes {
        fn rays_per_bundle(&self) -> usize {
            1
        }

        fn sample_rays(&self, bundle: u64, rays: &mut [Ray]) {
            let x = 0.2 * (bundle % 4) as f64;
            rays[0] =
                Ray { origin: [x, 0.0, 4.0], direction: [0.0, 0.0, -1.0], background: [1.0; 3] };
        }

        fn loss_and_gradient(
            &self,
            bundle: u64,
            colours: &[[f32; 3]],
            gradients: &mut [[f32; 3]],
        ) -> f64 {
            let difference = colours[0].map(|x| x - (bundle % 2) as f32);
            gradients[0] = difference.map(|x| 2.0 * x);
            difference.iter().map(|&x| f64::from(x * x)).sum()
        }
    }

    /// Trains after shifting one network's raw densities. Returns the error, if training fails.
    fn training_error(network: fn(&Mlp) -> &MlpNetwork, shift: f64) -> Option<String> {
        let architecture = MlpArchitecture {
            layers: 5,
            hidden_dim: 16,
            coarse_samples: 16,
            fine_samples: 8,
            ..MlpArchitecture::default()
        };
        let bounds = Bounds::cube(2.0, 2.0, 6.0);
        let options = MlpTraining {
            rays: 8 * 250,
            max_rays_per_step: 8,
            learning_rate: 5e-4,
            learning_rate_decay: 0.1,
            epochs: 20,
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

    /// Training fails if a network's samples stop no light, or its first samples stop all light.
    /// Training of other fields continues to the end.
    #[test]
    fn collapses_are_reported() {
        assert_eq!(training_error(|f| &f.fine, 0.5), None);
        for (network, shift, expected) in [
            (
                (|f| &f.coarse) as fn(&Mlp) -> &MlpNetwork,
                -300.0,
                "the coarse network has collapsed: only the background is rendered",
            ),
            (
                |f| &f.fine,
                300.0,
                "the fine network has collapsed: a wall is rendered in front of every camera",
            ),
        ] {
            let error = training_error(network, shift).expect("training must fail");
            assert!(error.contains("step 200") && error.contains(expected), "{error}");
        }
    }
}

mod checkpoint;
mod options;
mod shard;

use std::sync::Mutex;

use rayon::prelude::*;

use crate::adam::{AdamStep, adam, update_average};
use crate::aligned::Aligned;
use crate::field::Field;
use crate::grid::{Level, scatter};
use crate::occupancy::Occupancy;
use crate::samples::DensityRows;
use crate::simd::LANES;
use crate::training_state::TrainingState;

pub use options::{Supervisor, TrainingOptions};

use shard::{Shard, StepWork, Worker};

/// Result of a training step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepReport {
    /// Mean loss of the bundles.
    pub loss: f64,
    /// Number of rays cast.
    pub rays: usize,
    /// Number of samples marched.
    pub samples: usize,
    /// True if the step was discarded because a number wasn't finite.
    pub skipped: bool,
}

/// Error returned when a training can't continue.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// Two steps within 100 weren't finite.
    #[error(
        "step {step}: {tensor} is not finite, for the second time within 100 steps; lower the \
        learning rate"
    )]
    NotFinite {
        /// Number of the step.
        step: u64,
        /// Description of the tensor.
        tensor: &'static str,
    },
}

/// Number of shards of a step (docs/design/006), fixed so that sums have one order at any thread
/// count.
const SHARDS: usize = 32;
/// Number of a level's blocks per task of the optimiser; chosen by hand.
const ADAM_BLOCKS: usize = 1 << 12;
/// Number of weights per task that updates their average; chosen by hand.
const AVERAGE_PIECE: usize = 1 << 16;

/// Trains a [`Field`] by Adam.
pub struct Trainer {
    field: Field,
    options: TrainingOptions,
    first: Moments,
    second: Moments,
    gradients: Moments,
    /// Running average of the weights, created by the first update.
    average: Option<Moments>,
    /// Marks of each level's blocks that have a gradient.
    touched: Vec<Vec<u8>>,
    touched_network: Vec<u8>,
    transposed: Aligned,
    state: TrainingState,
    samples_per_ray: f64,
    shards: Vec<Shard>,
    workers: Mutex<Vec<Worker>>,
}

/// One float per parameter.
struct Moments {
    grid: Aligned,
    network: Aligned,
}

impl Moments {
    fn zeros(field: &Field) -> Self {
        Self {
            grid: Aligned::zeros(field.grid.len()),
            network: Aligned::zeros(field.network.len()),
        }
    }
}

impl Trainer {
    /// Creates a trainer that is initialised from a field.
    pub fn new(field: Field, options: TrainingOptions) -> Self {
        Self {
            first: Moments::zeros(&field),
            second: Moments::zeros(&field),
            gradients: Moments::zeros(&field),
            average: None,
            touched: field.levels.iter().map(|l| vec![0; l.blocks()]).collect(),
            touched_network: vec![0; field.network.len().div_ceil(LANES)],
            transposed: Aligned::zeros(field.network.len()),
            state: TrainingState::default(),
            samples_per_ray: field.architecture.samples_per_full_ray(),
            shards: (0..SHARDS).map(|_| Shard::default()).collect(),
            workers: Mutex::new(Vec::new()),
            field,
            options,
        }
    }

    /// Returns the trained field, with averaged weights if averaging has begun.
    pub fn finish(self) -> Field {
        let mut field = self.field;
        if let Some(average) = self.average {
            (field.grid, field.network) = (average.grid, average.network);
        }
        field
    }

    /// Returns the field in its current state.
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// Returns the number of steps taken.
    pub fn steps(&self) -> u64 {
        self.state.steps
    }

    /// Returns the number of rays cast.
    pub fn rays_done(&self) -> u64 {
        self.state.rays
    }

    /// Takes a step; returns `None` after all rays have been cast.
    pub fn step(
        &mut self,
        supervision: &mut impl Supervisor,
    ) -> Result<Option<StepReport>, TrainingError> {
        supervision.set_progress(self.state.progress(self.options.rays));
        let bundle = supervision.rays_per_bundle();
        let target_rays = self.options.rays_of_step(&self.state, self.samples_per_ray);
        let Some(bundles) = self.state.bundles_of_step(self.options.rays, target_rays, bundle)
        else {
            return Ok(None);
        };
        self.update_occupancy();
        for layer in self.field.layers.all() {
            layer.transpose(&self.field.network, &mut self.transposed);
        }

        let first_bundle = self.state.bundles;
        self.run_shards(&*supervision, bundles);
        self.sum_network_gradients();
        let samples: usize = self.shards.iter().map(|s| s.samples).sum();
        let loss = self.shards.iter().map(|s| s.loss).sum::<f64>() / bundles as f64;
        self.state.count(bundles, bundle);
        self.samples_per_ray = samples as f64 / (bundles * bundle) as f64;
        let nonfinite = self.find_nonfinite(loss);
        if let Some(tensor) = nonfinite {
            self.gradients.network.fill(0.0);
            if !self.state.record_nonfinite_step() {
                return Err(TrainingError::NotFinite { step: self.state.steps, tensor });
            }
        } else {
            self.apply_gradients();
            self.update_average();
            for shard in &self.shards {
                self.field.occupancy.raise_densities(&shard.hits);
            }
            let colours = self.shards.iter().flat_map(|s| s.colours.chunks_exact(bundle));
            for (i, colours) in colours.enumerate() {
                supervision.record_colours(first_bundle + i as u64, colours);
            }
        }
        self.state.steps += 1;
        let skipped = nonfinite.is_some();
        Ok(Some(StepReport { loss, rays: bundles * bundle, samples, skipped }))
    }

    /// Runs the forward and backward pass of a step's bundles, a range of them per shard.
    fn run_shards(&mut self, supervision: &impl Supervisor, bundles: usize) {
        let work = StepWork {
            field: &self.field,
            transposed: &self.transposed,
            supervision,
            options: &self.options,
            strides: self.field.occupancy.strides(self.state.steps),
            first_bundle: self.state.bundles,
            first_ray: self.state.rays,
            bundles,
        };
        let workers = &self.workers;
        self.shards.par_iter_mut().enumerate().for_each(|(i, shard)| {
            let mut worker = lock(workers).pop().unwrap_or_default();
            shard.run(&mut worker, &work, bundles * i / SHARDS..bundles * (i + 1) / SHARDS);
            lock(workers).push(worker);
        });
    }

    /// Sums the networks' gradients over all shards, in the shards' order.
    fn sum_network_gradients(&mut self) {
        let shards = &self.shards;
        let parts = self.gradients.network.par_chunks_mut(1024).enumerate();
        parts.for_each(|(i, sums)| {
            for shard in shards {
                let part = &shard.network[1024 * i..][..sums.len()];
                for (sum, gradient) in sums.iter_mut().zip(part) {
                    *sum += gradient;
                }
            }
        });
    }

    /// Returns the description of the first value that isn't finite; called before parameters
    /// change.
    fn find_nonfinite(&self, loss: f64) -> Option<&'static str> {
        if !loss.is_finite() {
            Some("the loss")
        } else if !self.gradients.network.iter().sum::<f32>().is_finite() {
            Some("the networks' gradient")
        } else if !self
            .shards
            .par_iter()
            .all(|s| s.features.levels.iter().flatten().flatten().all(|g| g.is_finite()))
        {
            Some("the grid's gradient")
        } else {
            None
        }
    }

    /// Takes an Adam step of networks and grid; first adds the shards' gradients of each level.
    fn apply_gradients(&mut self) {
        let options = &self.options;
        let (schedule, step) = (options.schedule(&self.state), self.state.steps + 1);
        let network_step =
            AdamStep::new(step, options.mlp_learning_rate * schedule, options.network_decay);
        // Every weight of the networks has a gradient.
        self.touched_network.fill(1);
        adam(
            &network_step,
            &mut self.touched_network,
            &mut self.field.network,
            &mut self.gradients.network,
            &mut self.first.network,
            &mut self.second.network,
        );

        let shards = &self.shards;
        let levels = &self.field.levels;
        let [w, g, m, v] = [
            &mut self.field.grid,
            &mut self.gradients.grid,
            &mut self.first.grid,
            &mut self.second.grid,
        ]
        .map(|parameters| split_by_level(levels, parameters));
        let touched = self.touched.par_iter_mut();
        let work = (levels.par_iter(), touched, w, g, m, v).into_par_iter().enumerate();
        // The finest levels take longest, so they go first.
        work.rev().with_max_len(1).for_each(|(i, (level, touched, w, g, m, v))| {
            for shard in shards {
                if let Some(gradients) = shard.features.levels.get(i) {
                    scatter(level, g, touched, &shard.features.positions, gradients);
                }
            }
            let adam_step = AdamStep::new(step, options.rate_of_level(i, schedule), 0.0);
            let len = ADAM_BLOCKS * LANES;
            // In pieces, so that the last level occupies all threads.
            let [w, g, m, v] = [w, g, m, v].map(|numbers| numbers.par_chunks_mut(len));
            (touched.par_chunks_mut(ADAM_BLOCKS), w, g, m, v)
                .into_par_iter()
                .for_each(|(touched, w, g, m, v)| adam(&adam_step, touched, w, g, m, v));
        });
    }

    /// Updates the average of the weights (Polyak) late in the training, which cancels the steps'
    /// noise (docs/design/007).
    fn update_average(&mut self) {
        if !self.options.is_averaging_step(&self.state) {
            return;
        }
        let field = &self.field;
        let average = self.average.get_or_insert_with(|| Moments {
            grid: field.grid.clone(),
            network: field.network.clone(),
        });
        let share = 1.0 - self.options.ema_decay;
        let pairs = [(&mut average.grid, &field.grid), (&mut average.network, &field.network)];
        for (average, now) in pairs {
            (average.par_chunks_mut(AVERAGE_PIECE), now.par_chunks(AVERAGE_PIECE))
                .into_par_iter()
                .for_each(|(average, now)| update_average(average, now, share));
        }
    }

    /// Evaluates the density of the cells that are due, and updates the occupancy.
    fn update_occupancy(&mut self) {
        let field = &self.field;
        let seed = self.options.seed;
        let step = self.state.steps;
        let cells = field.occupancy.cells_to_update(step);
        let densities = cells.par_chunks(1024).map_init(
            || (DensityRows::default(), vec![0.0; 3 * 1024]),
            |(rows, positions), cells| {
                let n = cells.len().next_multiple_of(LANES);
                for (k, &cell) in cells.iter().enumerate() {
                    let position = Occupancy::random_position(cell, seed, step);
                    for axis in 0..3 {
                        positions[axis * n + k] = position[axis];
                    }
                }
                let mut densities = vec![0.0; n];
                rows.densities(field, &positions[..3 * n], n, &mut densities);
                densities.truncate(cells.len());
                densities
            },
        );
        let densities: Vec<f32> = densities.flatten_iter().collect();
        let distance = field.step();
        self.field.occupancy.update(&cells, &densities, distance);
    }
}

/// Splits one float per grid parameter into the parts of the levels.
fn split_by_level<'a>(levels: &[Level], mut parameters: &'a mut [f32]) -> Vec<&'a mut [f32]> {
    let mut parts = Vec::with_capacity(levels.len());
    for level in levels {
        let (part, rest) = parameters.split_at_mut(level.range().len());
        parts.push(part);
        parameters = rest;
    }
    parts
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::architecture::Architecture;
    use crate::ray::Ray;
    use crate::regularisers::Regularisers;
    use counter_rng::CounterRng;
    use scene::{Bounds, Space};

    use crate::simd::by_every_family;

    /// Rays through the cube, before black or white, that should all be white.
    struct White {
        background: f32,
    }

    impl White {
        fn black() -> Self {
            Self { background: 0.0 }
        }
    }

    impl Supervisor for White {
        fn rays_per_bundle(&self) -> usize {
            1
        }

        fn sample_rays(&self, bundle: u64, rays: &mut [Ray]) {
            let mut rng = CounterRng::new(1, 2, bundle);
            let [x, y] = [0, 1].map(|_| f64::from(1.6 * rng.uniform() - 0.8));
            rays[0] = Ray {
                origin: [x, y, 4.0],
                direction: [0.0, 0.0, -1.0],
                background: [self.background; 3],
            };
        }

        fn loss_and_gradient(
            &self,
            _: u64,
            colours: &[[f32; 3]],
            gradients: &mut [[f32; 3]],
        ) -> f64 {
            gradients[0] = colours[0].map(|c| 2.0 * (c - 1.0));
            colours[0].iter().map(|c| f64::from((c - 1.0) * (c - 1.0))).sum()
        }
    }

    fn options(steps: u64) -> TrainingOptions {
        TrainingOptions {
            rays: steps * 256,
            max_rays_per_step: 256,
            samples_per_step: 1 << 20,
            learning_rate: 1e-2,
            level_rate: 0.8,
            mlp_learning_rate: 1e-2,
            learning_rate_decay: 0.25,
            warm_up: 5,
            ema_decay: 0.0,
            regularisers: Regularisers::default(),
            network_decay: 0.0,
            roulette: 1.0,
            seed: 9,
        }
    }

    fn trained(field: Field, background: f32, floater_loss: f32, steps: u64) -> (Field, f32) {
        let regularisers = Regularisers { floater_loss, ..Regularisers::default() };
        let options = TrainingOptions { regularisers, ..options(steps) };
        let (mut trainer, mut white) = (Trainer::new(field, options), White { background });
        while trainer.step(&mut white).unwrap().is_some() {}
        let mut rays = [Ray::default(); 64];
        (0..)
            .zip(&mut rays)
            .for_each(|(bundle, ray)| white.sample_rays(bundle, std::slice::from_mut(ray)));
        let field = trainer.finish();
        let opacity = field.render(&rays).iter().map(|pixel| pixel.opacity).sum::<f32>() / 64.0;
        (field, opacity)
    }

    const SMALL: Architecture = Architecture {
        n_levels: 4,
        base_resolution: 4,
        max_resolution: 32,
        finest_z: 32,
        log2_hashmap_size: 10,
        hidden_dim: 16,
        march_steps: 64,
    };

    fn cube(space: Space) -> Bounds {
        Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.5, far: 9.0, space }
    }

    /// All numbers of a trained field, in bits.
    fn bits(field: &Field) -> Vec<u32> {
        field.grid.iter().chain(field.network.iter()).map(|x| x.to_bits()).collect()
    }

    /// A trainer that can't resume trains on as if it hadn't tried, whether the weights' size is
    /// wrong or what is read last.
    #[test]
    fn a_failed_resume_leaves_no_trace() {
        let folder = tempfile::tempdir().unwrap();
        let options = TrainingOptions { ema_decay: 0.9, ..options(30) };
        let new =
            |architecture| Trainer::new(Field::new(architecture, cube(Space::Box), 5), options);
        let larger = Architecture { log2_hashmap_size: 11, ..SMALL };
        for (name, architecture) in [("size", larger), ("cells", SMALL)] {
            let path = folder.path().join(name);
            let mut other = new(architecture);
            // Late enough for an average of the weights.
            (0..28).for_each(|_| assert!(other.step(&mut White::black()).unwrap().is_some()));
            other.write_checkpoint(&path).unwrap();
            if name == "cells" {
                without_last_cell(&path);
            }
            let mut tried = new(SMALL);
            assert!(tried.resume(&path).is_err());
            assert!(finished(tried) == finished(new(SMALL)), "{name}");
        }
    }

    fn finished(mut trainer: Trainer) -> Vec<u32> {
        while trainer.step(&mut White::black()).unwrap().is_some() {}
        bits(&trainer.finish())
    }

    /// Writes a checkpoint anew with one cell of the occupancy less.
    fn without_last_cell(path: &std::path::Path) {
        let bytes = std::fs::read(path).unwrap();
        let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let cut = tensors.iter().map(|(name, view)| {
            let (mut shape, mut data) = (view.shape().to_vec(), view.data().to_vec());
            if name == "occupied" {
                data.pop();
                shape = vec![data.len()];
            }
            (name.to_owned(), view.dtype(), shape, data)
        });
        let cut: Vec<_> = cut.collect();
        let views = cut.iter().map(|(name, kind, shape, data)| {
            (name, safetensors::tensor::TensorView::new(*kind, shape.clone(), data).unwrap())
        });
        std::fs::write(path, safetensors::serialize(views, None).unwrap()).unwrap();
    }

    /// Some steps of a training give equal bits by every SIMD family: in a box by double strides,
    /// and through the contraction by strides that depend on the cell.
    #[test]
    fn every_family_trains_to_equal_bits() {
        for (space, is_known) in [(Space::Box, false), (Space::Contraction, true)] {
            let train = || {
                let mut field = Field::new(SMALL, cube(space), 5);
                if is_known {
                    field.limit_to_occupied();
                }
                bits(&trained(field, 0.0, 1e-3, 40).0)
            };
            let best = train();
            by_every_family(|family| assert!(train() == best, "{family:?} in {space:?}"));
        }
    }

    /// A white floater before white has no colour error and stays; the floater loss removes it.
    #[test]
    fn what_passes_for_the_background_goes() {
        let (floater, opacity) = trained(Field::new(SMALL, cube(Space::Box), 5), 0.0, 0.0, 40);
        let ((_, without), (_, with)) =
            (trained(floater.clone(), 1.0, 0.0, 200), trained(floater, 1.0, 1e-3, 200));
        println!(
            "opacity {opacity} before black, then before white {without}, with the floater loss \
            {with}"
        );
        assert!(opacity > 0.5 && without > 0.5 * opacity && with < 0.1 * without);
    }
}

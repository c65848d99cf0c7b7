mod checkpoint;
mod options;
mod phases;
mod shard;
mod step;

use std::ops::RangeInclusive;
use std::slice::ChunksMut;
use std::sync::Mutex;

use rayon::prelude::*;

use crate::adam::{AdamStep, adam, adam_of_bricks, update_average};
use crate::aligned::Aligned;
use crate::field::Field;
use crate::grid::LevelGradients;
use crate::occupancy::Occupancy;
use crate::samples::DensityRows;
use crate::spec::{BRICK, FEATURES};
use crate::training_state::TrainingState;
use numerics::simd::LANES;

pub use options::{NETWORK_DECAY, RenderedBundles, Supervisor, TrainingOptions};
pub use phases::{Phase, PhaseClock, PhaseTimes};
pub use step::Step;

use shard::{ShardResult, StepWork, Worker};

/// Result of a training step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepReport {
    /// Mean loss of the bundles; may be NaN or infinite if `skipped`.
    pub loss: f64,
    /// Number of rays cast.
    pub rays: usize,
    /// Number of samples marched.
    pub samples: usize,
    /// True if the step was discarded because a number wasn't finite.
    pub skipped: bool,
}

/// Error returned when a training can't continue: two steps within 100 weren't finite.
#[derive(Debug, thiserror::Error)]
#[error(
    "step {step}: {tensor} is not finite, for the second time within 100 steps; lower the \
    learning rate"
)]
pub struct TrainingError {
    /// Number of the step.
    pub step: u64,
    /// Description of the tensor.
    pub tensor: &'static str,
}

/// Target number of rays of a shard, unless [`SHARDS`] limits the number of shards
/// (docs/design/047). Fewer rays leave many SIMD lanes empty.
const RAYS_PER_SHARD: usize = 40;
/// Minimum and maximum number of shards of a step (docs/design/047).
const SHARDS: RangeInclusive<usize> = 32..=128;
/// Number of network weights whose gradients one task sums; chosen by hand.
const SUMS_PIECE: usize = 64;
/// Number of a level's bricks that one task of the optimiser updates; chosen by hand.
const ADAM_BRICKS: usize = 1 << 9;
/// Number of cells whose densities one task evaluates; chosen by hand.
const CELLS_PER_TASK: usize = 1024;
/// Number of weights whose average one task updates; chosen by hand.
const AVERAGE_PIECE: usize = 1 << 16;

/// Trains a [`Field`] by Adam.
pub struct Trainer {
    field: Field,
    options: TrainingOptions,
    /// Both moments of Adam, packed.
    moments: ParameterBuffers<u32>,
    network_gradients: Aligned,
    /// Gradients of the grid's levels.
    grid_gradients: Vec<LevelGradients>,
    /// Running average of the weights, created by the first update.
    average: Option<ParameterBuffers>,
    /// Transposed weights of the networks' layers, for the backward pass.
    transposed: Aligned,
    state: TrainingState,
    shards: Vec<ShardResult>,
    workers: Mutex<Vec<Worker>>,
    times: [PhaseTimes; Phase::ALL.len()],
}

/// Buffers with one element for each parameter of the grid and of the networks.
struct ParameterBuffers<T = f32> {
    grid: Aligned<T>,
    network: Aligned<T>,
}

impl<T: Copy + Default> ParameterBuffers<T> {
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
            moments: ParameterBuffers::zeros(&field),
            network_gradients: Aligned::zeros(field.network.len()),
            grid_gradients: field.levels.iter().map(LevelGradients::zeros).collect(),
            average: None,
            transposed: Aligned::zeros(field.network.len()),
            state: TrainingState::new(field.architecture.samples_per_full_ray()),
            shards: Vec::new(),
            workers: Mutex::new(Vec::new()),
            times: Default::default(),
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

    /// Returns the progress of the training.
    pub fn state(&self) -> &TrainingState {
        &self.state
    }

    /// Takes a step; returns `None` after all rays have been cast.
    pub fn step(
        &mut self,
        supervisor: &mut impl Supervisor,
    ) -> Result<Option<StepReport>, TrainingError> {
        let target_rays = self.options.rays_of_step(&self.state);
        let step = Step::start(&self.state, supervisor, self.options.rays, target_rays);
        let Some(step) = step else { return Ok(None) };
        self.phase(Phase::Occupancy, Self::update_occupancy);
        for layer in self.field.layers.all() {
            layer.transpose(&self.field.network, &mut self.transposed);
        }

        self.phase(Phase::Passes, |t, clock| t.run_shards(&*supervisor, step, clock));
        self.phase(Phase::Sums, Self::sum_network_gradients);
        let samples: usize = self.shards.iter().map(|s| s.samples).sum();
        let loss = self.shards.iter().map(|s| s.loss).sum::<f64>() / step.bundles as f64;
        self.state.count(step, samples);
        let nonfinite = self.find_nonfinite(loss);
        if let Some(tensor) = nonfinite {
            self.network_gradients.fill(0.0);
            if !self.state.record_nonfinite_step() {
                return Err(TrainingError { step: self.state.steps, tensor });
            }
        } else {
            self.phase(Phase::GridGradients, Self::sum_grid_gradients);
            self.phase(Phase::Adam, Self::apply_gradients);
            self.phase(Phase::Average, Self::average_weights);
            self.phase(Phase::Records, |trainer, clock| {
                trainer.record(supervisor, step, clock);
            });
        }
        self.state.steps += 1;
        let skipped = nonfinite.is_some();
        Ok(Some(StepReport { loss, rays: step.rays(), samples, skipped }))
    }

    /// Returns the time spent in each phase so far.
    pub fn phase_times(&self) -> [PhaseTimes; Phase::ALL.len()] {
        self.times
    }

    /// Runs a phase of a step and records its time.
    fn phase<T>(&mut self, phase: Phase, run: impl FnOnce(&mut Self, &PhaseClock) -> T) -> T {
        let clock = PhaseClock::start();
        let result = run(self, &clock);
        self.times[phase as usize].add(&clock);
        result
    }

    /// Runs the forward and backward pass of a step's bundles, a range of them per shard.
    fn run_shards(&mut self, supervisor: &impl Supervisor, step: Step, clock: &PhaseClock) {
        let work = StepWork {
            field: &self.field,
            transposed: &self.transposed,
            supervisor,
            options: &self.options,
            strides: self.field.occupancy.strides(self.state.steps),
            step,
        };
        // Independent of the number of threads, so that sums have one order.
        let shards = (step.rays() / RAYS_PER_SHARD).clamp(*SHARDS.start(), *SHARDS.end());
        self.shards.resize_with(shards, ShardResult::default);
        let workers = &self.workers;
        self.shards.par_iter_mut().enumerate().for_each(|(i, shard)| {
            let mut worker = lock(workers).pop().unwrap_or_default();
            let range = step.bundles * i / shards..step.bundles * (i + 1) / shards;
            clock.task(|| shard.run(&mut worker, &work, range));
            lock(workers).push(worker);
        });
    }

    /// Sums the networks' gradients over all shards, in the shards' order. The sums are 0 before:
    /// the previous step has cleared them.
    fn sum_network_gradients(&mut self, clock: &PhaseClock) {
        let shards = &self.shards;
        let parts = self.network_gradients.par_chunks_mut(SUMS_PIECE).enumerate();
        parts.for_each(|(i, sums)| {
            clock.task(|| {
                for shard in shards {
                    let part = &shard.network_gradients[SUMS_PIECE * i..][..sums.len()];
                    for (sum, gradient) in sums.iter_mut().zip(part) {
                        *sum += gradient;
                    }
                }
            });
        });
    }

    /// Returns the description of the first value that isn't finite; called before parameters
    /// change.
    fn find_nonfinite(&self, loss: f64) -> Option<&'static str> {
        if !loss.is_finite() {
            Some("the loss")
        } else if !self.network_gradients.iter().sum::<f32>().is_finite() {
            Some("the networks' gradient")
        } else if !self.shards.iter().all(|shard| shard.has_finite_grid_gradients) {
            Some("the grid's gradient")
        } else {
            None
        }
    }

    /// Sums the grid's gradients over all shards, in the shards' order.
    fn sum_grid_gradients(&mut self, clock: &PhaseClock) {
        let mut tasks = Vec::with_capacity(2 * self.grid_gradients.len());
        // The finest levels take longest, so they go first.
        let levels = self.field.levels.iter().zip(&mut self.grid_gradients).enumerate();
        for (i, (level, gradients)) in levels.rev() {
            tasks.extend(gradients.halves.iter_mut().map(|half| (i, level, half)));
        }
        let shards = &self.shards;
        tasks.into_par_iter().with_max_len(1).for_each(|(i, level, half)| {
            clock.task(|| {
                for shard in shards {
                    if let Some(gradients) = shard.features.levels.get(i) {
                        half.scatter(level, &shard.features.rows, gradients);
                    }
                }
            });
        });
    }

    /// Takes an Adam step of networks and grid.
    fn apply_gradients(&mut self, clock: &PhaseClock) {
        let options = &self.options;
        let (factor, step) = (options.learning_rate_factor(&self.state), self.state.steps + 1);
        let network_step = AdamStep::new(step, options.mlp_learning_rate * factor, NETWORK_DECAY);
        adam(
            &network_step,
            &mut self.network_gradients,
            &mut self.field.network,
            &mut self.moments.network,
        );

        let (mut weights, mut moments) = (&mut *self.field.grid, &mut *self.moments.grid);
        let mut tasks = Vec::new();
        let levels = self.field.levels.iter().zip(&mut self.grid_gradients);
        for (i, (level, gradients)) in levels.enumerate() {
            let level_step = AdamStep::new(step, options.rate_of_level(i, factor), 0.0);
            let weights = take_pieces(&mut weights, level.range().len());
            let moments = take_pieces(&mut moments, level.range().len());
            let [even, odd] = gradients.halves.each_mut().map(|half| {
                half.sums.chunks_mut(ADAM_BRICKS * LANES).zip(half.touched.chunks_mut(ADAM_BRICKS))
            });
            let pieces = even.zip(odd).zip(weights.zip(moments));
            tasks.extend(pieces.map(|((even, odd), tables)| (level_step, [even, odd], tables)));
        }
        tasks.into_par_iter().for_each(|(step, mut halves, (weights, moments))| {
            clock.task(|| adam_of_bricks(&step, &mut halves, weights, moments));
        });
    }

    /// Updates the average of the weights (Polyak) late in the training, which cancels the steps'
    /// noise (docs/design/007).
    fn average_weights(&mut self, clock: &PhaseClock) {
        if !self.options.is_averaging_step(&self.state) {
            return;
        }
        let field = &self.field;
        let average = self.average.get_or_insert_with(|| ParameterBuffers {
            grid: field.grid.clone(),
            network: field.network.clone(),
        });
        let share = 1.0 - self.options.ema_decay;
        let pairs = [(&mut average.grid, &field.grid), (&mut average.network, &field.network)];
        for (average, now) in pairs {
            (average.par_chunks_mut(AVERAGE_PIECE), now.par_chunks(AVERAGE_PIECE))
                .into_par_iter()
                .for_each(|(average, now)| {
                    clock.task(|| update_average(average, now, share));
                });
        }
    }

    /// Raises the densities recorded in the occupancy grid to those of the step's samples, and
    /// passes the rendered colours to the supervisor.
    fn record(&mut self, supervisor: &mut impl Supervisor, step: Step, clock: &PhaseClock) {
        let occupancy = &self.field.occupancy;
        self.shards.par_iter().for_each(|shard| {
            clock.task(|| occupancy.raise_densities(&shard.hits));
        });
        step.record_colours(supervisor, self.shards.iter().map(|shard| &shard.colours), clock);
    }

    /// Evaluates the density of the cells that are due, and updates the occupancy.
    fn update_occupancy(&mut self, clock: &PhaseClock) {
        let field = &self.field;
        let seed = self.options.seed;
        let step = self.state.steps;
        let cells = field.occupancy.cells_to_update(step);
        let mut densities = vec![0.0; cells.len()];
        let pieces = cells.par_chunks(CELLS_PER_TASK).zip(densities.par_chunks_mut(CELLS_PER_TASK));
        pieces.for_each_init(CellBuffers::default, |buffers, (cells, densities)| {
            clock.task(|| buffers.evaluate(field, cells, (seed, step), densities));
        });
        let distance = field.march_step();
        self.field.occupancy.update(&cells, &densities, distance, clock);
    }
}

/// Buffers of one thread that evaluates cells' densities.
#[derive(Default)]
struct CellBuffers {
    rows: DensityRows,
    positions: Vec<f32>,
    densities: Vec<f32>,
}

impl CellBuffers {
    /// Evaluates the density at a random position in each cell.
    fn evaluate(
        &mut self,
        field: &Field,
        cells: &[u32],
        (seed, step): (u64, u64),
        densities: &mut [f32],
    ) {
        let n = cells.len().next_multiple_of(LANES);
        self.positions.clear();
        self.positions.resize(3 * n, 0.0);
        for (k, &cell) in cells.iter().enumerate() {
            let position = Occupancy::random_position(cell, seed, step);
            for axis in 0..3 {
                self.positions[axis * n + k] = position[axis];
            }
        }
        self.densities.resize(n, 0.0);
        self.rows.densities(field, &self.positions, n, &mut self.densities[..n]);
        densities.copy_from_slice(&self.densities[..cells.len()]);
    }
}

/// Takes the next `len` parameters off a slice. Returns a piece for each task of the optimiser.
fn take_pieces<'a, T>(parameters: &mut &'a mut [T], len: usize) -> ChunksMut<'a, T> {
    let (part, rest) = std::mem::take(parameters).split_at_mut(len);
    *parameters = rest;
    part.chunks_mut(ADAM_BRICKS * BRICK * FEATURES)
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
    use numerics::CounterRng;
    use scene::{Bounds, Space};

    use numerics::simd::test_every_family;

    /// Supervisor that fits every ray through the cube to white, over a black or white background.
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
            mlp_learning_rate: 1e-2,
            learning_rate_decay: 0.25,
            warm_up: 5,
            ema_decay: 0.0,
            regularisers: Regularisers::default(),
            roulette: 1.0,
            seed: 9,
        }
    }

    /// Returns the trained field and its mean opacity.
    fn trained(field: Field, background: f32, floater_loss: f64, steps: u64) -> (Field, f32) {
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

    /// Returns all parameters of a field, as bits.
    fn bits(field: &Field) -> Vec<u32> {
        field.grid.iter().chain(field.network.iter()).map(|x| x.to_bits()).collect()
    }

    /// After a failed resume, a trainer trains as if there had been no attempt. The error is either
    /// in the weights' size, or in the occupancy, which is read last.
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
            // Late enough that averaged weights exist.
            (0..28).for_each(|_| assert!(other.step(&mut White::black()).unwrap().is_some()));
            other.write_checkpoint(&path).unwrap();
            if name == "cells" {
                remove_last_cell(&path);
            }
            let mut failed = new(SMALL);
            assert!(failed.resume(&path).is_err());
            assert!(finish_training(failed) == finish_training(new(SMALL)), "{name}");
        }
    }

    /// Trains to the end and returns the field's bits.
    fn finish_training(mut trainer: Trainer) -> Vec<u32> {
        while trainer.step(&mut White::black()).unwrap().is_some() {}
        bits(&trainer.finish())
    }

    /// Removes the last cell of the occupancy grid from a checkpoint.
    fn remove_last_cell(path: &std::path::Path) {
        let bytes = std::fs::read(path).unwrap();
        let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let edited = tensors.iter().map(|(name, view)| {
            let (mut shape, mut data) = (view.shape().to_vec(), view.data().to_vec());
            if name == "occupied" {
                data.pop();
                shape = vec![data.len()];
            }
            (name.to_owned(), view.dtype(), shape, data)
        });
        let edited: Vec<_> = edited.collect();
        let views = edited.iter().map(|(name, kind, shape, data)| {
            (name, safetensors::tensor::TensorView::new(*kind, shape.clone(), data).unwrap())
        });
        std::fs::write(path, safetensors::serialize(views, None).unwrap()).unwrap();
    }

    /// Every SIMD family trains to equal bits, in a box with double strides and in the contraction
    /// with strides that depend on the cell.
    #[test]
    fn every_family_trains_to_equal_bits() {
        for (space, is_limited) in [(Space::Box, false), (Space::Contraction, true)] {
            let train = || {
                let mut field = Field::new(SMALL, cube(space), 5);
                if is_limited {
                    field.limit_to_occupied();
                }
                bits(&trained(field, 0.0, 1e-3, 40).0)
            };
            let best = train();
            test_every_family(|family| assert!(train() == best, "{family:?} in {space:?}"));
        }
    }

    /// A white floater before a white background has no colour error and stays; the floater loss
    /// removes the floater.
    #[test]
    fn floater_loss_removes_floaters_of_the_background_colour() {
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

use std::path::Path;
use std::sync::Mutex;

use counter_rng::uniform;
use rayon::prelude::*;
use safetensors::SafeTensors;

use crate::adam::{AdamStep, adam};
use crate::chunk::{Chunk, FeatureGradients, Roulette};
use crate::composite::Regularisers;
use crate::field::{CHUNK_RAYS, Field, FieldError, Tensor, read_f32, read_u8, write_tensors};
use crate::grid::scatter;
use crate::mlp::drain_lanes;
use crate::occupancy::{CELLS, Occupancy, Strides};
use crate::ray::{NormalizedRay, Ray, clip};
use crate::samples::DensityRows;
use crate::shading::{NetworkGradients, RayGradients};
use crate::simd::LANES;
use crate::tally::Tally;

/// Where a trainer's rays come from and how their colours are judged. Rays come in bundles that are
/// judged together: the s×s sub-pixel rays of an LR pixel are a pixel bundle.
pub trait Supervisor: Sync {
    /// Is told before every step which share of the training's rays is done, from which alone its
    /// bundles may change.
    fn set_progress(&mut self, _done: f64) {}
    /// Rays in a bundle of this step.
    fn rays_per_bundle(&self) -> usize;
    /// Casts the rays of a bundle. `bundle` counts from 0 over the whole training: draw from it
    /// alone.
    fn sample_rays(&self, bundle: u64, rays: &mut [Ray]);
    /// The bundle's loss, given its rays' colours; writes the loss's gradient by each colour.
    fn loss_and_gradient(
        &self,
        bundle: u64,
        colours: &[[f32; 3]],
        gradients: &mut [[f32; 3]],
    ) -> f64;
    /// Is given each bundle's colours again after a step that went well, in the order of the
    /// bundles: for a supervision that keeps what was rendered.
    fn remember(&mut self, _bundle: u64, _colours: &[[f32; 3]]) {}
}

/// How to train.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainingOptions {
    /// Rays in all.
    pub rays: u64,
    /// Most rays in a step.
    pub max_rays_per_step: usize,
    /// Samples that a step aims at; while space is full of semi-transparent density, steps have
    /// fewer rays.
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
    /// Weight of the distortion loss, the mean over all rays, beside the loss that supervision
    /// gives.
    pub distortion: f32,
    /// Weight of the floater loss, the mean over all rays: opacity that has the background's
    /// colour.
    pub floater_loss: f32,
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
    pub fn rays_of_step(&self, samples_per_ray: f64) -> usize {
        let wanted = (self.samples_per_step as f64 / samples_per_ray.max(0.1)) as usize;
        wanted.clamp(256, self.max_rays_per_step.max(256))
    }

    /// What learning rates are multiplied with in a step: they rise at first, and fall
    /// exponentially.
    pub fn schedule(&self, tally: &Tally) -> f64 {
        let warm = ((tally.steps + 1) as f64 / self.warm_up.max(1) as f64).min(1.0);
        tally.rate_scale * warm * self.learning_rate_decay.powf(tally.done(self.rays))
    }

    /// Share of a step by which the samples of a ray are shifted, by its number in the training.
    pub fn offset(&self, ray: u64) -> f32 {
        uniform(self.seed, 4, ray)
    }

    /// The draw of a chunk, by the number of its first ray.
    fn roulette(&self, ray: u64) -> Roulette {
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

/// What a step did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepReport {
    /// Mean loss of the bundles.
    pub loss: f64,
    /// Rays cast.
    pub rays: usize,
    /// Samples marched.
    pub samples: usize,
    /// Whether the step was thrown away, because something in it wasn't finite.
    pub skipped: bool,
}

/// A training that can't go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// Numbers went wrong twice within a hundred steps.
    #[error(
        "step {step}: {tensor} is not finite, for the second time within 100 steps; lower the rate"
    )]
    NotFinite {
        /// The step.
        step: u64,
        /// What wasn't finite.
        tensor: &'static str,
    },
}

/// Shards of a step: fixed, so that sums have one order at any thread count.
const SHARDS: usize = 32;
/// Steps between those of the weights' average, and the share of the rays after which it begins.
const AVERAGE_EVERY: u64 = 16;
const AVERAGE_FROM: f64 = 0.7;

/// Trains a [`Field`] by Adam.
pub struct Trainer {
    field: Field,
    options: TrainingOptions,
    first: Moments,
    second: Moments,
    gradients: Moments,
    /// Running average of the weights, once there is one.
    average: Option<Moments>,
    /// Blocks of each level's gradient that aren't 0.
    touched: Vec<Vec<u8>>,
    touched_network: Vec<u8>,
    transposed: Vec<f32>,
    tally: Tally,
    samples_per_ray: f64,
    shards: Vec<Shard>,
    workers: Mutex<Vec<Worker>>,
}

/// One number a parameter.
struct Moments {
    grid: Vec<f32>,
    network: Vec<f32>,
}

/// What a shard leaves for the sums.
#[derive(Default)]
struct Shard {
    colours: Vec<[f32; 3]>,
    features: FeatureGradients,
    network: Vec<f32>,
    loss: f64,
    samples: usize,
}

/// Buffers of one thread.
#[derive(Default)]
struct Worker {
    chunk: Chunk,
    lanes: Vec<f32>,
    rays: Vec<Ray>,
    clipped: Vec<NormalizedRay>,
    offsets: Vec<f32>,
    backgrounds: Vec<[f32; 3]>,
    colours: Vec<[f32; 3]>,
    gradients: Vec<[f32; 3]>,
}

impl Trainer {
    /// Starts from a field.
    pub fn new(field: Field, options: TrainingOptions) -> Self {
        let zeros = || Moments {
            grid: vec![0.0; field.grid.len()],
            network: vec![0.0; field.network.len()],
        };
        Self {
            first: zeros(),
            second: zeros(),
            gradients: zeros(),
            average: None,
            touched: field.levels.iter().map(|l| vec![0; l.blocks()]).collect(),
            touched_network: vec![0; field.network.len().div_ceil(LANES)],
            transposed: vec![0.0; field.network.len()],
            tally: Tally::default(),
            samples_per_ray: field.architecture.full_ray(),
            shards: (0..SHARDS).map(|_| Shard::default()).collect(),
            workers: Mutex::new(Vec::new()),
            field,
            options,
        }
    }

    /// The trained field: with the average of its weights, where one was kept.
    pub fn finish(self) -> Field {
        let mut field = self.field;
        if let Some(average) = self.average {
            (field.grid, field.network) = (average.grid, average.network);
        }
        field
    }

    /// The field as it is now.
    pub fn field(&self) -> &Field {
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
    ) -> Result<Option<StepReport>, TrainingError> {
        supervision.set_progress(self.tally.done(self.options.rays));
        let bundle = supervision.rays_per_bundle();
        let wanted = self.options.rays_of_step(self.samples_per_ray);
        let Some(bundles) = self.tally.bundles_of_step(self.options.rays, wanted, bundle) else {
            return Ok(None);
        };
        self.update_occupancy();
        for layer in self.field.layers.all() {
            layer.transpose(&self.field.network, &mut self.transposed);
        }

        let first_bundle = self.tally.bundles;
        let work = StepWork {
            field: &self.field,
            transposed: &self.transposed,
            supervision: &*supervision,
            options: &self.options,
            first_bundle,
            first_ray: self.tally.rays,
            bundles,
        };
        let workers = &self.workers;
        self.shards.par_iter_mut().enumerate().for_each(|(i, shard)| {
            let mut worker = lock(workers).pop().unwrap_or_default();
            shard.run(&mut worker, &work, bundles * i / SHARDS..bundles * (i + 1) / SHARDS);
            lock(workers).push(worker);
        });

        let samples: usize = self.shards.iter().map(|s| s.samples).sum();
        let loss = self.shards.iter().map(|s| s.loss).sum::<f64>() / bundles as f64;
        for shard in &self.shards {
            for (sum, g) in self.gradients.network.iter_mut().zip(&shard.network) {
                *sum += g;
            }
        }
        self.tally.count(bundles, bundle);
        self.samples_per_ray = samples as f64 / (bundles * bundle) as f64;
        let fault = self.fault(loss);
        if let Some(tensor) = fault {
            self.gradients.network.fill(0.0);
            if !self.tally.forgives() {
                return Err(TrainingError::NotFinite { step: self.tally.steps, tensor });
            }
        } else {
            self.apply();
            self.average();
            let colours = self.shards.iter().flat_map(|s| s.colours.chunks_exact(bundle));
            (first_bundle..)
                .zip(colours)
                .for_each(|(bundle, colours)| supervision.remember(bundle, colours));
        }
        self.tally.steps += 1;
        Ok(Some(StepReport { loss, rays: bundles * bundle, samples, skipped: fault.is_some() }))
    }

    /// What isn't finite, before anything has been changed by it.
    fn fault(&self, loss: f64) -> Option<&'static str> {
        let finite = |sum: f32| sum.is_finite();
        if !loss.is_finite() {
            Some("the loss")
        } else if !finite(self.gradients.network.iter().sum()) {
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

    fn apply(&mut self) {
        let options = &self.options;
        let (schedule, step) = (options.schedule(&self.tally), self.tally.steps + 1);
        let network_step =
            AdamStep::new(step, options.mlp_learning_rate * schedule, options.network_decay);
        // All of a network is touched, always.
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
        let mut work = Vec::with_capacity(self.field.levels.len());
        let mut grids = (
            &mut self.field.grid[..],
            &mut self.gradients.grid[..],
            &mut self.first.grid[..],
            &mut self.second.grid[..],
        );
        for ((i, level), touched) in self.field.levels.iter().enumerate().zip(&mut self.touched) {
            let len = level.range().len();
            let (w, rest_w) = grids.0.split_at_mut(len);
            let (g, rest_g) = grids.1.split_at_mut(len);
            let (m, rest_m) = grids.2.split_at_mut(len);
            let (v, rest_v) = grids.3.split_at_mut(len);
            grids = (rest_w, rest_g, rest_m, rest_v);
            work.push((i, level, touched, w, g, m, v));
        }
        // The finest levels cost most: begin with them.
        work.into_par_iter().rev().with_max_len(1).for_each(|(i, level, touched, w, g, m, v)| {
            for shard in shards {
                if let Some(gradients) = shard.features.levels.get(i) {
                    scatter(level, g, touched, &shard.features.positions, gradients);
                }
            }
            let rate = options.rate_of_level(i, schedule);
            adam(&AdamStep::new(step, rate, 0.0), touched, w, g, m, v);
        });
    }

    /// Late in the training, takes the weights into their average (Polyak): what is left of the
    /// steps' noise evens out.
    fn average(&mut self) {
        if !self.options.averages(&self.tally) {
            return;
        }
        let field = &self.field;
        let average = self.average.get_or_insert_with(|| Moments {
            grid: field.grid.clone(),
            network: field.network.clone(),
        });
        let new = 1.0 - self.options.ema_decay;
        let pairs = [(&mut average.grid, &field.grid), (&mut average.network, &field.network)];
        for (average, now) in pairs {
            average
                .par_iter_mut()
                .with_min_len(1 << 16)
                .zip(now)
                .for_each(|(a, w)| *a = new.mul_add(w - *a, *a));
        }
    }

    /// Looks at the density of cells where it is time to.
    fn update_occupancy(&mut self) {
        let (field, seed, at) = (&self.field, self.options.seed, self.tally.steps);
        let cells = field.occupancy.cells_to_update(at);
        let found = cells.par_chunks(1024).map_init(
            || (DensityRows::default(), vec![0.0; 3 * 1024]),
            |(rows, positions), cells| {
                let n = cells.len().next_multiple_of(LANES);
                for (k, &cell) in cells.iter().enumerate() {
                    let place = Occupancy::place_in(cell, seed, at);
                    (0..3).for_each(|axis| positions[axis * n + k] = place[axis]);
                }
                let mut found = vec![0.0; n];
                rows.densities(field, &positions[..3 * n], n, &mut found);
                found.truncate(cells.len());
                found
            },
        );
        let found: Vec<f32> = found.flatten_iter().collect();
        let step = field.step();
        self.field.occupancy.update(&cells, &found, step);
    }

    /// Writes all that a resumed training needs to end in the same bytes. The caller makes it
    /// atomic.
    pub fn write_checkpoint(&self, path: &Path) -> Result<(), FieldError> {
        let counters = self.tally.counters().into_iter().chain([self.samples_per_ray.to_bits()]);
        let counters: Vec<u8> = counters.flat_map(u64::to_le_bytes).collect();
        let occupied = self.field.occupancy.to_bytes();
        let average = self.average.iter();
        let average = average.flat_map(|a| {
            [("average.grid", Tensor::F32(&a.grid)), ("average.network", Tensor::F32(&a.network))]
        });
        let tensors: Vec<_> = average
            .chain([
                ("counters", Tensor::U8(&counters)),
                ("density", Tensor::F32(self.field.occupancy.density())),
                ("first.grid", Tensor::F32(&self.first.grid)),
                ("first.network", Tensor::F32(&self.first.network)),
                ("grid", Tensor::F32(&self.field.grid)),
                ("network", Tensor::F32(&self.field.network)),
                ("occupied", Tensor::U8(&occupied)),
                ("second.grid", Tensor::F32(&self.second.grid)),
                ("second.network", Tensor::F32(&self.second.network)),
            ])
            .collect();
        write_tensors(path, &tensors)
    }

    /// The step a checkpoint was written at.
    pub fn checkpoint_step(path: &Path) -> Result<u64, FieldError> {
        read_counters(path, |_, counters| Ok(counters[0]))
    }

    /// Goes on from a checkpoint of a trainer made with the same field and options.
    pub fn resume(&mut self, path: &Path) -> Result<(), FieldError> {
        read_counters(path, |tensors, counters| {
            let field = &mut self.field;
            let averaged = tensors.names().contains(&"average.grid");
            self.average = averaged.then(|| Moments {
                grid: vec![0.0; field.grid.len()],
                network: vec![0.0; field.network.len()],
            });
            if let Some(average) = &mut self.average {
                read_f32(tensors, "average.grid", &mut average.grid)?;
                read_f32(tensors, "average.network", &mut average.network)?;
            }
            for (name, into) in [
                ("first.grid", &mut self.first.grid),
                ("first.network", &mut self.first.network),
                ("grid", &mut field.grid),
                ("network", &mut field.network),
                ("second.grid", &mut self.second.grid),
                ("second.network", &mut self.second.network),
            ] {
                read_f32(tensors, name, into)?;
            }
            let mut density = vec![0.0; CELLS];
            read_f32(tensors, "density", &mut density)?;
            field.occupancy.restore(density, &read_u8(tensors, "occupied", CELLS)?);
            let [tally @ .., samples_per_ray] = counters;
            self.tally = Tally::from_counters(tally);
            self.samples_per_ray = f64::from_bits(samples_per_ray);
            Ok(())
        })
    }
}

/// Opens a checkpoint and reads its six counters.
fn read_counters<T>(
    path: &Path,
    then: impl FnOnce(&SafeTensors<'_>, [u64; 6]) -> Result<T, String>,
) -> Result<T, FieldError> {
    let bytes = std::fs::read(path)
        .map_err(|source| FieldError::Io { path: path.to_path_buf(), source })?;
    let read = || {
        let tensors = SafeTensors::deserialize(&bytes).map_err(|e| e.to_string())?;
        let counters = read_u8(&tensors, "counters", 48)?;
        then(&tensors, std::array::from_fn(|i| u64::from_le_bytes(counters.as_chunks::<8>().0[i])))
    };
    read().map_err(|reason| FieldError::Format { path: path.to_path_buf(), reason })
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// What all shards of a step read.
struct StepWork<'a, S> {
    field: &'a Field,
    /// The networks' weights output by output.
    transposed: &'a [f32],
    supervision: &'a S,
    options: &'a TrainingOptions,
    first_bundle: u64,
    first_ray: u64,
    /// Bundles of the step.
    bundles: usize,
}

impl Shard {
    /// Takes a range of the step's bundles forward and back.
    fn run(
        &mut self,
        worker: &mut Worker,
        work: &StepWork<'_, impl Supervisor>,
        range: std::ops::Range<usize>,
    ) {
        self.colours.clear();
        self.features.clear();
        self.network.resize(work.field.network.len(), 0.0);
        self.network.fill(0.0);
        (self.loss, self.samples) = (0.0, 0);
        worker.lanes.resize(work.field.network.len() * LANES, 0.0);
        let chunk_bundles = (CHUNK_RAYS / work.supervision.rays_per_bundle()).max(1);
        let mut next = range.start;
        while next < range.end {
            let here = next..(next + chunk_bundles).min(range.end);
            next = here.end;
            self.run_chunk(worker, work, here);
        }
        drain_lanes(&mut worker.lanes, &mut self.network);
    }

    /// Takes a few bundles forward and back.
    fn run_chunk(
        &mut self,
        worker: &mut Worker,
        work: &StepWork<'_, impl Supervisor>,
        here: std::ops::Range<usize>,
    ) {
        let StepWork { field, supervision, options, .. } = *work;
        let bundle = supervision.rays_per_bundle();
        let rays = here.len() * bundle;
        worker.rays.resize(rays, Ray::default());
        worker.colours.resize(rays, [0.0; 3]);
        worker.gradients.resize(rays, [0.0; 3]);
        let numbers = here.clone().map(|g| work.first_bundle + g as u64);
        for (number, rays) in numbers.clone().zip(worker.rays.chunks_exact_mut(bundle)) {
            supervision.sample_rays(number, rays);
        }
        worker.clipped.clear();
        worker.clipped.extend(worker.rays.iter().map(|r| clip(&field.bounds, r)));
        worker.backgrounds.clear();
        worker.backgrounds.extend(worker.rays.iter().map(|r| r.background));
        let first_ray = work.first_ray + (here.start * bundle) as u64;
        worker.offsets.clear();
        worker.offsets.extend((0..rays as u64).map(|r| options.offset(first_ray + r)));
        worker.chunk.forward(field, &worker.clipped, &worker.offsets, Strides::ByCell);
        self.samples += worker.chunk.samples();
        for (colour, (sum, background)) in
            worker.colours.iter_mut().zip(worker.chunk.sums.iter().zip(&worker.backgrounds))
        {
            *colour =
                std::array::from_fn(|c| sum.transmittance.mul_add(background[c], sum.colour[c]));
        }
        let judged =
            worker.colours.chunks_exact(bundle).zip(worker.gradients.chunks_exact_mut(bundle));
        for (number, (colours, gradients)) in numbers.zip(judged) {
            self.loss += supervision.loss_and_gradient(number, colours, gradients);
        }
        self.colours.extend_from_slice(&worker.colours);
        let scale = 1.0 / work.bundles as f32;
        worker.gradients.iter_mut().flatten().for_each(|g| *g *= scale);
        let of_ray = |weight: f32| weight * scale / bundle as f32;
        let regularisers = Regularisers {
            distortion: of_ray(options.distortion),
            floater_loss: of_ray(options.floater_loss),
        };
        let towards = RayGradients {
            colours: &worker.gradients,
            backgrounds: &worker.backgrounds,
            regularisers,
        };
        let mut network =
            NetworkGradients { transposed: work.transposed, lanes: &mut worker.lanes };
        worker.chunk.backward(
            field,
            towards,
            options.roulette(first_ray),
            &mut network,
            &mut self.features,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Architecture;
    use counter_rng::CounterRng;
    use scene::Bounds;

    /// Rays through the cube, before black or white, that should all be white.
    struct White {
        background: f32,
    }

    impl Supervisor for White {
        fn rays_per_bundle(&self) -> usize {
            1
        }

        fn sample_rays(&self, bundle: u64, rays: &mut [Ray]) {
            let mut rng = CounterRng::new(1, 2, bundle);
            let [x, y] = [0, 1].map(|_| 1.6 * rng.uniform() - 0.8);
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

    /// A white floater before white is as good as nothing to the images, and stays; by the floater
    /// loss it goes.
    #[test]
    fn what_passes_for_the_background_goes() {
        let architecture = Architecture {
            finest: 32,
            levels: 4,
            log2_entries: 10,
            hidden: 16,
            steps: 64,
            ..Architecture::default()
        };
        let bounds =
            Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.5, far: 9.0, ..Bounds::default() };
        let trained = |field: Field, background: f32, floater_loss: f32, steps: u64| {
            let options = TrainingOptions {
                rays: steps * 256,
                max_rays_per_step: 256,
                samples_per_step: 1 << 20,
                learning_rate: 1e-2,
                level_rate: 0.8,
                mlp_learning_rate: 1e-2,
                learning_rate_decay: 0.25,
                warm_up: 5,
                ema_decay: 0.0,
                distortion: 0.0,
                floater_loss,
                network_decay: 0.0,
                roulette: 1.0,
                seed: 9,
            };
            let (mut trainer, mut white) = (Trainer::new(field, options), White { background });
            while trainer.step(&mut white).unwrap().is_some() {}
            let mut rays = [Ray::default(); 64];
            (0..)
                .zip(&mut rays)
                .for_each(|(bundle, ray)| white.sample_rays(bundle, std::slice::from_mut(ray)));
            let field = trainer.finish();
            let opacity = field.render(&rays).iter().map(|pixel| pixel.opacity).sum::<f32>() / 64.0;
            (field, opacity)
        };
        let (floater, opacity) = trained(Field::new(architecture, bounds, 5), 0.0, 0.0, 40);
        let ((_, without), (_, with)) =
            (trained(floater.clone(), 1.0, 0.0, 200), trained(floater, 1.0, 1e-3, 200));
        println!(
            "opacity {opacity} before black, then before white {without}, with the floater loss \
            {with}"
        );
        assert!(opacity > 0.5 && without > 0.5 * opacity && with < 0.1 * without);
    }
}

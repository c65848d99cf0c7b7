use std::ops::Range;

use super::options::{Supervisor, TrainingOptions};
use super::step::Step;
use crate::chunk::{CHUNK_RAYS, Chunk, FeatureGradients};
use crate::field::Field;
use crate::grid::arrange_in_rows;
use crate::occupancy::CellHit;
use crate::ray::{NormalizedRay, Ray, clip};
use crate::shading::{NetworkGradients, RayGradients};
use crate::spec::Strides;

/// Inputs shared by all shards of a step.
pub(super) struct StepWork<'a, S> {
    pub(super) field: &'a Field,
    /// Transposed weights of the networks.
    pub(super) transposed: &'a [f32],
    pub(super) supervisor: &'a S,
    pub(super) options: &'a TrainingOptions,
    pub(super) strides: Strides,
    pub(super) step: Step,
}

/// Result of a shard; buffers are reused.
#[derive(Default)]
pub(super) struct ShardResult {
    pub(super) colours: Vec<[f32; 3]>,
    pub(super) features: FeatureGradients,
    pub(super) network_gradients: Vec<f32>,
    pub(super) loss: f64,
    pub(super) samples: usize,
    /// Densities and cells of samples that stop light.
    pub(super) hits: Vec<CellHit>,
    pub(super) has_finite_grid_gradients: bool,
}

/// Buffers of one thread.
#[derive(Default)]
pub(super) struct Worker {
    chunk: Chunk,
    rays: Vec<Ray>,
    clipped: Vec<NormalizedRay>,
    offsets: Vec<f32>,
    backgrounds: Vec<[f32; 3]>,
    colours: Vec<[f32; 3]>,
    gradients: Vec<[f32; 3]>,
}

impl ShardResult {
    /// Runs the forward and backward pass of a range of the step's bundles.
    pub(super) fn run(
        &mut self,
        worker: &mut Worker,
        work: &StepWork<'_, impl Supervisor>,
        range: Range<usize>,
    ) {
        self.colours.clear();
        self.features.clear();
        self.hits.clear();
        self.network_gradients.resize(work.field.network.len(), 0.0);
        self.network_gradients.fill(0.0);
        (self.loss, self.samples) = (0.0, 0);
        let chunk_bundles = (CHUNK_RAYS / work.step.rays_per_bundle).max(1);
        let mut next = range.start;
        while next < range.end {
            let bundles = next..(next + chunk_bundles).min(range.end);
            next = bundles.end;
            self.run_chunk(worker, work, bundles);
        }
        arrange_in_rows(&self.features.positions, &mut self.features.rows);
        let gradients = self.features.levels.iter().flatten().flatten();
        self.has_finite_grid_gradients = gradients.fold(true, |all, g| all & g.is_finite());
    }

    /// Runs the forward and backward pass of a chunk's bundles.
    fn run_chunk(
        &mut self,
        worker: &mut Worker,
        work: &StepWork<'_, impl Supervisor>,
        bundles: Range<usize>,
    ) {
        let StepWork { field, supervisor, options, step, .. } = *work;
        let rays_per_bundle = step.rays_per_bundle;
        let ray_count = bundles.len() * rays_per_bundle;
        worker.colours.resize(ray_count, [0.0; 3]);
        worker.gradients.resize(ray_count, [0.0; 3]);
        step.sample_rays(supervisor, &bundles, &mut worker.rays);
        worker.clipped.clear();
        worker.clipped.extend(worker.rays.iter().map(|r| clip(&field.bounds, r)));
        worker.backgrounds.clear();
        worker.backgrounds.extend(worker.rays.iter().map(|r| r.background));
        let first_ray = step.first_ray_of(&bundles);
        worker.offsets.clear();
        worker.offsets.extend((0..ray_count as u64).map(|r| options.offset(first_ray + r)));
        worker.chunk.forward(field, &worker.clipped, &worker.offsets, work.strides);
        let Chunk { samples, counted, .. } = &worker.chunk;
        self.samples += samples.count;
        samples.list_hits(counted, field.march_step(), &mut self.hits);
        for (r, sum) in worker.chunk.sums.iter().enumerate() {
            let background = worker.backgrounds[r];
            worker.colours[r] =
                std::array::from_fn(|c| sum.transmittance.mul_add(background[c], sum.colour[c]));
        }
        let first_bundle = step.first_bundle_of(&bundles);
        for (i, colours) in worker.colours.chunks_exact(rays_per_bundle).enumerate() {
            let gradients = &mut worker.gradients[i * rays_per_bundle..][..rays_per_bundle];
            self.loss += supervisor.loss_and_gradient(first_bundle + i as u64, colours, gradients);
        }
        self.colours.extend_from_slice(&worker.colours);
        let scale = 1.0 / step.bundles as f32;
        for gradient in worker.gradients.iter_mut().flatten() {
            *gradient *= scale;
        }
        let upstream = RayGradients {
            colours: &worker.gradients,
            backgrounds: &worker.backgrounds,
            regularisers: options.regularisers.per_ray(scale, rays_per_bundle),
        };
        let mut network =
            NetworkGradients { transposed: work.transposed, sums: &mut self.network_gradients };
        worker.chunk.backward(
            field,
            upstream,
            options.roulette(first_ray),
            &mut network,
            &mut self.features,
        );
    }
}

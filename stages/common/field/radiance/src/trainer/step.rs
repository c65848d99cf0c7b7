use std::ops::Range;

use super::options::{RenderedBundles, Supervisor};
use super::phases::PhaseClock;
use crate::ray::Ray;
use crate::training_state::TrainingState;

/// One training step of some bundles of rays. Bundles and rays are numbered through the training.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// Number of the first bundle.
    pub first_bundle: u64,
    /// Number of the first ray.
    pub first_ray: u64,
    /// Number of bundles.
    pub bundles: usize,
    /// Number of rays of a bundle.
    pub rays_per_bundle: usize,
}

impl Step {
    /// Sets the supervisor's progress and returns the step that follows those counted in `state`;
    /// `None` after the last step. `rays` is the number of rays of the training run, `target_rays`
    /// that of the step.
    pub fn start(
        state: &TrainingState,
        supervisor: &mut impl Supervisor,
        rays: u64,
        target_rays: usize,
    ) -> Option<Self> {
        supervisor.set_progress(state.progress(rays));
        let rays_per_bundle = supervisor.rays_per_bundle();
        let remaining = rays.saturating_sub(state.rays) as usize / rays_per_bundle;
        (remaining > 0).then(|| Self {
            first_bundle: state.bundles,
            first_ray: state.rays,
            bundles: (target_rays / rays_per_bundle).clamp(1, remaining),
            rays_per_bundle,
        })
    }

    /// Returns the number of rays of the step.
    pub fn rays(self) -> usize {
        self.bundles * self.rays_per_bundle
    }

    /// Returns the number of the first bundle of a range of the step's bundles.
    pub fn first_bundle_of(self, range: &Range<usize>) -> u64 {
        self.first_bundle + range.start as u64
    }

    /// Returns the number of the first ray of a range of the step's bundles.
    pub fn first_ray_of(self, range: &Range<usize>) -> u64 {
        self.first_ray + (range.start * self.rays_per_bundle) as u64
    }

    /// Samples the rays of a range of the step's bundles.
    pub fn sample_rays(
        self,
        supervisor: &impl Supervisor,
        range: &Range<usize>,
        rays: &mut Vec<Ray>,
    ) {
        rays.resize(range.len() * self.rays_per_bundle, Ray::default());
        let bundles = rays.chunks_exact_mut(self.rays_per_bundle);
        for (bundle, rays) in (self.first_bundle_of(range)..).zip(bundles) {
            supervisor.sample_rays(bundle, rays);
        }
    }

    /// Passes the rendered colours of consecutive bundles to the supervisor.
    pub fn record_colours<'a>(
        self,
        supervisor: &mut impl Supervisor,
        colours: impl Iterator<Item = &'a Vec<[f32; 3]>>,
        clock: &PhaseClock,
    ) {
        let mut first_bundle = self.first_bundle;
        let mut rendered = Vec::new();
        for colours in colours {
            rendered.push(RenderedBundles { first_bundle, colours });
            first_bundle += (colours.len() / self.rays_per_bundle) as u64;
        }
        supervisor.record_colours(&rendered, clock);
    }
}

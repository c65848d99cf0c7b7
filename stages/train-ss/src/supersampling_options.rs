use pixels::Filter;

use crate::hr_cache::HrCache;
use crate::photographs::Photographs;
use crate::pixel_sampler::Order;
use crate::sub_pixel_rays::rays_per_side;
use crate::supervision::Supervision;

/// How to supersample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SupersamplingOptions {
    /// What is compared.
    pub supervision: Supervision,
    /// Size of the HR images that the field is to render, over that of the LR ones, per axis.
    pub scale: [f64; 2],
    /// The filter that made the LR images.
    pub filter: Filter,
    /// Share of the training during which fewer sub-pixel rays are cast.
    pub supersample_warmup: f64,
    /// In which order pixels are drawn.
    pub order: Order,
    /// Pixels at the start that come from the middle half of each image's width and height alone.
    pub precrop_bundles: u64,
    /// How many times as often a pixel with detail is drawn as a flat one, in random order.
    pub pixel_importance: f64,
    /// Whether to find each photograph's exposure.
    pub exposure: bool,
    /// Whether to move cameras to where photographs are met best.
    pub pose_refinement: bool,
    /// Seed of what is drawn.
    pub seed: u64,
}

impl SupersamplingOptions {
    /// Size of the HR images for an LR size, (width, height).
    pub(crate) fn hr_size(&self, (width, height): (usize, usize)) -> (usize, usize) {
        let length =
            |length: usize, i: usize| ((length as f64 * self.scale[i]).round() as usize).max(1);
        (length(width, 0), length(height, 1))
    }

    /// Whether HR pixels of LR photographs of such sizes are cached: of all, where the kernel of
    /// one asks for it.
    pub(crate) fn needs_cache(&self, mut lr_sizes: impl Iterator<Item = (usize, usize)>) -> bool {
        let is_needed = |lr| HrCache::is_needed(self.filter, self.hr_size(lr), lr);
        self.supervision == Supervision::Kernel && lr_sizes.any(is_needed)
    }

    /// Sub-pixel rays along x and y: no more than the smallest view has HR pixels.
    pub(crate) fn full_side(
        &self,
        photographs: &Photographs,
        references: Option<&Photographs>,
    ) -> [usize; 2] {
        let lr =
            photographs.images.iter().map(|image| self.hr_size((image.width(), image.height())));
        let hr =
            references.iter().flat_map(|r| &r.images).map(|image| (image.width(), image.height()));
        let smallest = lr.chain(hr).reduce(|a, b| (a.0.min(b.0), a.1.min(b.1))).unwrap_or((1, 1));
        let side = |scale: f64, most: usize| (rays_per_side(scale) as usize).clamp(1, most);
        [side(self.scale[0], smallest.0), side(self.scale[1], smallest.1)]
    }
}

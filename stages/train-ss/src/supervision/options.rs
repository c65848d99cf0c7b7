use pixels::Filter;

use crate::params::{Resolved, Supervision};
use crate::photographs::{PackedPhotograph, Photographs};
use crate::state::HrCache;
use crate::supersample::whole_supersample;

/// Options of supersampling.
#[derive(Clone, Debug)]
pub(crate) struct SupersamplingOptions {
    pub params: Resolved,
    /// Filter that made the LR images.
    pub filter: Filter,
}

impl SupersamplingOptions {
    /// Returns the size of the HR images for an LR size, (width, height).
    pub(crate) fn hr_size(&self, (width, height): (usize, usize)) -> (usize, usize) {
        let [width, height] = [width, height]
            .map(|length| ((length as f64 * self.params.supersample).round() as usize).max(1));
        (width, height)
    }

    /// True if HR pixels of the LR photographs are cached: of all photographs if the kernel needs
    /// them at the size of one.
    pub(crate) fn needs_cache(&self, mut lr_sizes: impl Iterator<Item = (usize, usize)>) -> bool {
        self.params.supervision == Supervision::Kernel
            && lr_sizes.any(|lr| HrCache::is_needed(self.filter, self.hr_size(lr), lr))
    }

    /// Returns the number of sub-pixel rays along x and y, at most the least width and height of
    /// any view in HR pixels.
    pub(crate) fn supersample_within(
        &self,
        photographs: &Photographs,
        references: Option<&Photographs>,
    ) -> [usize; 2] {
        let lr = photographs.images.iter().map(|image| self.hr_size(image.size()));
        let hr = references.into_iter().flat_map(|r| &r.images).map(PackedPhotograph::size);
        let (width, height) =
            lr.chain(hr).reduce(|a, b| (a.0.min(b.0), a.1.min(b.1))).unwrap_or((1, 1));
        let supersample = whole_supersample(self.params.supersample) as usize;
        [supersample.clamp(1, width), supersample.clamp(1, height)]
    }
}

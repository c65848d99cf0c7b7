use std::path::PathBuf;

use artifact::{Failure, sized};
use scene::{Background, View, Views};
use stage::{MEMORY_REMEDY, remaining_memory};

use crate::packed::PixelMemory;
use crate::resolve::{Resolved, ResolvedField};
use crate::supersampling_options::SupersamplingOptions;

/// The memory that a training needs at its peak, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct MemoryNeed {
    /// The field, all that its optimiser keeps, and the copy that a checkpoint is written from.
    pub(crate) field: u64,
    /// Photographs as they are kept, and the field's HR pixels: in memory, or in a file where they
    /// are too many.
    pub(crate) pixels: u64,
    /// Photographs as pose refinement compares them.
    pub(crate) poses: u64,
    /// What reading the largest photograph takes, before there is a field.
    pub(crate) reading: u64,
}

/// Bytes of pixels that are kept in memory at most, so that a stage with many photographs leaves
/// place for other programs.
const MOST_PIXEL_BYTES: u64 = 4_000_000_000;
/// Bytes of the program, with libtorch and without it.
const PROGRAM_BYTES: u64 = if cfg!(feature = "torch") { 150_000_000 } else { 30_000_000 };
/// Numbers a parameter of the grid: it, its gradient, two moments, an average.
const NUMBERS_PER_PARAMETER: u64 = 5;
/// Numbers a parameter that a checkpoint copies: all but the gradient.
const COPIED_PER_PARAMETER: u64 = 4;
/// Bytes a pixel of a photograph in floats, RGBA.
const BYTES_PER_FLOAT_PIXEL: u64 = 16;
/// Bytes a pixel of its pyramid in floats, RGB: 1 + 1/4 + 1/16 + …, and of the photograph that is
/// compared at the end.
const BYTES_PER_PYRAMID_PIXEL: u64 = 16 + 12;

impl MemoryNeed {
    /// Of a training with such a field on such views. `references` are HR; `has_checkpoints` says
    /// whether it writes any.
    pub(crate) fn of(
        params: &Resolved,
        options: &SupersamplingOptions,
        views: &Views,
        references: &[View],
        has_checkpoints: bool,
    ) -> Self {
        let mut need = Self { field: field(params, has_checkpoints), ..Self::default() };
        let packed = if views.background == Background::Opaque { 3 } else { 4 };
        let needs_cache = options.needs_cache(views.views.iter().map(image_size));
        for (view, is_reference) in
            views.views.iter().map(|v| (v, false)).chain(references.iter().map(|v| (v, true)))
        {
            let size = image_size(view);
            let (pixels, hr) = ((size.0 * size.1) as u64, options.hr_size(size));
            let is_cached = needs_cache && !is_reference;
            let cached = if is_cached { (hr.0 * hr.1) as u64 } else { 0 };
            // A bit a pixel for its mask and one for its detail.
            need.pixels += packed * pixels + pixels / 4 + 3 * cached;
            // As floats twice, or as floats, enlarged along one axis and both, and in 8 bits.
            let enlarging =
                if is_cached { 12 * (hr.0 * size.1) as u64 + (12 + 3) * cached } else { 0 };
            need.reading = need.reading.max((BYTES_PER_FLOAT_PIXEL + 12) * pixels + enlarging);
            if options.pose_refinement {
                need.poses += BYTES_PER_PYRAMID_PIXEL * pixels;
            }
        }
        need
    }

    /// What it needs with all pixels in a file.
    fn least(&self) -> u64 {
        PROGRAM_BYTES + self.poses + self.field.max(self.reading)
    }

    /// Where pixels go when so much memory is free: into memory as far as there is place, and then
    /// into a file in `folder`.
    pub(crate) fn plan(&self, free: Option<u64>, folder: PathBuf) -> Result<PixelMemory, Failure> {
        let left = remaining_memory("the training", self.least(), free, MEMORY_REMEDY)?;
        Ok(PixelMemory::new(MOST_PIXEL_BYTES.min(left), folder))
    }

    /// What it comes to, for people, where so many bytes of pixels may be in memory.
    pub(crate) fn in_words(&self, budget: u64) -> String {
        let in_memory = self.pixels.min(budget);
        let total = sized(self.least() + in_memory);
        let field = sized(self.field);
        let pixels = sized(in_memory);
        match self.pixels.saturating_sub(budget) {
            0 => format!(
                "memory: about {total}, of it {field} for the field and {pixels} for pixels"
            ),
            rest => {
                let rest = sized(rest);
                format!(
                    "memory: about {total}, of it {field} for the field and {pixels} for pixels; \
                    {rest} of pixels go into a file"
                )
            }
        }
    }
}

/// Width and height of a view's image.
fn image_size(view: &View) -> (usize, usize) {
    let k = view.camera.intrinsics;
    (k.width as usize, k.height as usize)
}

/// Memory of the field, its optimiser and its checkpoints.
fn field(params: &Resolved, has_checkpoints: bool) -> u64 {
    match &params.field {
        ResolvedField::Grid { architecture, .. } => {
            let copied = if has_checkpoints { COPIED_PER_PARAMETER } else { 0 };
            4 * (NUMBERS_PER_PARAMETER + copied) * architecture.grid_len() as u64
        }
        // At least: what libtorch takes for a step doesn't show in the networks' size.
        ResolvedField::Mlp { .. } => 500_000_000,
    }
}

#[cfg(test)]
mod tests {
    use pixels::Filter;
    use scene::{Bounds, Camera, Intrinsics};

    use super::*;
    use crate::pixel_sampler::Order;
    use crate::supervision::Supervision;
    use crate::{Params, SceneFacts};

    fn camera(i: usize) -> Camera {
        Camera {
            name: i.to_string(),
            intrinsics: Intrinsics::from_angle_x(2000, 1500, 0.7),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 4.]],
        }
    }

    fn need(images: usize, filter: Filter, pose_refinement: bool) -> MemoryNeed {
        let bounds =
            Bounds { min: [-1.0; 3], max: [1.0; 3], near: 2.0, far: 6.0, ..Bounds::default() };
        let views = Views::new(
            Background::Opaque,
            bounds,
            (0..images).map(|i| View::camera_only(camera(i))).collect(),
        );
        let params = Params::default().resolve(&SceneFacts::of(&views, true));
        let options = SupersamplingOptions {
            supervision: Supervision::Kernel,
            scale: [2.0; 2],
            filter,
            supersample_warmup: 0.0,
            order: Order::Random,
            precrop_bundles: 0,
            pixel_importance: 7.0,
            exposure: false,
            pose_refinement,
            seed: 1,
        };
        MemoryNeed::of(&params, &options, &views, &[], false)
    }

    /// Images of three megapixels: three bytes a pixel, twelve more where HR pixels are cached, two
    /// bits besides.
    #[test]
    fn pixels_take_what_their_kernel_asks_for() {
        for (filter, bytes) in [(Filter::Box, 3), (Filter::Lanczos, 15)] {
            let [few, many] = [10, 40].map(|images| need(images, filter, false));
            assert_eq!(few.pixels, 10 * 3_000_000 * bytes + 10 * 750_000);
            assert_eq!(
                (many.pixels, many.field, many.reading),
                (4 * few.pixels, few.field, few.reading)
            );
            assert_eq!(
                (few.poses, need(10, filter, true).poses),
                (0, 10 * 3_000_000 * BYTES_PER_PYRAMID_PIXEL)
            );
        }
    }

    /// As many pixels stay in memory as there is place for, and where the rest has none, both
    /// numbers are said.
    #[test]
    fn little_memory_sends_pixels_to_a_file() {
        let need = MemoryNeed {
            field: 300_000_000,
            pixels: 5_000_000_000,
            poses: 0,
            reading: 100_000_000,
        };
        let least = PROGRAM_BYTES + 300_000_000;
        let budget = |free| need.plan(free, PathBuf::new()).map(|memory| memory.left());
        assert_eq!(budget(None).unwrap(), MOST_PIXEL_BYTES);
        assert_eq!(budget(Some(least + 77)).unwrap(), 77);
        let said = budget(Some(least - 1_000_000)).unwrap_err().to_string();
        let [needed, free] = [least, least - 1_000_000].map(sized);
        assert_eq!(
            said,
            format!("the training needs {needed} of memory, and {free} are free; {MEMORY_REMEDY}")
        );
        let total = sized(least + MOST_PIXEL_BYTES);
        assert_eq!(
            need.in_words(MOST_PIXEL_BYTES),
            format!(
                "memory: about {total}, of it 300.0 MB for the field and 4.0 GB for pixels; 1.0 \
                GB of pixels go into a file"
            )
        );
        let total = sized(least + 2_000_000);
        assert_eq!(
            MemoryNeed { pixels: 2_000_000, ..need }.in_words(MOST_PIXEL_BYTES),
            format!("memory: about {total}, of it 300.0 MB for the field and 2.0 MB for pixels")
        );
    }
}

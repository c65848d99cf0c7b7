use std::path::PathBuf;

use artifact::{Failure, format_size};
use scene::{Background, View, Views};
use stage::{MEMORY_REMEDY, remaining_memory};

use super::options::SupersamplingOptions;
use crate::params::{Resolved, ResolvedField};
use crate::photographs::PixelMemory;

/// Peak memory of training, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct MemoryNeed {
    /// Field, optimiser state, and the copy that a checkpoint is written from.
    pub(crate) field: u64,
    /// Packed photographs and cached HR pixels, in memory or in the pixel file.
    pub(crate) pixels: u64,
    /// Photographs in the form that pose refinement compares.
    pub(crate) poses: u64,
    /// Buffers for reading the largest photograph, which are freed before the field is created.
    pub(crate) reading: u64,
}

/// Maximum bytes of pixels in memory, so that a stage with many photographs leaves memory to other
/// programs (design note 038).
const MAX_PIXEL_BYTES: u64 = 4_000_000_000;
/// Bytes of the program itself, with and without libtorch.
const PROGRAM_BYTES: u64 = if cfg!(feature = "torch") { 150_000_000 } else { 30_000_000 };
/// Floats per parameter of the grid: value, gradient, two moments, moving average.
const FLOATS_PER_PARAMETER: u64 = 5;
/// Floats per parameter that a checkpoint copies: all but the gradient.
const COPIED_FLOATS_PER_PARAMETER: u64 = 4;
/// Bytes per RGBA pixel of a photograph in floats.
const BYTES_PER_RGBA_PIXEL: u64 = 16;
/// Bytes per RGB pixel of a photograph in floats.
const BYTES_PER_RGB_PIXEL: u64 = 12;
/// Bytes per pixel of a photograph's pyramid (RGB floats, 1 + 1/4 + 1/16 + …) and of the photograph
/// for the final comparison of poses.
const BYTES_PER_PYRAMID_PIXEL: u64 = 16 + BYTES_PER_RGB_PIXEL;
/// Minimum bytes of the paper's MLPs; libtorch's buffers of a step aren't known in advance.
const MIN_MLP_BYTES: u64 = 500_000_000;

impl MemoryNeed {
    /// Estimates the memory of training with HR `references`, with or without checkpoints.
    pub(crate) fn of(
        options: &SupersamplingOptions,
        views: &Views,
        references: &[View],
        has_checkpoints: bool,
    ) -> Self {
        let mut need =
            Self { field: field_bytes(&options.params, has_checkpoints), ..Self::default() };
        let packed = if views.background == Background::Opaque { 3 } else { 4 };
        let needs_cache = options.needs_cache(views.views.iter().map(image_size));
        for (i, view) in views.views.iter().chain(references).enumerate() {
            let (width, height) = image_size(view);
            let (hr_width, hr_height) = options.hr_size((width, height));
            let pixels = (width * height) as u64;
            let mut reading = (BYTES_PER_RGBA_PIXEL + BYTES_PER_RGB_PIXEL) * pixels;
            // One bit per pixel for the mask and one for its detail.
            need.pixels += packed * pixels + pixels / 4;
            let is_reference = i >= views.views.len();
            if needs_cache && !is_reference {
                let cached = (hr_width * hr_height) as u64;
                need.pixels += 3 * cached;
                // Enlarged along one axis, then along both, in floats and in 8 bits.
                reading += BYTES_PER_RGB_PIXEL * (hr_width * height) as u64
                    + (BYTES_PER_RGB_PIXEL + 3) * cached;
            }
            need.reading = need.reading.max(reading);
            if options.params.pose_refinement {
                need.poses += BYTES_PER_PYRAMID_PIXEL * pixels;
            }
        }
        need
    }

    /// Returns the need with all pixels in the file.
    fn minimum(&self) -> u64 {
        PROGRAM_BYTES + self.poses + self.field.max(self.reading)
    }

    /// Creates the storage of pixels for the given free memory, with a file in `folder`. Fails if
    /// less is free than the minimum.
    pub(crate) fn plan(&self, free: Option<u64>, folder: PathBuf) -> Result<PixelMemory, Failure> {
        let left = remaining_memory("the training", self.minimum(), free, MEMORY_REMEDY)?;
        Ok(PixelMemory::new(MAX_PIXEL_BYTES.min(left), folder))
    }

    /// Describes the need with at most `budget` bytes of pixels in memory.
    pub(crate) fn describe(&self, budget: u64) -> String {
        let in_memory = self.pixels.min(budget);
        let mut text = format!(
            "memory: about {}, of which {} for the field and {} for pixels",
            format_size(self.minimum() + in_memory),
            format_size(self.field),
            format_size(in_memory)
        );
        if self.pixels > budget {
            text += &format!("; {} of pixels in a file", format_size(self.pixels - budget));
        }
        text
    }
}

/// Returns the size of a view's image, (width, height).
fn image_size(view: &View) -> (usize, usize) {
    let k = view.camera.intrinsics;
    (k.width as usize, k.height as usize)
}

/// Returns the bytes of the field, its optimiser and its checkpoints.
fn field_bytes(params: &Resolved, has_checkpoints: bool) -> u64 {
    match &params.field {
        ResolvedField::Grid { architecture, .. } => {
            let copied = if has_checkpoints { COPIED_FLOATS_PER_PARAMETER } else { 0 };
            4 * (FLOATS_PER_PARAMETER + copied) * architecture.grid_len() as u64
        }
        ResolvedField::Mlp { .. } => MIN_MLP_BYTES,
    }
}

#[cfg(test)]
mod tests {
    use pixels::Filter;
    use scene::{Bounds, Camera, Intrinsics};

    use super::*;
    use crate::params::{Params, SceneFacts};

    fn camera(i: usize) -> Camera {
        Camera {
            name: i.to_string(),
            intrinsics: Intrinsics::from_angle_x(2000, 1500, 0.7),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 4.]],
        }
    }

    fn need(images: usize, filter: Filter, pose_refinement: bool) -> MemoryNeed {
        let bounds = Bounds::cube(1.0, 2.0, 6.0);
        let views = Views::new(
            Background::Opaque,
            bounds,
            (0..images).map(|i| View::camera_only(camera(i))).collect(),
        );
        let params =
            Params { pose_refinement, ..Params::default() }.resolve(&SceneFacts::of(&views, true));
        let options = SupersamplingOptions { params, filter };
        MemoryNeed::of(&options, &views, &[], false)
    }

    /// Images of three megapixels: three bytes a pixel and two bits, and twelve more bytes if HR
    /// pixels are cached.
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

    /// Pixels stay in memory as far as it suffices; an error names the need and the free memory.
    #[test]
    fn little_memory_sends_pixels_to_a_file() {
        let need = MemoryNeed {
            field: 300_000_000,
            pixels: 5_000_000_000,
            poses: 0,
            reading: 100_000_000,
        };
        let minimum = PROGRAM_BYTES + 300_000_000;
        let budget = |free| need.plan(free, PathBuf::new()).map(|memory| memory.left());
        assert_eq!(budget(None).unwrap(), MAX_PIXEL_BYTES);
        assert_eq!(budget(Some(minimum + 77)).unwrap(), 77);
        let message = budget(Some(minimum - 1_000_000)).unwrap_err().to_string();
        let [needed, free] = [minimum, minimum - 1_000_000].map(format_size);
        assert!(message.contains(&needed) && message.contains(&free), "{message}");
        let total = format_size(minimum + MAX_PIXEL_BYTES);
        assert_eq!(
            need.describe(MAX_PIXEL_BYTES),
            format!(
                "memory: about {total}, of which 300.0 MB for the field and 4.0 GB for pixels; \
                1.0 GB of pixels in a file"
            )
        );
        let total = format_size(minimum + 2_000_000);
        assert_eq!(
            MemoryNeed { pixels: 2_000_000, ..need }.describe(MAX_PIXEL_BYTES),
            format!("memory: about {total}, of which 300.0 MB for the field and 2.0 MB for pixels")
        );
    }
}

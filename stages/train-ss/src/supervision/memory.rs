use std::path::PathBuf;

use artifact::{Failure, format_size};
use scene::{Background, View, Views};
use stage::{MEMORY_REMEDY, remaining_memory};
use workload::{ImageSize, PixelStorage, TrainingMemory, grid_training_bytes, program_bytes};

use super::options::SupersamplingOptions;
use crate::params::{Resolved, ResolvedField};
use crate::photographs::PixelMemory;

/// Bytes of the program, the samples of a step and a checkpoint's file.
const PROGRAM_BYTES: u64 = program_bytes(cfg!(feature = "torch"));
/// Minimum bytes of the paper's MLPs, chosen by hand: libtorch's buffers of a step aren't known in
/// advance.
const MIN_MLP_BYTES: u64 = 500_000_000;

/// Returns the memory of training with HR `references`, with or without checkpoints.
pub(crate) fn training_memory(
    options: &SupersamplingOptions,
    views: &Views,
    references: &[View],
    has_checkpoints: bool,
) -> TrainingMemory {
    let lr_sizes = views.views.iter().map(|view| as_usize(image_size(view)));
    let storage = PixelStorage {
        is_opaque: views.background == Background::Opaque,
        has_cache: options.needs_cache(lr_sizes),
        refines_poses: options.params.pose_refinement,
    };
    let field = field_bytes(&options.params, has_checkpoints);
    let mut memory = TrainingMemory { field, ..TrainingMemory::default() };
    for view in &views.views {
        let size = image_size(view);
        let (width, height) = options.hr_size(as_usize(size));
        memory.add_photograph(storage, size, (width as u64, height as u64));
    }
    for reference in references {
        memory.add_reference(storage, image_size(reference));
    }
    memory
}

/// Creates the storage of pixels for the given free memory, with a file in `folder`. Fails if free
/// memory is below the minimum; `None` means unlimited.
pub(crate) fn pixel_memory(
    need: &TrainingMemory,
    free: Option<u64>,
    folder: PathBuf,
) -> Result<PixelMemory, Failure> {
    let minimum = need.minimum(PROGRAM_BYTES);
    let left = remaining_memory("the training", minimum, free, MEMORY_REMEDY)?;
    Ok(PixelMemory::new(TrainingMemory::MAX_PIXEL_BYTES.min(left), folder))
}

/// Describes the memory, of which pixels may use `budget` bytes.
pub(crate) fn memory_text(need: &TrainingMemory, budget: u64) -> String {
    let in_memory = need.pixels.min(budget);
    let mut text = format!(
        "memory: about {}, of which {} for the field, {} for pixels, the rest for the program, \
        cameras and reading photographs",
        format_size(need.minimum(PROGRAM_BYTES) + in_memory),
        format_size(need.field),
        format_size(in_memory)
    );
    if need.pixels > budget {
        text += &format!("; {} of pixels in a file", format_size(need.pixels - budget));
    }
    text
}

/// Returns the size of a view's image.
fn image_size(view: &View) -> ImageSize {
    let k = view.camera.intrinsics;
    (u64::from(k.width), u64::from(k.height))
}

fn as_usize((width, height): ImageSize) -> (usize, usize) {
    (width as usize, height as usize)
}

/// Returns the bytes of the field, its optimiser and its checkpoints.
fn field_bytes(params: &Resolved, has_checkpoints: bool) -> u64 {
    match &params.field {
        ResolvedField::Grid { architecture, .. } => {
            grid_training_bytes(architecture.grid_len() as u64, has_checkpoints)
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

    const MAX_PIXEL_BYTES: u64 = TrainingMemory::MAX_PIXEL_BYTES;

    fn camera(i: usize) -> Camera {
        Camera {
            name: i.to_string(),
            intrinsics: Intrinsics::from_angle_x(2000, 1500, 0.7),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 4.]],
        }
    }

    fn need(images: usize, filter: Filter, pose_refinement: bool) -> TrainingMemory {
        let bounds = Bounds::cube(1.0, 2.0, 6.0);
        let views = Views::new(
            Background::Opaque,
            bounds,
            (0..images).map(|i| View::camera_only(camera(i))).collect(),
        );
        let params =
            Params { pose_refinement, ..Params::default() }.resolve(&SceneFacts::of(&views, true));
        let options = SupersamplingOptions { params, filter };
        training_memory(&options, &views, &[], false)
    }

    /// Every kernel needs a cache, except the mean of whole HR pixels.
    #[test]
    fn pixel_memory_depends_on_the_kernel() {
        for (filter, has_cache) in [(Filter::Box, false), (Filter::Lanczos, true)] {
            for refines_poses in [false, true] {
                let found = need(10, filter, refines_poses);
                let storage = PixelStorage { is_opaque: true, has_cache, refines_poses };
                let mut expected = TrainingMemory { field: found.field, ..Default::default() };
                (0..10).for_each(|_| expected.add_photograph(storage, (2000, 1500), (4000, 3000)));
                assert_eq!(found, expected);
                assert!(found.field > 0);
            }
        }
    }

    /// Pixels that memory has no space for are in a file. An error names needed and free memory.
    #[test]
    fn pixels_beyond_the_memory_are_in_a_file() {
        let need = TrainingMemory {
            field: 300_000_000,
            pixels: 5_000_000_000,
            pose_images: 0,
            reading: 100_000_000,
        };
        let minimum = PROGRAM_BYTES + 300_000_000;
        let budget = |free| pixel_memory(&need, free, PathBuf::new()).map(|memory| memory.left());
        assert_eq!(budget(None).unwrap(), MAX_PIXEL_BYTES);
        assert_eq!(budget(Some(minimum + 77)).unwrap(), 77);
        let message = budget(Some(minimum - 1_000_000)).unwrap_err().to_string();
        let [needed, free] = [minimum, minimum - 1_000_000].map(format_size);
        assert!(message.contains(&needed) && message.contains(&free), "{message}");
        let total = format_size(minimum + MAX_PIXEL_BYTES);
        assert_eq!(
            memory_text(&need, MAX_PIXEL_BYTES),
            format!(
                "memory: about {total}, of which 300.0 MB for the field, 4.0 GB for pixels, the \
                rest for the program, cameras and reading photographs; 1.0 GB of pixels in a file"
            )
        );
        let total = format_size(minimum + 2_000_000);
        assert_eq!(
            memory_text(&TrainingMemory { pixels: 2_000_000, ..need }, MAX_PIXEL_BYTES),
            format!(
                "memory: about {total}, of which 300.0 MB for the field, 2.0 MB for pixels, the \
                rest for the program, cameras and reading photographs"
            )
        );
    }
}

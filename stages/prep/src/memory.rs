//! Peak memory of preparing images, estimated from their headers before any is decoded.

use artifact::{Failure, FailureExt as _, bail_usage, format_size};
use dataset::Frame;
use rayon::{ThreadPool, ThreadPoolBuilder};
use stage::{Context, MEMORY_REMEDY, available_memory};
use workload::preparation_bytes;

use crate::frame_label;
use crate::image_plan::ImagePlan;

/// Peak memory of preparing one view.
#[derive(Clone, Debug, PartialEq, Eq)]
struct MemoryNeed {
    bytes: u64,
    frame: String,
    size: (u32, u32),
}

impl MemoryNeed {
    fn of(frame: &Frame, images: &ImagePlan) -> Result<Self, Failure> {
        let reading = frame.reading_bytes().bad_input(frame_label(frame))?;
        let size = (frame.lens_intrinsics.width, frame.lens_intrinsics.height);
        let hr_size = images.sizes_of(&frame.intrinsics()).hr;
        let [pixels, hr_pixels] =
            [size, hr_size].map(|(width, height)| u64::from(width) * u64::from(height));
        let hr_pixels = if images.has_truth { hr_pixels } else { 0 };
        let bytes = preparation_bytes(reading, pixels, hr_pixels);
        Ok(Self { bytes, frame: frame_label(frame), size })
    }

    /// Returns the number of views that fit into `free` bytes at a time; fails if none fits.
    fn max_concurrent(&self, free: u64) -> Result<usize, Failure> {
        let count = usize::try_from(free / self.bytes.max(1)).unwrap_or(usize::MAX);
        if count == 0 {
            let (width, height) = self.size;
            bail_usage!(
                "{}: preparing its image of {width}×{height} pixels needs {} of memory, and {} \
                are free; {MEMORY_REMEDY}",
                self.frame,
                format_size(self.bytes),
                format_size(free)
            );
        }
        Ok(count)
    }
}

/// Creates the threads that prepare images, at most as many as free memory allows for the largest
/// image.
pub(crate) fn thread_pool<'a>(
    context: &Context,
    frames: impl Iterator<Item = &'a Frame>,
    images: &ImagePlan,
) -> anyhow::Result<ThreadPool> {
    let needs: Result<Vec<MemoryNeed>, Failure> =
        frames.map(|frame| MemoryNeed::of(frame, images)).collect();
    // `max_by_key` returns the last of equal needs; reversed, the first.
    let largest = needs?.into_iter().rev().max_by_key(|need| need.bytes);
    let mut count = context.threads;
    if let (Some(largest), Some(free)) = (largest, available_memory()?) {
        count = largest.max_concurrent(free)?.min(context.threads);
        if count < context.threads {
            context.log_line(format!(
                "using {count} of {} threads: preparing the largest image needs {} of memory, and \
                {} are free",
                context.threads,
                format_size(largest.bytes),
                format_size(free)
            ));
        }
    }
    Ok(ThreadPoolBuilder::new().num_threads(count).build()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_memory_bounds_the_number_of_concurrent_images() {
        let need =
            MemoryNeed { bytes: 1_000_000_000, frame: "frame r_1".to_owned(), size: (9000, 8000) };
        assert_eq!(need.max_concurrent(1_000_000_000).unwrap(), 1);
        assert_eq!(need.max_concurrent(7_900_000_000).unwrap(), 7);
        assert_eq!(
            need.max_concurrent(900_000_000).unwrap_err().to_string(),
            format!(
                "frame r_1: preparing its image of 9000×8000 pixels needs 1.0 GB of memory, and \
                900.0 MB are free; {MEMORY_REMEDY}"
            )
        );
    }
}

//! Memory that images take while they are prepared, known from their headers before any is decoded.

use artifact::{Failure, FailureExt as _, sized};
use dataset::Frame;
use rayon::{ThreadPool, ThreadPoolBuilder};
use stage::{Context, MEMORY_REMEDY, available_memory};

use crate::frame_name::frame_name;
use crate::image_plan::ImagePlan;

/// Bytes per pixel of a photograph while images are made of it: the photograph in RGBA,
/// premultiplied, and resized along one axis.
const PHOTOGRAPH_BYTES: u64 = 12;
/// Bytes per pixel of the HR image: in RGBA, and as it is encoded.
const HR_BYTES: u64 = 8;

/// Memory that preparing one view takes at its peak.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Need {
    bytes: u64,
    frame: String,
    size: (u32, u32),
}

impl Need {
    fn of(frame: &Frame, images: &ImagePlan) -> Result<Self, Failure> {
        let reading = frame.reading_bytes().bad_input(frame_name(frame))?;
        let size = (frame.taken_with.width, frame.taken_with.height);
        let pixels = |(width, height)| u64::from(width) * u64::from(height);
        let hr = if images.has_truth { pixels(images.sizes_of(&frame.intrinsics()).hr) } else { 0 };
        let bytes = reading.max(PHOTOGRAPH_BYTES * pixels(size) + HR_BYTES * hr);
        Ok(Self { bytes, frame: frame_name(frame), size })
    }

    /// Returns the number of views that fit into free memory at a time; fails if none fits.
    fn fitting(&self, free: u64) -> Result<usize, Failure> {
        let count = usize::try_from(free / self.bytes.max(1)).unwrap_or(usize::MAX);
        if count == 0 {
            let (Self { frame, size: (width, height), .. }, need) = (self, sized(self.bytes));
            return Err(Failure::Usage(format!(
                "{frame}: preparing its image of {width}×{height} pixels needs {need} of memory, \
                and {} are free; {MEMORY_REMEDY}",
                sized(free)
            )));
        }
        Ok(count)
    }
}

/// Creates the threads that prepare images: no more than the largest image leaves memory for.
pub(crate) fn threads<'a>(
    context: &Context,
    frames: impl Iterator<Item = &'a Frame>,
    images: &ImagePlan,
) -> anyhow::Result<ThreadPool> {
    let mut largest: Option<Need> = None;
    for frame in frames {
        let need = Need::of(frame, images)?;
        if largest.as_ref().is_none_or(|largest| need.bytes > largest.bytes) {
            largest = Some(need);
        }
    }
    let mut count = context.threads;
    if let (Some(largest), Some(free)) = (largest, available_memory()?) {
        count = largest.fitting(free)?.min(context.threads);
        if count < context.threads {
            let (need, free) = (sized(largest.bytes), sized(free));
            context.say(format!(
                "{count} of {} threads: an image takes {need} of memory, and {free} are free",
                context.threads
            ));
        }
    }
    Ok(ThreadPoolBuilder::new().num_threads(count).build()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_as_fit_are_prepared_at_a_time() {
        let need = Need { bytes: 1_000_000_000, frame: "frame r_1".to_owned(), size: (9000, 8000) };
        assert_eq!(need.fitting(1_000_000_000).unwrap(), 1);
        assert_eq!(need.fitting(7_900_000_000).unwrap(), 7);
        assert_eq!(
            need.fitting(999_999_999).unwrap_err().to_string(),
            format!(
                "frame r_1: preparing its image of 9000×8000 pixels needs 1.0 GB of memory, and \
                1000.0 MB are free; {MEMORY_REMEDY}"
            )
        );
    }
}

/// Peak memory of a training, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TrainingMemory {
    /// Field, optimiser state, and the copy that a checkpoint is written from.
    pub field: u64,
    /// Packed photographs and cached HR pixels; those beyond [`Self::MAX_PIXEL_BYTES`] are in a
    /// file.
    pub pixels: u64,
    /// Photographs in the form that pose refinement compares.
    pub pose_images: u64,
    /// Buffers for reading the largest photograph, which are freed before the field is created.
    pub reading: u64,
}

/// Width and height in pixels.
pub type ImageSize = (u64, u64);

/// Form in which a training stores pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PixelStorage {
    /// True if photographs have no alpha.
    pub is_opaque: bool,
    /// True if the HR pixels of LR photographs are cached.
    pub has_cache: bool,
    /// True if poses are refined.
    pub refines_poses: bool,
}

/// Numbers of 32 bits per parameter of the grid: value, gradient, both moments in one number
/// (design note 006), moving average.
const NUMBERS_PER_PARAMETER: u64 = 4;
/// Numbers per parameter that a checkpoint copies: all but the gradient.
const COPIED_NUMBERS_PER_PARAMETER: u64 = 3;
/// Bytes per RGBA pixel of a photograph in floats.
const BYTES_PER_RGBA_PIXEL: u64 = 16;
/// Bytes per RGB pixel of a photograph in floats.
const BYTES_PER_RGB_PIXEL: u64 = 12;
/// Maximum bytes of a photograph's pyramid: four levels of 4096 informative pixels.
const PYRAMID_BYTES: u64 = 1 << 20;

impl TrainingMemory {
    /// Maximum bytes of pixels in memory, so that a stage with many photographs leaves memory to
    /// other programs (design note 038); further pixels are in a file.
    pub const MAX_PIXEL_BYTES: u64 = 4_000_000_000;

    /// Adds an LR photograph, with the size of its HR image.
    pub fn add_photograph(&mut self, storage: PixelStorage, size: ImageSize, hr_size: ImageSize) {
        let hr_pixels = if storage.has_cache { hr_size.0 * hr_size.1 } else { 0 };
        // Buffers of the image enlarged along one axis (floats) and both (floats and 8 bits).
        let enlarging_bytes = if storage.has_cache {
            BYTES_PER_RGB_PIXEL * hr_size.0 * size.1 + (BYTES_PER_RGB_PIXEL + 3) * hr_pixels
        } else {
            0
        };
        self.pixels += 3 * hr_pixels;
        self.add(storage, size, enlarging_bytes);
    }

    /// Adds an HR reference.
    pub fn add_reference(&mut self, storage: PixelStorage, size: ImageSize) {
        self.add(storage, size, 0);
    }

    fn add(&mut self, storage: PixelStorage, (width, height): ImageSize, enlarging_bytes: u64) {
        let count = width * height;
        let packed = if storage.is_opaque { 3 } else { 4 };
        // Two bits per pixel: whether the pixel is masked, and whether it has detail.
        self.pixels += packed * count + count / 4;
        let reading = (BYTES_PER_RGBA_PIXEL + BYTES_PER_RGB_PIXEL) * count + enlarging_bytes;
        self.reading = self.reading.max(reading);
        if storage.refines_poses {
            // The final comparison of poses has photographs in floats.
            self.pose_images += PYRAMID_BYTES + BYTES_PER_RGB_PIXEL * count;
        }
    }

    /// Returns the bytes needed with all pixels in the file; `program` is from [`program_bytes`].
    pub fn minimum(&self, program: u64) -> u64 {
        program + self.pose_images + self.field.max(self.reading)
    }

    /// Returns the bytes needed with unlimited memory; `program` is from [`program_bytes`].
    pub fn total(&self, program: u64) -> u64 {
        self.minimum(program) + self.pixels.min(Self::MAX_PIXEL_BYTES)
    }
}

/// Returns the bytes that a training needs besides field, poses and pixels, with or without
/// libtorch: for the program, the samples of a step and a checkpoint's file. Measured with small
/// scenes; without libtorch, the demo scene was measured, too. The command isn't recorded.
pub const fn program_bytes(has_torch: bool) -> u64 {
    if has_torch { 175_000_000 } else { 60_000_000 }
}

/// Returns the bytes of a grid with the given number of parameters in training.
pub fn grid_training_bytes(parameters: u64, has_checkpoints: bool) -> u64 {
    let copied = if has_checkpoints { COPIED_NUMBERS_PER_PARAMETER } else { 0 };
    4 * (NUMBERS_PER_PARAMETER + copied) * parameters
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Images of three megapixels use three bytes and two bits per pixel, and twelve more bytes if
    /// HR pixels are cached.
    #[test]
    fn pixel_memory_depends_on_the_hr_cache() {
        for (has_cache, bytes) in [(false, 3), (true, 15)] {
            for refines_poses in [false, true] {
                let storage = PixelStorage { is_opaque: true, has_cache, refines_poses };
                let mut memory = TrainingMemory::default();
                for count in 1..=10 {
                    memory.add_photograph(storage, (2000, 1500), (4000, 3000));
                    assert_eq!(memory.pixels, count * (3_000_000 * bytes + 750_000));
                    let poses = if refines_poses { 12 * 3_000_000 + PYRAMID_BYTES } else { 0 };
                    assert_eq!(memory.pose_images, count * poses);
                }
                let reading = memory.reading;
                memory.add_reference(storage, (100, 10));
                assert_eq!(memory.reading, reading, "the largest image counts");
                assert_eq!(memory.pixels, 10 * (3_000_000 * bytes + 750_000) + 3250);
            }
        }
    }

    #[test]
    fn the_larger_of_field_and_reading_counts() {
        let memory = TrainingMemory { field: 7, pixels: 100, pose_images: 3, reading: 9 };
        assert_eq!((memory.minimum(10), memory.total(10)), (22, 122));
        let many = TrainingMemory { pixels: 2 * TrainingMemory::MAX_PIXEL_BYTES, ..memory };
        assert_eq!(many.total(10), 22 + TrainingMemory::MAX_PIXEL_BYTES);
        assert_eq!([false, true].map(|copied| grid_training_bytes(10, copied)), [160, 280]);
    }
}

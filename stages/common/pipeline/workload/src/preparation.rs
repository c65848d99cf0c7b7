/// Bytes per pixel of a photograph while it is resized: RGBA, premultiplied RGBA, and RGBA resized
/// along one axis.
const PHOTOGRAPH_BYTES: u64 = 12;
/// Bytes per pixel of the HR image: RGBA, and its encoded file.
const HR_BYTES: u64 = 8;

/// Returns the peak memory of preparing a view in `prep`, with `reading` bytes for reading its
/// photograph and `hr_pixels` of its HR image, 0 without one.
pub fn preparation_bytes(reading: u64, photograph_pixels: u64, hr_pixels: u64) -> u64 {
    reading.max(PHOTOGRAPH_BYTES * photograph_pixels + HR_BYTES * hr_pixels)
}

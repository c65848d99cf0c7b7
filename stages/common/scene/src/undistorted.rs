use pixels::{Rgba8, sample_cubic};

use crate::intrinsics::Intrinsics;

/// Resamples an image, as `taken_with` took it, to what a pinhole camera of the same size sees from
/// the same place; by cubic interpolation, as sharp as it was.
pub fn undistorted(image: &Rgba8, taken_with: &Intrinsics, pinhole: &Intrinsics) -> Rgba8 {
    let mut data = Vec::with_capacity(image.data.len());
    for y in 0..image.height {
        for x in 0..image.width {
            let at = taken_with.source(pinhole, [x as f64 + 0.5, y as f64 + 0.5]);
            let colour = sample_cubic((image.width, image.height), at, |column, row| {
                let at = 4 * (row * image.width + column);
                [0, 1, 2, 3].map(|c| f64::from(image.data[at + c]))
            });
            data.extend(colour.map(|v| (v + 0.5) as u8));
        }
    }
    Rgba8::new(image.width, image.height, data)
}

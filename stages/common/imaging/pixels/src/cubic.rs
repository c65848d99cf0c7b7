use crate::image_buffer::Image;

/// Interpolates an image of the given (width, height) at a position in pixels from its top left
/// corner, by Catmull-Rom splines (Catmull and Rom 1974). Pixel centres are at half-integers;
/// border pixels repeat outside the image. Values are not clamped.
pub fn sample_cubic<const N: usize>(
    (width, height): (usize, usize),
    [x, y]: [f64; 2],
    pixel: impl Fn(usize, usize) -> [f64; N],
) -> [f64; N] {
    let (x, y) = (x - 0.5, y - 0.5);
    let (left, top) = (x.floor(), y.floor());
    let (across, down) = (catmull_rom(x - left), catmull_rom(y - top));
    let mut sum = [0.0; N];
    for (j, wy) in down.iter().enumerate() {
        let row = sample_index(top, j, height);
        for (i, wx) in across.iter().enumerate() {
            let pixel = pixel(sample_index(left, i, width), row);
            for c in 0..N {
                sum[c] += wx * wy * pixel[c];
            }
        }
    }
    sum
}

/// Returns the index of the `k`-th of four samples along an axis of `count` pixels; `second` is the
/// unclamped index of the second sample.
#[inline]
fn sample_index(second: f64, k: usize, count: usize) -> usize {
    ((second + k as f64 - 1.0).max(0.0) as usize).min(count - 1)
}

/// Returns the weights of four samples at a position `t` of 0 to 1 between the second and the
/// third.
fn catmull_rom(t: f64) -> [f64; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

impl Image {
    /// Interpolates the first three channels at a position in pixels from the top left corner, by
    /// [`sample_cubic`], clamped to [0, 1].
    ///
    /// # Panics
    /// With fewer than three channels.
    pub fn colour_at(&self, position: [f32; 2]) -> [f32; 3] {
        let size = (self.width, self.height);
        let colour = sample_cubic(size, position.map(f64::from), |column, row| {
            let first = (row * self.width + column) * self.channels;
            [0, 1, 2].map(|c| f64::from(self.data[first + c]))
        });
        colour.map(|v| (v as f32).clamp(0.0, 1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interpolation_reproduces_pixels_and_linear_ramps() {
        let image = Image::new(
            8,
            6,
            3,
            (0..48).flat_map(|i| [(i % 8) as f32 / 8.0, (i / 8) as f32 / 8.0, 0.5]).collect(),
        );
        assert_eq!(image.colour_at([3.5, 2.5]), [3.0 / 8.0, 2.0 / 8.0, 0.5]);
        let between = image.colour_at([3.75, 2.9]);
        assert!(
            (between[0] - 3.25 / 8.0).abs() < 1e-6 && (between[1] - 2.4 / 8.0).abs() < 1e-6,
            "{between:?}"
        );
        assert_eq!(image.colour_at([-5.0, 99.0]), [0.0, 5.0 / 8.0, 0.5]);
        assert!(image.colour_at([f32::NAN, 1.0]).iter().all(|v| v.is_nan()));
    }
}

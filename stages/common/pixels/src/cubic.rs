use crate::image_buffer::Image;

/// What an image of that size (columns, rows) shows at a position in pixels from its top left
/// corner: cubic interpolation (Catmull and Rom 1974) of its pixels, whose centres lie at halves;
/// beyond its border it goes on. Nothing is clamped.
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
        let row = place(top, j, height);
        for (i, wx) in across.iter().enumerate() {
            let pixel = pixel(place(left, i, width), row);
            (0..N).for_each(|c| sum[c] += wx * wy * pixel[c]);
        }
    }
    sum
}

/// The `k`th of four samples along an axis with so many, of which `first` is the second.
#[inline]
fn place(first: f64, k: usize, end: usize) -> usize {
    ((first + k as f64 - 1.0).max(0.0) as usize).min(end - 1)
}

/// Weights of the four samples around a place between the second and the third.
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
    /// The first three channels at a position in pixels from the top left corner, by
    /// [`sample_cubic`], clamped to [0, 1].
    ///
    /// # Panics
    /// With fewer channels.
    pub fn colour_at(&self, place: [f32; 2]) -> [f32; 3] {
        let size = (self.width, self.height);
        let colour = sample_cubic(size, place.map(f64::from), |column, row| {
            let at = (row * self.width + column) * self.channels;
            [0, 1, 2].map(|c| f64::from(self.data[at + c]))
        });
        colour.map(|v| (v as f32).clamp(0.0, 1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_met_and_lines_are_kept() {
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

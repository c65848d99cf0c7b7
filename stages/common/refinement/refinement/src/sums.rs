/// Radius in pixels of the window in which a reference is compared with the rendered view. In the
/// window's mean, missing detail averages out (docs/design/018).
pub(crate) const COMPARED_RADIUS: usize = 5;

/// Summed-area table of `N` values per pixel.
pub(crate) struct Sums<const N: usize> {
    sums: Vec<[f64; N]>,
    width: usize,
    height: usize,
}

impl<const N: usize> Sums<N> {
    /// Builds the table of values given row by row.
    pub(crate) fn new(width: usize, pixels: &[[f64; N]]) -> Self {
        let height = pixels.len() / width.max(1);
        let across = width + 1;
        let mut sums = vec![[0.0; N]; across * (height + 1)];
        for (y, row) in pixels.chunks_exact(width.max(1)).enumerate() {
            let mut left = [0.0; N];
            for (x, pixel) in row.iter().enumerate() {
                for i in 0..N {
                    left[i] += pixel[i];
                }
                sums[(y + 1) * across + x + 1] =
                    std::array::from_fn(|i| sums[y * across + x + 1][i] + left[i]);
            }
        }
        Self { sums, width, height }
    }

    /// Returns the sums over the window around a pixel, clipped to the image.
    pub(crate) fn around(&self, x: usize, y: usize) -> [f64; N] {
        let left = x.saturating_sub(COMPARED_RADIUS);
        let right = (x + COMPARED_RADIUS + 1).min(self.width);
        let top = y.saturating_sub(COMPARED_RADIUS) * (self.width + 1);
        let bottom = (y + COMPARED_RADIUS + 1).min(self.height) * (self.width + 1);
        std::array::from_fn(|i| {
            self.sums[bottom + right][i] - self.sums[bottom + left][i] - self.sums[top + right][i]
                + self.sums[top + left][i]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_cover_the_window_around_a_pixel() {
        let (width, height) = (17, 13);
        let value = |i: usize| [(i * i % 29) as f64, 1.0];
        let sums = Sums::new(width, &(0..width * height).map(value).collect::<Vec<_>>());
        for (x, y) in [(0, 0), (8, 6), (16, 12), (3, 12)] {
            let near = |a: usize, b: usize| a.abs_diff(b) <= COMPARED_RADIUS;
            let pixels = (0..width * height).filter(|i| near(i % width, x) && near(i / width, y));
            let expected =
                pixels.map(value).fold([0.0; 2], |sum, v| [sum[0] + v[0], sum[1] + v[1]]);
            assert_eq!(sums.around(x, y), expected, "{x}, {y}");
        }
        assert!(Sums::<1>::new(0, &[]).sums.iter().all(|s| *s == [0.0]));
    }
}

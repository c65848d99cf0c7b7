use numerics::CounterRng;
use pixels::Image;

/// Random perspective warp, like torchvision's: every corner of an image moves inwards by at most a
/// fraction of half the width and height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Perspective {
    /// Map from positions in the warped image to the original: (ax + by + c) / w and (dx + ey + f)
    /// / w, where w is gx + hy + 1.
    map: [f64; 8],
    /// Bounding box of the warped image's content: left, top, and right, bottom (exclusive).
    pub(crate) filled: [usize; 4],
}

/// Maximum shift of a corner as a fraction of half the width and height; source not recorded.
const MAX_CORNER_SHIFT: f64 = 0.3;

/// Draws the shift in pixels of a corner along a side of `size` pixels.
fn draw_corner_shift(size: usize, rng: &mut CounterRng) -> f64 {
    rng.below((MAX_CORNER_SHIFT * (size / 2) as f64) as u64 + 1) as f64
}

impl Perspective {
    /// Returns the warp that changes nothing.
    pub(crate) fn identity(width: usize, height: usize) -> Self {
        Self { map: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], filled: [0, 0, width, height] }
    }

    /// Draws a random warp.
    pub(crate) fn draw(width: usize, height: usize, rng: &mut CounterRng) -> Self {
        let (right, bottom) = (width as f64 - 1.0, height as f64 - 1.0);
        let corners = [(0.0, 0.0), (right, 0.0), (right, bottom), (0.0, bottom)];
        let moved = corners.map(|(x, y)| {
            let dx = draw_corner_shift(width, rng);
            let dy = draw_corner_shift(height, rng);
            (if x > 0.0 { x - dx } else { dx }, if y > 0.0 { y - dy } else { dy })
        });
        let Some(map) = homography(moved, corners) else { return Self::identity(width, height) };
        let (mut min, mut max) = ((f64::INFINITY, f64::INFINITY), (0.0f64, 0.0f64));
        for (x, y) in moved {
            min = (min.0.min(x), min.1.min(y));
            max = (max.0.max(x), max.1.max(y));
        }
        let filled = [min.0 as usize, min.1 as usize, max.0 as usize + 1, max.1 as usize + 1];
        Self { map, filled }
    }

    /// Returns the warped image's colour at a pixel, by bilinear interpolation; black outside.
    pub(crate) fn colour(&self, image: &Image, x: usize, y: usize) -> [f32; 3] {
        let (x, y, [a, b, c, d, e, f, g, h]) = (x as f64, y as f64, self.map);
        let w = g * x + h * y + 1.0;
        let (u, v) = ((a * x + b * y + c) / w, (d * x + e * y + f) / w);
        let (left, top) = (u.floor(), v.floor());
        let mut colour = [0.0f32; 3];
        for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let (column, row) = (left + dx, top + dy);
            // `contains` is false for NaN.
            if !(0.0..image.width as f64).contains(&column)
                || !(0.0..image.height as f64).contains(&row)
            {
                continue;
            }
            let weight = (1.0 - (u - column).abs()) * (1.0 - (v - row).abs());
            let start = (row as usize * image.width + column as usize) * image.channels;
            for channel in 0..3 {
                colour[channel] += weight as f32 * image.data[start + channel];
            }
        }
        colour
    }
}

/// Solves for the perspective that maps four points to four others; `None` if the equations are
/// singular, as with three collinear points in `from`.
fn homography(from: [(f64, f64); 4], to: [(f64, f64); 4]) -> Option<[f64; 8]> {
    // Two rows per point; the ninth column is the right-hand side.
    let mut rows = Vec::with_capacity(8);
    for ((x, y), (u, v)) in from.into_iter().zip(to) {
        rows.push([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, u]);
        rows.push([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, v]);
    }
    for column in 0..8 {
        let pivot =
            (column..8).max_by(|&a, &b| rows[a][column].abs().total_cmp(&rows[b][column].abs()))?;
        rows.swap(column, pivot);
        let divisor: f64 = rows[column][column];
        // Zero up to rounding; chosen by hand.
        if divisor.abs() < 1e-12 {
            return None;
        }
        let pivot = rows[column].map(|value| value / divisor);
        rows[column] = pivot;
        for (i, row) in rows.iter_mut().enumerate() {
            if i != column {
                let factor = row[column];
                for k in 0..9 {
                    row[k] -= factor * pivot[k];
                }
            }
        }
    }
    Some(std::array::from_fn(|i| rows[i][8]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_homography_maps_corners_to_corners() {
        let from = [(3.0, 2.0), (30.0, 1.0), (28.0, 20.0), (2.0, 19.0)];
        let to = [(0.0, 0.0), (31.0, 0.0), (31.0, 23.0), (0.0, 23.0)];
        let [a, b, c, d, e, f, g, h] = homography(from, to).unwrap();
        for ((x, y), (u, v)) in from.into_iter().zip(to) {
            let w = g * x + h * y + 1.0;
            assert!(
                ((a * x + b * y + c) / w - u).abs() < 1e-9
                    && ((d * x + e * y + f) / w - v).abs() < 1e-9
            );
        }
        assert_eq!(homography([(0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (3.0, 3.0)], to), None);
    }

    #[test]
    fn the_identity_keeps_pixels_and_warps_are_black_outside_filled() {
        let image = Image::new(40, 30, 3, (0..3600).map(|i| 0.1 + i as f32 / 4000.0).collect());
        let identity = Perspective::identity(40, 30);
        assert_eq!(
            identity.colour(&image, 7, 5),
            [0, 1, 2].map(|c| image.data[(5 * 40 + 7) * 3 + c])
        );
        for seed in 0..20 {
            let warp = Perspective::draw(40, 30, &mut CounterRng::new(seed, 1, 2));
            let [left, top, right, bottom] = warp.filled;
            assert!(right <= 40 && bottom <= 30 && right - left > 20 && bottom - top > 15);
            for (x, y) in (0..40).flat_map(|x| (0..30).map(move |y| (x, y))) {
                // The border fades over a pixel.
                let is_inside = x + 1 >= left && x <= right && y + 1 >= top && y <= bottom;
                assert!(
                    is_inside || warp.colour(&image, x, y).iter().all(|c| *c < 1e-6),
                    "seed {seed} at {x}, {y}"
                );
            }
            assert!(warp.colour(&image, 20, 15)[0] > 0.05);
        }
    }
}

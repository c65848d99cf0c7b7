use counter_rng::CounterRng;
use pixels::Image;

/// A random perspective, as torchvision draws them: every corner of an image moves inwards by at
/// most a share of its half width and height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Perspective {
    /// From places of the warped image to those of the image: (ax + by + c) / w and (dx + ey + f) /
    /// w, where w is gx + hy + 1.
    map: [f64; 8],
    /// The rectangle that the image fills once it is warped: x, y, and one past the end.
    pub(crate) filled: [usize; 4],
}

/// How far corners move, at most, as a share of the half width and height.
const MOST_CORNER_SHIFT_SHARE: f64 = 0.3;

/// How far a corner moves along a side of that size.
fn corner_shift(size: usize, rng: &mut CounterRng) -> f64 {
    rng.below((MOST_CORNER_SHIFT_SHARE * (size / 2) as f64) as u64 + 1) as f64
}

impl Perspective {
    /// No change.
    pub(crate) fn identity(width: usize, height: usize) -> Self {
        Self { map: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], filled: [0, 0, width, height] }
    }

    /// A random one.
    pub(crate) fn draw(width: usize, height: usize, rng: &mut CounterRng) -> Self {
        let (right, bottom) = (width as f64 - 1.0, height as f64 - 1.0);
        let corners = [(0.0, 0.0), (right, 0.0), (right, bottom), (0.0, bottom)];
        let moved = corners.map(|(x, y)| {
            let (dx, dy) = (corner_shift(width, rng), corner_shift(height, rng));
            (if x > 0.0 { x - dx } else { dx }, if y > 0.0 { y - dy } else { dy })
        });
        let Some(map) = homography(moved, corners) else { return Self::identity(width, height) };
        let (xs, ys) = (moved.map(|p| p.0), moved.map(|p| p.1));
        let low = |of: [f64; 4]| of.into_iter().fold(f64::INFINITY, f64::min) as usize;
        let high = |of: [f64; 4]| of.into_iter().fold(0.0, f64::max) as usize + 1;
        Self { map, filled: [low(xs), low(ys), high(xs), high(ys)] }
    }

    /// The warped image's colour at a pixel, bilinear; black outside.
    pub(crate) fn colour(&self, image: &Image, x: usize, y: usize) -> [f32; 3] {
        let (x, y, [a, b, c, d, e, f, g, h]) = (x as f64, y as f64, self.map);
        let w = g * x + h * y + 1.0;
        let (u, v) = ((a * x + b * y + c) / w, (d * x + e * y + f) / w);
        let (left, top) = (u.floor(), v.floor());
        let mut colour = [0.0f32; 3];
        for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let (column, row) = (left + dx, top + dy);
            // NaN is in no image.
            if !(0.0..image.width as f64).contains(&column)
                || !(0.0..image.height as f64).contains(&row)
            {
                continue;
            }
            let share = (1.0 - (u - column).abs()) * (1.0 - (v - row).abs());
            let at = (row as usize * image.width + column as usize) * image.channels;
            (0..3).for_each(|c| colour[c] += share as f32 * image.data[at + c]);
        }
        colour
    }
}

/// The perspective that takes four places to four others; none where three of them lie in a line.
fn homography(from: [(f64, f64); 4], to: [(f64, f64); 4]) -> Option<[f64; 8]> {
    // Two rows a place, the right-hand side in the ninth column.
    let mut rows: Vec<[f64; 9]> = from
        .into_iter()
        .zip(to)
        .flat_map(|((x, y), (u, v))| {
            [
                [x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, u],
                [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, v],
            ]
        })
        .collect();
    for column in 0..8 {
        let pivot =
            (column..8).max_by(|&a, &b| rows[a][column].abs().total_cmp(&rows[b][column].abs()))?;
        rows.swap(column, pivot);
        let by = rows[column][column];
        if by.abs() < 1e-12 {
            return None;
        }
        rows[column].iter_mut().for_each(|v| *v /= by);
        let pivot = rows[column];
        for (_, row) in rows.iter_mut().enumerate().filter(|(i, _)| *i != column) {
            let share = row[column];
            row.iter_mut().zip(pivot).for_each(|(v, p)| *v -= share * p);
        }
    }
    let mut map = [0.0; 8];
    (0..8).for_each(|i| map[i] = rows[i][8]);
    Some(map)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_go_where_they_should() {
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
    fn nothing_changes_by_none_and_the_filled_rectangle_holds_all() {
        let image = Image::new(40, 30, 3, (0..3600).map(|i| 0.1 + i as f32 / 4000.0).collect());
        let none = Perspective::identity(40, 30);
        assert_eq!(none.colour(&image, 7, 5), [0, 1, 2].map(|c| image.data[(5 * 40 + 7) * 3 + c]));
        for seed in 0..20 {
            let warp = Perspective::draw(40, 30, &mut CounterRng::new(seed, 1, 2));
            let [left, top, right, bottom] = warp.filled;
            assert!(right <= 40 && bottom <= 30 && right - left > 20 && bottom - top > 15);
            for (x, y) in (0..40).flat_map(|x| (0..30).map(move |y| (x, y))) {
                // The border fades over a pixel.
                let inside = x + 1 >= left && x <= right && y + 1 >= top && y <= bottom;
                assert!(
                    inside || warp.colour(&image, x, y).iter().all(|c| *c < 1e-6),
                    "seed {seed} at {x}, {y}"
                );
            }
            assert!(warp.colour(&image, 20, 15)[0] > 0.05);
        }
    }
}

use pixels::Image;
use tch::{TchError, Tensor};

/// Pixels along each side of a fold: the network sees 2×2 pixels as one of four times as many
/// channels, which widens what it sees around a pixel at the same cost.
pub(crate) const FOLD: usize = 2;

/// Where a square of an image lies, in pixels; it may reach over the border, which goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Square {
    pub(crate) x: isize,
    pub(crate) y: isize,
    /// Width and height, multiples of [`FOLD`].
    pub(crate) size: (usize, usize),
}

impl Square {
    /// The same and so many folds more on each side.
    pub(crate) fn grown(self, folds: usize) -> Self {
        let by = folds * FOLD;
        let (x, y) = (self.x - by as isize, self.y - by as isize);
        Self { x, y, size: (self.size.0 + 2 * by, self.size.1 + 2 * by) }
    }

    /// Goes through the square's pixels, column and row in it, in the order in which the network
    /// takes them: rows of folds, a fold's pixels together.
    pub(crate) fn fold(self, mut pixel: impl FnMut(usize, usize)) {
        for fold_y in 0..self.size.1 / FOLD {
            for fold_x in 0..self.size.0 / FOLD {
                (0..FOLD * FOLD)
                    .for_each(|k| pixel(fold_x * FOLD + k % FOLD, fold_y * FOLD + k / FOLD));
            }
        }
    }

    /// An image's samples at a place in the square; beyond the border, those at the border.
    pub(crate) fn of(self, image: &Image, column: usize, row: usize) -> &[f32] {
        let (column, row) =
            (clamped(self.x, column, image.width), clamped(self.y, row, image.height));
        let at = row * image.width + column;
        &image.data[at * image.channels..(at + 1) * image.channels]
    }

    /// Takes folded samples apart again: calls with column, row (in the square) and a pixel's
    /// samples.
    pub(crate) fn unfold(
        self,
        samples: &[f32],
        channels: usize,
        mut pixel: impl FnMut(usize, usize, &[f32]),
    ) {
        let across = self.size.0 / FOLD;
        for (i, sample) in samples.chunks_exact(channels).enumerate() {
            let (fold, k) = (i / (FOLD * FOLD), i % (FOLD * FOLD));
            pixel(fold % across * FOLD + k % FOLD, fold / across * FOLD + k / FOLD, sample);
        }
    }

    /// Folded samples of squares of this size as a tensor (squares × channels × rows × columns),
    /// channels last in memory, as convolutions like it.
    pub(crate) fn tensor(self, samples: &[f32], channels: usize) -> Result<Tensor, TchError> {
        let (width, height, depth) =
            (self.size.0 / FOLD, self.size.1 / FOLD, channels * FOLD * FOLD);
        let count = samples.len() / (width * height * depth);
        let shape = [count, height, width, depth].map(|d| d as i64);
        Tensor::f_from_slice(samples)?.f_reshape(shape)?.f_permute([0, 3, 1, 2])
    }
}

/// So many pixels after `start` along an axis, but not beyond its ends.
fn clamped(start: isize, by: usize, size: usize) -> usize {
    (start + by as isize).clamp(0, size as isize - 1) as usize
}

/// One of the eight ways to lay a square of pixels: turned by right angles, mirrored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Turn {
    /// Rows for columns.
    swap: bool,
    flip_x: bool,
    flip_y: bool,
}

impl Turn {
    /// All of them; the first leaves a square as it is.
    pub(crate) const ALL: [Self; 8] = {
        let mut all = [Self { swap: false, flip_x: false, flip_y: false }; 8];
        let mut i = 0;
        while i < 8 {
            all[i] = Self { swap: i & 4 != 0, flip_x: i & 1 != 0, flip_y: i & 2 != 0 };
            i += 1;
        }
        all
    };

    /// The size of a square once it is turned.
    pub(crate) fn of(self, square: Square) -> Square {
        let (width, height) = square.size;
        Square { size: if self.swap { (height, width) } else { (width, height) }, ..square }
    }

    /// Where in a square a place of the turned one comes from.
    pub(crate) fn source(self, square: Square, x: usize, y: usize) -> (usize, usize) {
        let (x, y) = if self.swap { (y, x) } else { (x, y) };
        let (width, height) = square.size;
        (if self.flip_x { width - 1 - x } else { x }, if self.flip_y { height - 1 - y } else { y })
    }
}

/// A tensor's samples as [`Square::unfold`] takes them.
pub(crate) fn samples(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    let flat = tensor.f_permute([0, 2, 3, 1])?.f_contiguous()?.f_view([-1])?;
    Vec::<f32>::try_from(&flat)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_folded_unfolds() {
        let image = Image::new(7, 5, 3, (0..105).map(|v| v as f32).collect());
        let square = Square { x: -2, y: 1, size: (6, 4) };
        let mut folded = Vec::new();
        square.fold(|x, y| folded.extend_from_slice(square.of(&image, x, y)));
        let again = samples(&square.tensor(&folded, 3).unwrap()).unwrap();
        assert_eq!(again, folded);
        let mut count = 0;
        square.unfold(&again, 3, |x, y, pixel| {
            let (column, row) = ((x as isize - 2).clamp(0, 6) as usize, (y + 1).min(4));
            assert_eq!(pixel, &image.data[(row * 7 + column) * 3..][..3]);
            count += 1;
        });
        assert_eq!(count, 24);
    }

    #[test]
    fn turns_are_eight_and_lose_nothing() {
        let square = Square { x: 3, y: 4, size: (6, 2) };
        let mut seen = std::collections::BTreeSet::new();
        for turn in Turn::ALL {
            let mut places = Vec::new();
            turn.of(square).fold(|x, y| places.push(turn.source(square, x, y)));
            let all: std::collections::BTreeSet<_> = places.iter().copied().collect();
            assert_eq!(all.len(), 12);
            assert!(all.iter().all(|&(x, y)| x < 6 && y < 2));
            seen.insert(places);
        }
        assert_eq!(seen.len(), 8);
        assert_eq!(Turn::ALL[0].source(square, 4, 1), (4, 1));
    }
}

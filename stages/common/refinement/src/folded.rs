use pixels::Picture;
use tch::{TchError, Tensor};

/// Pixels along each side of a fold: the network sees 2×2 pixels as one of four times as many channels, which widens what it sees
/// around a pixel at the same cost.
pub(crate) const FOLD: usize = 2;

/// Where a square of a picture lies, in pixels; it may reach over the border, which goes on.
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

    /// Goes through the square's pixels, column and row in it, in the order in which the network takes them: rows of folds, a fold's pixels
    /// together.
    pub(crate) fn fold(self, mut pixel: impl FnMut(usize, usize)) {
        for fold_y in 0..self.size.1 / FOLD {
            for fold_x in 0..self.size.0 / FOLD {
                (0..FOLD * FOLD).for_each(|k| pixel(fold_x * FOLD + k % FOLD, fold_y * FOLD + k / FOLD));
            }
        }
    }

    /// Column and row in a picture of a place in the square; beyond the border, those at the border.
    pub(crate) fn place(self, picture: &Picture, column: usize, row: usize) -> (usize, usize) {
        let clamped = |start: isize, by: usize, size: usize| (start + by as isize).clamp(0, size as isize - 1) as usize;
        (clamped(self.x, column, picture.width), clamped(self.y, row, picture.height))
    }

    /// A picture's samples there.
    pub(crate) fn of(self, picture: &Picture, column: usize, row: usize) -> &[f32] {
        let (column, row) = self.place(picture, column, row);
        let at = row * picture.width + column;
        &picture.data[at * picture.channels..(at + 1) * picture.channels]
    }

    /// Takes folded samples apart again: calls with column, row (in the square) and a pixel's samples.
    pub(crate) fn unfold(self, samples: &[f32], channels: usize, mut pixel: impl FnMut(usize, usize, &[f32])) {
        let across = self.size.0 / FOLD;
        for (i, sample) in samples.chunks_exact(channels).enumerate() {
            let (fold, k) = (i / (FOLD * FOLD), i % (FOLD * FOLD));
            pixel(fold % across * FOLD + k % FOLD, fold / across * FOLD + k / FOLD, sample);
        }
    }

    /// Folded samples of squares of this size as a tensor (squares × channels × rows × columns), channels last in memory, as
    /// convolutions like it.
    pub(crate) fn tensor(self, samples: &[f32], channels: usize) -> Result<Tensor, TchError> {
        let (width, height, depth) = (self.size.0 / FOLD, self.size.1 / FOLD, channels * FOLD * FOLD);
        let count = samples.len() / (width * height * depth);
        let shape = [count, height, width, depth].map(|d| d as i64);
        Tensor::f_from_slice(samples)?.f_reshape(shape)?.f_permute([0, 3, 1, 2])
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
        let picture = Picture::new(7, 5, 3, (0..105).map(|v| v as f32).collect());
        let square = Square { x: -2, y: 1, size: (6, 4) };
        let mut folded = Vec::new();
        square.fold(|x, y| folded.extend_from_slice(square.of(&picture, x, y)));
        let again = samples(&square.tensor(&folded, 3).unwrap()).unwrap();
        assert_eq!(again, folded);
        let mut count = 0;
        square.unfold(&again, 3, |x, y, pixel| {
            let (column, row) = ((x as isize - 2).clamp(0, 6) as usize, (y + 1).min(4));
            assert_eq!(pixel, &picture.data[(row * 7 + column) * 3..][..3]);
            count += 1;
        });
        assert_eq!(count, 24);
    }
}

use pixels::Image;

/// Pixels along each side of a fold. The network takes 2×2 pixels as one with four times as many
/// channels (space-to-depth), which widens its receptive field at equal cost (design note 015).
pub(crate) const FOLD: usize = 2;

/// Rectangle of an image, in pixels. It may extend beyond the image, where the nearest border
/// pixels are repeated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Window {
    pub(crate) x: isize,
    pub(crate) y: isize,
    /// Width and height, multiples of [`FOLD`].
    pub(crate) size: (usize, usize),
}

impl Window {
    /// Returns the window grown by `folds` folds on each side.
    pub(crate) fn grown(self, folds: usize) -> Self {
        let margin = folds * FOLD;
        let (x, y) = (self.x - margin as isize, self.y - margin as isize);
        Self { x, y, size: (self.size.0 + 2 * margin, self.size.1 + 2 * margin) }
    }

    /// Calls `pixel` with the column and row of each pixel of the window, in the network's order:
    /// rows of folds, the pixels of a fold together.
    pub(crate) fn fold(self, mut pixel: impl FnMut(usize, usize)) {
        for fold_y in 0..self.size.1 / FOLD {
            for fold_x in 0..self.size.0 / FOLD {
                for k in 0..FOLD * FOLD {
                    pixel(fold_x * FOLD + k % FOLD, fold_y * FOLD + k / FOLD);
                }
            }
        }
    }

    /// Returns the image's pixel at a column and row of the window, or the nearest border pixel.
    pub(crate) fn pixel(self, image: &Image, column: usize, row: usize) -> &[f32] {
        let column = clamped_index(self.x, column, image.width);
        let row = clamped_index(self.y, row, image.height);
        let start = (row * image.width + column) * image.channels;
        &image.data[start..start + image.channels]
    }

    /// Calls `pixel` for each pixel of folded samples, with the column and row in the window and
    /// the channels.
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

    /// Returns the number of folds along each axis.
    pub(crate) fn folds(self) -> (usize, usize) {
        (self.size.0 / FOLD, self.size.1 / FOLD)
    }

    /// Returns whether all pixels have opacity 0, the fourth channel.
    pub(crate) fn is_transparent(self, image: &Image) -> bool {
        let (width, height) = self.size;
        (0..height).all(|y| (0..width).all(|x| self.pixel(image, x, y)[3] == 0.0))
    }
}

/// Returns the index `offset` after `start`, clamped to an axis of `size` pixels.
fn clamped_index(start: isize, offset: usize, size: usize) -> usize {
    (start + offset as isize).clamp(0, size as isize - 1) as usize
}

/// One of eight orientations of a window: rotations by right angles and reflections.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Orientation {
    /// True if rows and columns are exchanged.
    swap: bool,
    /// True if columns are mirrored.
    flip_x: bool,
    /// True if rows are mirrored.
    flip_y: bool,
}

impl Orientation {
    /// All orientations; the first is the identity.
    pub(crate) const ALL: [Self; 8] = [
        Self::new(0),
        Self::new(1),
        Self::new(2),
        Self::new(3),
        Self::new(4),
        Self::new(5),
        Self::new(6),
        Self::new(7),
    ];

    /// Returns the orientation of a number below 8, whose bits are its fields.
    const fn new(number: u8) -> Self {
        Self { swap: number & 4 != 0, flip_x: number & 1 != 0, flip_y: number & 2 != 0 }
    }

    /// Returns the window in this orientation: width and height are exchanged if necessary.
    pub(crate) fn oriented(self, window: Window) -> Window {
        let (width, height) = window.size;
        Window { size: if self.swap { (height, width) } else { (width, height) }, ..window }
    }

    /// Maps a column and row of the oriented window to those of the original window.
    pub(crate) fn source(self, window: Window, x: usize, y: usize) -> (usize, usize) {
        let (x, y) = if self.swap { (y, x) } else { (x, y) };
        let (width, height) = window.size;
        (if self.flip_x { width - 1 - x } else { x }, if self.flip_y { height - 1 - y } else { y })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unfolding_restores_folded_pixels() {
        let image = Image::new(7, 5, 3, (0..105).map(|v| v as f32).collect());
        let window = Window { x: -2, y: 1, size: (6, 4) };
        let mut folded = Vec::new();
        window.fold(|x, y| folded.extend_from_slice(window.pixel(&image, x, y)));
        let mut count = 0;
        window.unfold(&folded, 3, |x, y, pixel| {
            let (column, row) = ((x as isize - 2).clamp(0, 6) as usize, (y + 1).min(4));
            assert_eq!(pixel, &image.data[(row * 7 + column) * 3..][..3]);
            count += 1;
        });
        assert_eq!(count, 24);
    }

    #[test]
    fn orientations_are_eight_permutations() {
        let window = Window { x: 3, y: 4, size: (6, 2) };
        let mut orders = std::collections::BTreeSet::new();
        for orientation in Orientation::ALL {
            let mut pixels = Vec::new();
            orientation.oriented(window).fold(|x, y| pixels.push(orientation.source(window, x, y)));
            let distinct: std::collections::BTreeSet<_> = pixels.iter().copied().collect();
            assert_eq!(distinct.len(), 12);
            assert!(distinct.iter().all(|&(x, y)| x < 6 && y < 2));
            orders.insert(pixels);
        }
        assert_eq!(orders.len(), 8);
        assert_eq!(Orientation::ALL[0].source(window, 4, 1), (4, 1));
    }
}

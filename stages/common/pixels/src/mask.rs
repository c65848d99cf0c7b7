use std::ops::Range;
use std::path::Path;

use crate::error::PixelError;
use crate::image_buffer::{Image, Rgba8};
use crate::png_file::read_png;

/// Which pixels of an image count, row by row; the others show what doesn't belong to the scene,
/// people who walked by for example.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// For each pixel whether it counts.
    pub counts: Vec<bool>,
}

impl Mask {
    /// From an image: what is dark or transparent there doesn't count.
    pub fn of(image: &Rgba8) -> Self {
        Self {
            width: image.width,
            height: image.height,
            counts: image.data.chunks_exact(4).map(is_bright).collect(),
        }
    }

    /// Reads a PNG, see [`Mask::of`], for an image of that size.
    pub fn read(path: &Path, (width, height): (usize, usize)) -> Result<Self, PixelError> {
        let image = read_png(path)?;
        if (image.width, image.height) != (width, height) {
            let reason = format!(
                "{}×{} pixels where its image has {width}×{height}",
                image.width, image.height
            );
            return Err(PixelError::Format { path: path.to_path_buf(), reason });
        }
        Ok(Self::of(&image))
    }

    /// White where a pixel counts, black elsewhere.
    pub fn to_rgba8(&self) -> Rgba8 {
        let pixel = |&counts: &bool| if counts { [255; 4] } else { [0, 0, 0, 255] };
        Rgba8::new(self.width, self.height, self.counts.iter().flat_map(pixel).collect())
    }

    /// The mask of the image at another size: a pixel counts where all that lies under it does, and
    /// under so many pixels around it, which its kernel reads.
    #[must_use]
    pub fn resized(&self, (width, height): (usize, usize), around: usize) -> Self {
        // Across first: `around` may be wide.
        let mut narrow = vec![true; width * self.height];
        for (row, line) in
            narrow.chunks_exact_mut(width.max(1)).zip(self.counts.chunks_exact(self.width.max(1)))
        {
            row.iter_mut().enumerate().for_each(|(x, counts)| {
                *counts = line[under(x, around, width, self.width)].iter().all(|c| *c);
            });
        }
        let counts = (0..width * height).map(|i| {
            let mut rows = under(i / width, around, height, self.height);
            rows.all(|y| narrow[y * width + i % width])
        });
        Self { width, height, counts: counts.collect() }
    }

    /// Share of the pixels that count.
    pub fn share(&self) -> f64 {
        self.counts.iter().filter(|c| **c).count() as f64 / self.counts.len().max(1) as f64
    }

    /// Gives an image another's pixels where its own don't count, so that the two don't differ
    /// there.
    ///
    /// # Panics
    /// When the sizes differ.
    pub fn fill(&self, image: &mut Image, other: &Image) {
        let size = (self.width, self.height);
        assert!(
            (image.width, image.height) == size && (other.width, other.height) == size,
            "a mask and its images have one size"
        );
        let pixels = image
            .data
            .chunks_exact_mut(image.channels)
            .zip(other.data.chunks_exact(other.channels));
        for ((to, from), counts) in pixels.zip(&self.counts) {
            if !counts {
                to.iter_mut().zip(from).for_each(|(to, from)| *to = *from);
            }
        }
    }
}

fn is_bright(p: &[u8]) -> bool {
    p[..3].iter().map(|&v| u16::from(v)).sum::<u16>() >= 3 * 128 && p[3] >= 128
}

/// Of `from` columns or rows, those under the pixels around one of `to`.
fn under(at: usize, around: usize, to: usize, from: usize) -> Range<usize> {
    let (first, end) = (at.saturating_sub(around), (at + 1 + around).min(to));
    first * from / to..(end * from).div_ceil(to)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(width: usize, rows: &[&str]) -> Mask {
        Mask {
            width,
            height: rows.len(),
            counts: rows.iter().flat_map(|r| r.bytes().map(|b| b == b'#')).collect(),
        }
    }

    #[test]
    fn dark_and_transparent_pixels_do_not_count() {
        let image = Rgba8::new(
            4,
            1,
            vec![255, 255, 255, 255, 10, 10, 10, 255, 255, 255, 255, 0, 128, 128, 128, 128],
        );
        assert_eq!(Mask::of(&image), mask(4, &["#..#"]));
        assert_eq!(Mask::of(&mask(4, &["#..#"]).to_rgba8()), mask(4, &["#..#"]));
        assert_eq!(mask(4, &["#..#"]).share(), 0.5);
    }

    /// Another size leaves out whatever a pixel that doesn't count has a part in, and nothing else.
    #[test]
    fn resized_masks_are_careful() {
        let whole = mask(6, &["######", "#####.", "######", "######"]);
        assert_eq!(whole.resized((3, 2), 0), mask(3, &["##.", "###"]));
        assert_eq!(whole.resized((3, 2), 1), mask(3, &["#..", "#.."]));
        assert_eq!(whole.resized((6, 4), 0), whole);
        // Four columns of one and a half: the last two have a part in column 4 or 5.
        assert_eq!(whole.resized((4, 4), 0), mask(4, &["####", "###.", "####", "####"]));
        assert_eq!(whole.resized((4, 1), 0), mask(4, &["###."]));
        assert_eq!(whole.resized((12, 8), 0).share(), 23.0 / 24.0);
    }

    #[test]
    fn what_does_not_count_is_filled() {
        let mut image = Image::new(2, 1, 3, vec![0.1; 6]);
        mask(2, &["#."]).fill(&mut image, &Image::new(2, 1, 4, vec![0.7; 8]));
        assert_eq!(image.data, [0.1, 0.1, 0.1, 0.7, 0.7, 0.7]);
    }
}

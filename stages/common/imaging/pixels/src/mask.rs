use std::ops::Range;
use std::path::Path;

use crate::error::PixelError;
use crate::image_buffer::{Image, Rgba8};
use crate::png_file::read_png;

/// Mask of an image's pixels. Those that don't count show something that isn't part of the scene,
/// such as passers-by.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// True for each pixel that counts, row by row.
    pub counts: Vec<bool>,
}

impl Mask {
    /// Creates a mask from an image, whose dark and transparent pixels don't count.
    pub fn of(image: &Rgba8) -> Self {
        Self {
            width: image.width,
            height: image.height,
            counts: image.data.chunks_exact(4).map(is_bright).collect(),
        }
    }

    /// Reads a mask from a PNG ([`Mask::of`]); fails if its size differs from the given one.
    pub fn read(path: &Path, (width, height): (usize, usize)) -> Result<Self, PixelError> {
        let image = read_png(path)?;
        if (image.width, image.height) != (width, height) {
            let reason = format!(
                "mask is {}×{} pixels, its image {width}×{height}",
                image.width, image.height
            );
            return Err(PixelError::format(path, reason));
        }
        Ok(Self::of(&image))
    }

    /// Draws the mask: white where a pixel counts, black elsewhere.
    pub fn to_rgba8(&self) -> Rgba8 {
        let pixel = |&counts: &bool| if counts { [255; 4] } else { [0, 0, 0, 255] };
        Rgba8::new(self.width, self.height, self.counts.iter().flat_map(pixel).collect())
    }

    /// Resizes the mask: a new pixel counts if all old pixels under it and its neighbours count.
    /// `margin` is the distance in new pixels up to which neighbours must count, too.
    #[must_use]
    pub fn resized(&self, (width, height): (usize, usize), margin: usize) -> Self {
        // Rows first, then columns: a wide margin stays cheap.
        let mut narrow = Vec::with_capacity(width * self.height);
        for y in 0..self.height {
            let line = &self.counts[y * self.width..(y + 1) * self.width];
            for x in 0..width {
                let covered = covered_range(x, margin, width, self.width);
                narrow.push(line[covered].iter().all(|counts| *counts));
            }
        }
        let mut counts = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let mut rows = covered_range(y, margin, height, self.height);
                counts.push(rows.all(|row| narrow[row * width + x]));
            }
        }
        Self { width, height, counts }
    }

    /// Returns the fraction of pixels that count.
    pub fn counted_fraction(&self) -> f64 {
        self.counts.iter().filter(|c| **c).count() as f64 / self.counts.len().max(1) as f64
    }

    /// Replaces an image's masked pixels by another image's, so that both are equal there.
    ///
    /// # Panics
    /// If the sizes differ.
    pub fn fill(&self, image: &mut Image, other: &Image) {
        let size = (self.width, self.height);
        assert!(
            (image.width, image.height) == size && (other.width, other.height) == size,
            "a mask and its images have one size"
        );
        let channels = image.channels.min(other.channels);
        for (i, counts) in self.counts.iter().enumerate() {
            if !counts {
                let to = &mut image.data[i * image.channels..][..channels];
                to.copy_from_slice(&other.data[i * other.channels..][..channels]);
            }
        }
    }
}

/// Minimum mean level, and minimum alpha, of a mask's pixels that count.
pub const MIN_BRIGHT_LEVEL: u8 = 128;

fn is_bright(p: &[u8]) -> bool {
    let sum = p[..3].iter().map(|&v| u16::from(v)).sum::<u16>();
    sum >= 3 * u16::from(MIN_BRIGHT_LEVEL) && p[3] >= MIN_BRIGHT_LEVEL
}

/// Returns the `old` columns or rows under one of `new`, with `margin` new ones to either side.
fn covered_range(index: usize, margin: usize, new: usize, old: usize) -> Range<usize> {
    let (first, end) = (index.saturating_sub(margin), (index + 1 + margin).min(new));
    first * old / new..(end * old).div_ceil(new)
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
        assert_eq!(mask(4, &["#..#"]).counted_fraction(), 0.5);
    }

    /// A new pixel counts if and only if all old pixels under it and its margin count.
    #[test]
    fn resized_masks_exclude_partly_masked_pixels() {
        let original = mask(6, &["######", "#####.", "######", "######"]);
        assert_eq!(original.resized((3, 2), 0), mask(3, &["##.", "###"]));
        assert_eq!(original.resized((3, 2), 1), mask(3, &["#..", "#.."]));
        assert_eq!(original.resized((6, 4), 0), original);
        // Each of the four columns covers 1.5 old columns: only the last overlaps column 5.
        assert_eq!(original.resized((4, 4), 0), mask(4, &["####", "###.", "####", "####"]));
        assert_eq!(original.resized((4, 1), 0), mask(4, &["###."]));
        assert_eq!(original.resized((12, 8), 0).counted_fraction(), 23.0 / 24.0);
    }

    #[test]
    fn masked_pixels_are_filled() {
        let mut image = Image::new(2, 1, 3, vec![0.1; 6]);
        mask(2, &["#."]).fill(&mut image, &Image::new(2, 1, 4, vec![0.7; 8]));
        assert_eq!(image.data, [0.1, 0.1, 0.1, 0.7, 0.7, 0.7]);
    }
}

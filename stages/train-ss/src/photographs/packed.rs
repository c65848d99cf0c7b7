use std::io;
use std::ops::Range;

use pixels::{Image, Mask, to_u8};
use rayon::prelude::*;
use scene::Photograph;

use super::pixel_memory::{Bytes, PixelMemory};
use super::pixel_set::PixelSet;

/// Format of a photograph's samples, row by row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SampleFormat {
    /// Three 8-bit levels; the photograph is opaque.
    Rgb8,
    /// Four 8-bit levels, straight alpha.
    Rgba8,
    /// Four floats, premultiplied alpha, for photographs that 8 bits can't restore.
    Rgba32,
}

impl SampleFormat {
    /// Returns the number of bytes of a pixel.
    fn size(self) -> usize {
        match self {
            Self::Rgb8 => 3,
            Self::Rgba8 => 4,
            Self::Rgba32 => 16,
        }
    }

    /// Encodes a pixel, premultiplied RGBA.
    fn write(self, pixel: [f32; 4], bytes: &mut [u8]) {
        match self {
            Self::Rgb8 => bytes.copy_from_slice(&straight(pixel)[..3]),
            Self::Rgba8 => bytes.copy_from_slice(&straight(pixel)),
            Self::Rgba32 => bytes.copy_from_slice(pixel.map(f32::to_le_bytes).as_flattened()),
        }
    }

    /// Decodes a pixel to premultiplied RGBA.
    fn pixel(self, bytes: &[u8]) -> [f32; 4] {
        match self {
            Self::Rgb8 => premultiplied([bytes[0], bytes[1], bytes[2], 255]),
            Self::Rgba8 => premultiplied([bytes[0], bytes[1], bytes[2], bytes[3]]),
            Self::Rgba32 => {
                let floats = bytes.as_chunks::<4>().0;
                [0, 1, 2, 3].map(|c| f32::from_le_bytes(floats[c]))
            }
        }
    }
}

/// Photograph in the smallest format that restores every sample exactly.
#[derive(Debug)]
pub(crate) struct PackedPhotograph {
    pub(crate) width: usize,
    pub(crate) height: usize,
    format: SampleFormat,
    bytes: Bytes,
    /// Unmasked pixels; `None` without a mask.
    mask: Option<PixelSet>,
    /// Grey level of the background; `None` for a transparent background.
    background: Option<f32>,
}

impl PackedPhotograph {
    /// Packs a photograph in premultiplied RGBA or in RGB.
    pub(crate) fn new(photograph: &Photograph, memory: &mut PixelMemory) -> io::Result<Self> {
        let Photograph { image, mask } = photograph;
        let (format, bytes) = pack(image);
        Ok(Self {
            width: image.width,
            height: image.height,
            format,
            bytes: memory.store(bytes)?,
            mask: mask.as_ref().map(|mask| mask.counts.iter().copied().collect()),
            background: None,
        })
    }

    /// Returns (width, height).
    pub(crate) fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    pub(crate) fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Composites the photograph over a grey level.
    pub(crate) fn over(self, background: f32) -> Self {
        Self { background: Some(background), ..self }
    }

    /// True if any pixel isn't masked.
    pub(crate) fn has_unmasked_pixels(&self) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask.len() > 0)
    }

    /// True if a pixel is valid: neither masked nor NaN.
    pub(crate) fn is_valid(&self, pixel: usize) -> bool {
        let is_masked = self.mask.as_ref().is_some_and(|mask| !mask.contains(pixel as u64));
        // Block means of a reference are NaN for blocks without valid pixels.
        !is_masked && (self.format != SampleFormat::Rgba32 || !self.pixel(pixel)[0].is_nan())
    }

    /// Returns a pixel in premultiplied RGBA, composited if there is a background; NaN if the pixel
    /// is masked.
    pub(crate) fn pixel(&self, pixel: usize) -> [f32; 4] {
        let mut out = [[0.0; 4]];
        self.read_row(pixel..pixel + 1, &mut out);
        out[0]
    }

    /// Reads neighbouring pixels of a row, see [`PackedPhotograph::pixel`].
    pub(crate) fn read_row(&self, pixels: Range<usize>, out: &mut [[f32; 4]]) {
        self.read_unmasked_row(pixels.clone(), out);
        let Some(mask) = &self.mask else { return };
        for (i, out) in out.iter_mut().enumerate().take(pixels.len()) {
            if !mask.contains((pixels.start + i) as u64) {
                *out = [f32::NAN; 4];
            }
        }
    }

    /// Prefetches both ends of a row of neighbouring pixels, see [`Bytes::prefetch`].
    pub(crate) fn prefetch(&self, pixels: &Range<usize>) {
        let size = self.format.size();
        self.bytes.prefetch(&(size * pixels.start..size * pixels.end));
    }

    /// Reads neighbouring pixels of a row and ignores the mask.
    fn read_unmasked_row(&self, pixels: Range<usize>, out: &mut [[f32; 4]]) {
        let size = self.format.size();
        let mut buffer = Vec::new();
        let bytes = self.bytes.read(size * pixels.start..size * pixels.end, &mut buffer);
        for (out, bytes) in out.iter_mut().zip(bytes.chunks_exact(size)) {
            let pixel = self.format.pixel(bytes);
            *out = match self.background {
                Some(background) => {
                    let [r, g, b] = [0, 1, 2].map(|c| pixel[c] + (1.0 - pixel[3]) * background);
                    [r, g, b, 1.0]
                }
                None => pixel,
            };
        }
    }

    /// Returns the image without its mask: RGB over a background, otherwise premultiplied RGBA.
    pub(crate) fn unmasked(&self) -> Image {
        self.image(Self::read_unmasked_row)
    }

    /// Returns the image, NaN at masked pixels.
    pub(crate) fn masked(&self) -> Image {
        self.image(Self::read_row)
    }

    fn image(&self, read: impl Fn(&Self, Range<usize>, &mut [[f32; 4]]) + Sync) -> Image {
        let channels = if self.background.is_some() { 3 } else { 4 };
        let mut data = vec![0.0; channels * self.pixels()];
        data.par_chunks_mut((channels * self.width).max(1)).enumerate().for_each_init(
            || vec![[0.0; 4]; self.width],
            |row, (y, samples)| {
                read(self, y * self.width..(y + 1) * self.width, row);
                for (x, pixel) in samples.chunks_exact_mut(channels).enumerate() {
                    pixel.copy_from_slice(&row[x][..channels]);
                }
            },
        );
        Image::new(self.width, self.height, channels, data)
    }

    /// Unpacks the photograph with its mask.
    pub(crate) fn unpack(&self) -> Photograph {
        let mask = self.mask.as_ref().map(|mask| Mask {
            width: self.width,
            height: self.height,
            counts: (0..self.pixels() as u64).map(|pixel| mask.contains(pixel)).collect(),
        });
        Photograph { image: self.unmasked(), mask }
    }
}

/// Converts an 8-bit level to 0..1.
fn level(byte: u8) -> f32 {
    f32::from(byte) / 255.0
}

/// Premultiplies a pixel of 8-bit levels with the same rounding as [`Image::premultiplied`].
fn premultiplied([r, g, b, a]: [u8; 4]) -> [f32; 4] {
    let alpha = level(a);
    [level(r) * alpha, level(g) * alpha, level(b) * alpha, alpha]
}

/// Converts a premultiplied pixel to the nearest 8-bit levels with straight alpha.
pub(crate) fn straight([r, g, b, a]: [f32; 4]) -> [u8; 4] {
    let [r, g, b] = [r, g, b].map(|colour| if a > 0.0 { to_u8(colour / a) } else { 0 });
    [r, g, b, to_u8(a)]
}

/// Returns the pixels of a row as RGBA; RGB is opaque.
fn row_pixels(image: &Image, y: usize) -> impl Iterator<Item = [f32; 4]> {
    let row = image.width * image.channels;
    image.data[y * row..(y + 1) * row]
        .chunks_exact(image.channels)
        .map(|p| [p[0], p[1], p[2], p.get(3).copied().unwrap_or(1.0)])
}

/// Encodes an RGBA or RGB image in the smallest format that restores every sample.
fn pack(image: &Image) -> (SampleFormat, Vec<u8>) {
    let rows = || (0..image.height).into_par_iter();
    let format = if !rows()
        .all(|y| row_pixels(image, y).all(|pixel| premultiplied(straight(pixel)) == pixel))
    {
        SampleFormat::Rgba32
    } else if rows().all(|y| row_pixels(image, y).all(|pixel| pixel[3] == 1.0)) {
        SampleFormat::Rgb8
    } else {
        SampleFormat::Rgba8
    };
    let mut bytes = vec![0; format.size() * image.width * image.height];
    bytes.par_chunks_mut((format.size() * image.width).max(1)).enumerate().for_each(|(y, row)| {
        for (out, pixel) in row.chunks_exact_mut(format.size()).zip(row_pixels(image, y)) {
            format.write(pixel, out);
        }
    });
    (format, bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn packed_photograph(
        image: Image,
        mask: Option<Mask>,
        memory: &mut PixelMemory,
    ) -> PackedPhotograph {
        PackedPhotograph::new(&Photograph { image, mask }, memory).unwrap()
    }

    proptest! {
        /// Every PNG's content needs a byte per sample, and is restored exactly from memory and
        /// from a file.
        #[test]
        fn bytes_are_restored(bytes in prop::collection::vec(any::<u8>(), 4 * 6), opaque: bool,
            background in 0.0f32..1.0) {
            let mut bytes = bytes;
            if opaque {
                bytes.iter_mut().skip(3).step_by(4).for_each(|alpha| *alpha = 255);
            }
            let image = Image::premultiplied(&pixels::Rgba8::new(3, 2, bytes));
            let folder = tempfile::tempdir().unwrap();
            for budget in [1000, 0] {
                let mut memory = PixelMemory::new(budget, folder.path().to_path_buf());
                let packed = packed_photograph(image.clone(), None, &mut memory);
                let is_opaque = image.data.chunks_exact(4).all(|p| p[3] == 1.0);
                prop_assert_eq!(packed.format,
                    if is_opaque { SampleFormat::Rgb8 } else { SampleFormat::Rgba8 });
                prop_assert_eq!(matches!(packed.bytes, Bytes::File { .. }), budget == 0);
                prop_assert_eq!(packed.unmasked(), image.clone());
                let over = packed.over(background);
                prop_assert_eq!(over.unmasked(), image.over(background));
                prop_assert_eq!(&over.pixel(4)[..3], &image.over(background).data[12..15]);
                prop_assert!(memory.first_error().is_none());
            }
        }
    }

    #[test]
    fn floats_and_masks_are_restored() {
        let image = Image::new(2, 1, 4, vec![0.1, 0.2, 0.3, 0.77, 0.5, 0.25, 0.125, 1.0]);
        let mask = Mask { width: 2, height: 1, counts: vec![false, true] };
        let packed =
            packed_photograph(image.clone(), Some(mask.clone()), &mut PixelMemory::unlimited());
        assert_eq!(packed.format, SampleFormat::Rgba32);
        assert!(
            packed.pixel(0).iter().all(|v| v.is_nan())
                && packed.pixel(1) == [0.5, 0.25, 0.125, 1.0]
        );
        assert_eq!(packed.unpack(), Photograph { image, mask: Some(mask) });
        assert!(packed.has_unmasked_pixels());
        let empty_mask = Mask { width: 2, height: 1, counts: vec![false; 2] };
        let grey = Image::new(2, 1, 3, vec![0.5; 6]);
        assert!(
            !packed_photograph(grey, Some(empty_mask), &mut PixelMemory::unlimited())
                .has_unmasked_pixels()
        );
    }
}

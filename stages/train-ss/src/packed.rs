use std::fs::File;
use std::hint::black_box;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use pixels::{Image, Mask, to_u8};
use rayon::prelude::*;
use scene::Photograph;

use crate::pixel_set::PixelSet;

/// Where pixels are kept: in memory, and beyond a budget in a file without a name, which goes with
/// the process.
///
/// The system keeps of that file in memory what it has place for, so little is lost while there is
/// some.
#[derive(Debug)]
pub(crate) struct PixelMemory {
    /// Bytes that may still be kept in memory.
    left: u64,
    /// Where the file goes.
    folder: PathBuf,
    file: Option<Arc<PixelFile>>,
    /// Where the file's next bytes go.
    end: u64,
}

impl PixelMemory {
    /// Keeps so many bytes in memory, and the rest in a file in `folder`.
    pub(crate) fn new(budget: u64, folder: PathBuf) -> Self {
        Self { left: budget, folder, file: None, end: 0 }
    }

    /// Keeps everything in memory.
    pub(crate) fn unlimited() -> Self {
        Self::new(u64::MAX, PathBuf::new())
    }

    /// Keeps bytes.
    pub(crate) fn keep(&mut self, bytes: Vec<u8>) -> io::Result<Bytes> {
        let length = bytes.len() as u64;
        if let Some(left) = self.left.checked_sub(length) {
            self.left = left;
            return Ok(Bytes::Memory(bytes));
        }
        let file = match &self.file {
            Some(file) => file,
            None => {
                let file = tempfile::tempfile_in(&self.folder)?;
                self.file.insert(Arc::new(PixelFile { file, fault: OnceLock::new() }))
            }
        };
        file.file.write_all_at(&bytes, self.end)?;
        let kept = Bytes::File { file: file.clone(), start: self.end, length: bytes.len() };
        self.end += length;
        Ok(kept)
    }

    /// Bytes that may still be kept in memory.
    pub(crate) fn left(&self) -> u64 {
        self.left
    }

    /// The first thing that went wrong with the file, if anything did: pixels read since then mean
    /// nothing.
    pub(crate) fn fault(&self) -> Option<&io::Error> {
        self.file.as_ref()?.fault.get()
    }

    /// Bytes that are in the file.
    #[cfg(test)]
    fn in_file(&self) -> u64 {
        self.end
    }
}

#[derive(Debug)]
pub(crate) struct PixelFile {
    file: File,
    fault: OnceLock<io::Error>,
}

impl PixelFile {
    /// Notes what went wrong. Whoever computes with pixels asks after each step.
    fn note(&self, done: io::Result<()>) {
        if let Err(error) = done {
            self.fault.get_or_init(|| error);
        }
    }
}

/// Bytes in memory or in a file.
#[derive(Debug)]
pub(crate) enum Bytes {
    Memory(Vec<u8>),
    File { file: Arc<PixelFile>, start: u64, length: usize },
}

impl Bytes {
    pub(crate) fn len(&self) -> usize {
        match self {
            Self::Memory(bytes) => bytes.len(),
            Self::File { length, .. } => *length,
        }
    }

    /// Some of the bytes: as they lie in memory, or read into `buffer`.
    pub(crate) fn read<'a>(&'a self, range: Range<usize>, buffer: &'a mut Vec<u8>) -> &'a [u8] {
        match self {
            Self::Memory(bytes) => &bytes[range],
            Self::File { file, start, .. } => {
                buffer.clear();
                buffer.resize(range.len(), 0);
                file.note(file.file.read_exact_at(buffer, start + range.start as u64));
                buffer
            }
        }
    }

    /// Loads the first and the last of some bytes that are soon read, if they are in memory: most
    /// rows lie in two cache lines. Calls that follow each other wait for memory together; reads
    /// with work between them would wait one by one.
    pub(crate) fn touch(&self, range: &Range<usize>) {
        if let Self::Memory(bytes) = self
            && let Some(row) = bytes.get(range.clone())
        {
            black_box((row.first().copied(), row.last().copied()));
        }
    }

    /// Puts bytes in the place of others.
    pub(crate) fn write(&mut self, at: usize, bytes: &[u8]) {
        match self {
            Self::Memory(kept) => kept[at..at + bytes.len()].copy_from_slice(bytes),
            Self::File { file, start, .. } => {
                file.note(file.file.write_all_at(bytes, *start + at as u64));
            }
        }
    }
}

/// How a photograph's samples are kept, row by row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Samples {
    /// Three 8-bit levels; all is opaque.
    Rgb8,
    /// Four 8-bit levels, alpha straight.
    Rgba8,
    /// Four floats, alpha premultiplied: what 8 bits can't give back.
    Rgba32,
}

impl Samples {
    /// Bytes of a pixel.
    fn size(self) -> usize {
        match self {
            Self::Rgb8 => 3,
            Self::Rgba8 => 4,
            Self::Rgba32 => 16,
        }
    }

    /// Writes a pixel, premultiplied RGBA, as those bytes.
    fn write(self, pixel: [f32; 4], bytes: &mut [u8]) {
        match self {
            Self::Rgb8 => bytes.copy_from_slice(&straight(pixel)[..3]),
            Self::Rgba8 => bytes.copy_from_slice(&straight(pixel)),
            Self::Rgba32 => bytes
                .as_chunks_mut::<4>()
                .0
                .iter_mut()
                .zip(pixel)
                .for_each(|(b, v)| *b = v.to_le_bytes()),
        }
    }

    /// A pixel of those bytes: premultiplied RGBA.
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

/// A photograph in as few bytes as give every sample back to the last bit.
#[derive(Debug)]
pub(crate) struct PackedPhotograph {
    width: usize,
    height: usize,
    samples: Samples,
    bytes: Bytes,
    /// Which pixels count, where not all do.
    mask: Option<PixelSet>,
    /// The grey level that it lies over; none while its background is open.
    over: Option<f32>,
}

impl PackedPhotograph {
    /// Packs a photograph: premultiplied RGBA, or RGB.
    pub(crate) fn new(photograph: &Photograph, memory: &mut PixelMemory) -> io::Result<Self> {
        let Photograph { image, mask } = photograph;
        let (samples, bytes) = packed(image);
        let mask = mask.as_ref().map(|mask| mask.counts.iter().copied().collect());
        let bytes = memory.keep(bytes)?;
        Ok(Self { width: image.width, height: image.height, samples, bytes, mask, over: None })
    }

    pub(crate) fn width(&self) -> usize {
        self.width
    }

    pub(crate) fn height(&self) -> usize {
        self.height
    }

    pub(crate) fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Over a grey level.
    pub(crate) fn over(self, background: f32) -> Self {
        Self { over: Some(background), ..self }
    }

    /// Whether anything counts.
    pub(crate) fn is_known(&self) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask.len() > 0)
    }

    /// Whether a pixel counts.
    pub(crate) fn counts(&self, pixel: usize) -> bool {
        let is_masked = self.mask.as_ref().is_some_and(|mask| !mask.contains(pixel as u64));
        // Floats may be means of nothing.
        !is_masked && (self.samples != Samples::Rgba32 || !self.pixel(pixel)[0].is_nan())
    }

    /// A pixel: premultiplied RGBA, opaque over a background; NaN where it doesn't count.
    pub(crate) fn pixel(&self, pixel: usize) -> [f32; 4] {
        let mut out = [[0.0; 4]];
        self.row(pixel..pixel + 1, &mut out);
        out[0]
    }

    /// Neighbouring pixels of a row, see [`PackedPhotograph::pixel`].
    pub(crate) fn row(&self, pixels: Range<usize>, out: &mut [[f32; 4]]) {
        self.whole_row(pixels.clone(), out);
        let Some(mask) = &self.mask else { return };
        for (out, pixel) in out.iter_mut().zip(pixels) {
            if !mask.contains(pixel as u64) {
                *out = [f32::NAN; 4];
            }
        }
    }

    /// Loads the ends of a row of neighbouring pixels, see [`Bytes::touch`].
    pub(crate) fn touch(&self, pixels: &Range<usize>) {
        let size = self.samples.size();
        self.bytes.touch(&(size * pixels.start..size * pixels.end));
    }

    /// Neighbouring pixels, whether they count or not.
    fn whole_row(&self, pixels: Range<usize>, out: &mut [[f32; 4]]) {
        let (size, mut buffer) = (self.samples.size(), Vec::new());
        let bytes = self.bytes.read(size * pixels.start..size * pixels.end, &mut buffer);
        for (out, bytes) in out.iter_mut().zip(bytes.chunks_exact(size)) {
            let pixel = self.samples.pixel(bytes);
            *out = match self.over {
                Some(background) => {
                    let [r, g, b] = [0, 1, 2].map(|c| pixel[c] + (1.0 - pixel[3]) * background);
                    [r, g, b, 1.0]
                }
                None => pixel,
            };
        }
    }

    /// What was photographed, whether it counts or not: RGB over a background, premultiplied RGBA
    /// where that is open.
    pub(crate) fn whole(&self) -> Image {
        self.image(Self::whole_row)
    }

    /// The same, NaN where it doesn't count.
    pub(crate) fn known(&self) -> Image {
        self.image(Self::row)
    }

    fn image(&self, read: impl Fn(&Self, Range<usize>, &mut [[f32; 4]]) + Sync) -> Image {
        let channels = if self.over.is_some() { 3 } else { 4 };
        let mut data = vec![0.0; channels * self.pixels()];
        data.par_chunks_mut((channels * self.width).max(1)).enumerate().for_each_init(
            || vec![[0.0; 4]; self.width],
            |row, (y, samples)| {
                read(self, y * self.width..(y + 1) * self.width, row);
                samples
                    .chunks_exact_mut(channels)
                    .zip(row)
                    .for_each(|(out, pixel)| out.copy_from_slice(&pixel[..channels]));
            },
        );
        Image::new(self.width, self.height, channels, data)
    }

    /// The photograph, with its mask.
    pub(crate) fn unpacked(&self) -> Photograph {
        let all = 0..self.pixels() as u64;
        let mask = self.mask.as_ref().map(|mask| Mask {
            width: self.width,
            height: self.height,
            counts: all.map(|pixel| mask.contains(pixel)).collect(),
        });
        Photograph { image: self.whole(), mask }
    }
}

/// An 8-bit level in [0, 1].
fn level(byte: u8) -> f32 {
    f32::from(byte) / 255.0
}

/// As [`Image::premultiplied`] has it.
fn premultiplied([r, g, b, a]: [u8; 4]) -> [f32; 4] {
    let alpha = level(a);
    [level(r) * alpha, level(g) * alpha, level(b) * alpha, alpha]
}

/// The 8-bit levels, alpha straight, nearest to a premultiplied pixel.
pub(crate) fn straight([r, g, b, a]: [f32; 4]) -> [u8; 4] {
    let of = |colour: f32| if a > 0.0 { to_u8(colour / a) } else { 0 };
    [of(r), of(g), of(b), to_u8(a)]
}

/// Pixels of a row.
fn row_of(image: &Image, y: usize) -> impl Iterator<Item = &[f32]> {
    let row = image.width * image.channels;
    image.data[y * row..(y + 1) * row].chunks_exact(image.channels)
}

/// The bytes of an image, RGBA or RGB: 8-bit levels where they give every sample back.
fn packed(image: &Image) -> (Samples, Vec<u8>) {
    let channels = image.channels;
    let row_of = |y: usize| row_of(image, y);
    let pixel = |p: &[f32]| [p[0], p[1], p[2], p.get(3).copied().unwrap_or(1.0)];
    let is_level = |p: &[f32]| premultiplied(straight(pixel(p))) == pixel(p);
    let rows = || (0..image.height).into_par_iter();
    let samples = if !rows().all(|y| row_of(y).all(is_level)) {
        Samples::Rgba32
    } else if channels == 3 || rows().all(|y| row_of(y).all(|p| p[3] == 1.0)) {
        Samples::Rgb8
    } else {
        Samples::Rgba8
    };
    let mut bytes = vec![0; samples.size() * image.width * image.height];
    bytes.par_chunks_mut((samples.size() * image.width).max(1)).enumerate().for_each(|(y, row)| {
        for (out, p) in row.chunks_exact_mut(samples.size()).zip(row_of(y)) {
            samples.write(pixel(p), out);
        }
    });
    (samples, bytes)
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
        /// Whatever a PNG holds takes a byte a sample, and comes back to the last bit, from memory
        /// and from a file.
        #[test]
        fn eight_bits_come_back(bytes in prop::collection::vec(any::<u8>(), 4 * 6), opaque: bool,
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
                prop_assert_eq!(packed.samples,
                    if is_opaque { Samples::Rgb8 } else { Samples::Rgba8 });
                prop_assert_eq!(memory.in_file() > 0, budget == 0);
                prop_assert_eq!(packed.whole(), image.clone());
                let over = packed.over(background);
                prop_assert_eq!(over.whole(), image.over(background));
                prop_assert_eq!(&over.pixel(4)[..3], &image.over(background).data[12..15]);
                prop_assert!(memory.fault().is_none());
            }
        }
    }

    #[test]
    fn floats_and_masks_come_back() {
        let image = Image::new(2, 1, 4, vec![0.1, 0.2, 0.3, 0.77, 0.5, 0.25, 0.125, 1.0]);
        let mask = Mask { width: 2, height: 1, counts: vec![false, true] };
        let packed =
            packed_photograph(image.clone(), Some(mask.clone()), &mut PixelMemory::unlimited());
        assert_eq!(packed.samples, Samples::Rgba32);
        assert!(
            packed.pixel(0).iter().all(|v| v.is_nan())
                && packed.pixel(1) == [0.5, 0.25, 0.125, 1.0]
        );
        assert_eq!(packed.unpacked(), Photograph { image, mask: Some(mask) });
        assert!(packed.is_known());
        let none = Mask { width: 2, height: 1, counts: vec![false; 2] };
        let grey = Image::new(2, 1, 3, vec![0.5; 6]);
        assert!(!packed_photograph(grey, Some(none), &mut PixelMemory::unlimited()).is_known());
    }

    /// What is written is read again; where it can't be, that is known.
    #[test]
    fn files_are_written_and_their_faults_known() {
        let folder = tempfile::tempdir().unwrap();
        let mut memory = PixelMemory::new(2, folder.path().to_path_buf());
        let (mut first, mut second) =
            (memory.keep(vec![1, 2]).unwrap(), memory.keep(vec![3, 4, 5]).unwrap());
        assert!(matches!(first, Bytes::Memory(_)) && matches!(second, Bytes::File { .. }));
        let mut buffer = Vec::new();
        for bytes in [&mut first, &mut second] {
            bytes.write(1, &[9]);
            assert_eq!(bytes.read(1..2, &mut buffer), [9]);
        }
        assert_eq!(second.read(0..3, &mut buffer), [3, 9, 5]);
        assert!(memory.fault().is_none());
        memory.file.as_ref().unwrap().file.set_len(1).unwrap();
        second.read(0..3, &mut buffer);
        assert!(memory.fault().is_some());
        assert!(PixelMemory::new(0, folder.path().join("none")).keep(vec![1]).is_err());
    }
}

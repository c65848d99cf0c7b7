use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Cursor, Seek};
use std::path::Path;

use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use pixels::{
    COLOUR_CHANNELS, MAX_PIXELS, Mask, PixelError, Rgba8, exr_reading_bytes, exr_size, read_exr,
    srgb_from_linear, to_u8,
};
use scene::{Intrinsics, undistort_image};

use crate::clipping::Clipping;
use crate::error::DatasetError;
use crate::frame::Frame;
use crate::frame_reason::FrameReason;
use crate::jpeg::{END_MARKER, Extent, extent};
use crate::turn::Turn;
use crate::unread::refusal;

/// Extensions of the images that are read.
pub(crate) const IMAGE_EXTENSIONS: [&str; 4] = [".png", ".jpg", ".jpeg", ".exr"];

/// True if a file's name is that of an image.
pub fn is_image_name(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    matches!(extension.as_deref(), Some("png" | "jpg" | "jpeg" | "exr"))
}

pub(crate) fn is_exr(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr"))
}

fn io_error(path: &Path, source: io::Error) -> PixelError {
    PixelError::Io { path: path.to_path_buf(), source }
}

/// Opens a decoder of a PNG or JPEG, recognised by content rather than by name.
fn decoder<R: BufRead + Seek + 'static>(
    file: R,
    path: &Path,
) -> Result<impl ImageDecoder + use<R>, PixelError> {
    let guessed = ImageReader::new(file).with_guessed_format();
    let mut reader = guessed.map_err(|source| io_error(path, source))?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(8 * MAX_PIXELS as u64);
    reader.limits(limits);
    let reason = match reader.format() {
        Some(ImageFormat::Png | ImageFormat::Jpeg) => match reader.into_decoder() {
            Ok(decoder) => return Ok(decoder),
            Err(error) => format!("its header can't be read ({})", error.to_string().trim_end()),
        },
        _ => match refusal(path) {
            Some(error) => return Err(error),
            None => "neither PNG, JPEG nor EXR".to_owned(),
        },
    };
    Err(PixelError::Format { path: path.to_path_buf(), reason })
}

/// Size and orientation of an image, from its header.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Stored {
    /// Columns and rows.
    pub(crate) size: (u32, u32),
    /// Turn that its EXIF data ask for.
    pub(crate) orientation: Orientation,
}

impl Stored {
    /// True if EXIF asks for a quarter turn.
    pub(crate) fn is_sideways(self) -> bool {
        use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
        matches!(self.orientation, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH)
    }

    /// Treatment of the image where its camera's shape doesn't settle that.
    pub(crate) fn assumed_turn(self) -> Turn {
        if self.orientation == Orientation::NoTransforms { Turn::Stored } else { Turn::Assumed }
    }
}

/// Looks at an image's header.
pub(crate) fn look(path: &Path) -> Result<Stored, PixelError> {
    let format = |reason: String| PixelError::Format { path: path.to_path_buf(), reason };
    if is_exr(path) {
        let (width, height) = exr_size(path)?;
        let size = (width as u32, height as u32);
        return Ok(Stored { size, orientation: Orientation::NoTransforms });
    }
    let file = File::open(path).map_err(|source| io_error(path, source))?;
    let mut decoder = decoder(BufReader::new(file), path)?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err(format(format!("{width}×{height} pixels")));
    }
    if u64::from(width) * u64::from(height) > MAX_PIXELS as u64 {
        let (width, height) = (width as usize, height as usize);
        return Err(PixelError::TooLarge { path: path.to_path_buf(), width, height });
    }
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok(Stored { size: (width, height), orientation })
}

/// Returns the intrinsics for the stored image, whose size may differ from the camera's, but not in
/// shape, and the treatment of its EXIF orientation.
pub(crate) fn fitted(k: Intrinsics, stored: Stored) -> Result<(Intrinsics, Turn), FrameReason> {
    let (width, height) = stored.size;
    let is_turned_fit = stored.is_sideways() && has_shape_of(&k, height, width);
    let is_turned_exactly = stored.is_sideways() && (k.height, k.width) == stored.size;
    if (k.width, k.height) == stored.size {
        let is_settled = stored.is_sideways() && width != height;
        Ok((k, if is_settled { Turn::Stored } else { stored.assumed_turn() }))
    } else if has_shape_of(&k, width, height) && !is_turned_exactly {
        let is_settled = stored.is_sideways() && !is_turned_fit;
        let turn = if is_settled { Turn::Stored } else { stored.assumed_turn() };
        Ok((k.resized(width, height), turn))
    } else if is_turned_fit {
        Ok((k.resized(height, width), Turn::Upright))
    } else {
        Err(FrameReason::Shape { image: stored.size, camera: (k.width, k.height) })
    }
}

/// True if an image of a size may be a smaller copy of the camera's.
pub(crate) fn has_shape_of(k: &Intrinsics, width: u32, height: u32) -> bool {
    let (across, down) = (
        f64::from(width) / f64::from(k.width.max(1)),
        f64::from(height) / f64::from(k.height.max(1)),
    );
    // A smaller copy's sides are rounded.
    (across / down - 1.0).abs() <= 0.01 + 1.0 / f64::from(width.min(height).max(1))
}

/// Reads an image with its stored pixels, or turned as its EXIF data ask. One that isn't whole is
/// refused.
fn read(path: &Path, turned: bool) -> Result<(Rgba8, Clipping), PixelError> {
    let format = |reason: String| PixelError::Format { path: path.to_path_buf(), reason };
    if is_exr(path) {
        return encoded(path);
    }
    let mut bytes = fs::read(path).map_err(|source| io_error(path, source))?;
    if image::guess_format(&bytes).is_ok_and(|format| format == ImageFormat::Jpeg) {
        complete(&mut bytes).map_err(format)?;
    }
    let mut decoder = decoder(Cursor::new(bytes), path)?;
    let turn = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    let mut image = DynamicImage::from_decoder(decoder)
        .map_err(|e| format(format!("not a whole image ({e})")))?;
    if turned {
        image.apply_orientation(turn);
    }
    Ok((image.into(), Clipping::default()))
}

/// Refuses a JPEG that lacks image data, which its decoder would replace by grey. A missing end
/// marker is added: without it the decoder leaves out the last rows.
fn complete(jpeg: &mut Vec<u8>) -> Result<(), String> {
    match extent(jpeg) {
        Extent::Whole => Ok(()),
        Extent::Unterminated => {
            jpeg.extend(END_MARKER);
            Ok(())
        }
        Extent::Missing { rows, of } => {
            Err(format!("cut short or damaged: {rows} of {of} rows are missing"))
        }
        Extent::Coarse { scan, rows } => Err(format!(
            "cut short or damaged in scan {scan} of a progressive JPEG: detail of all {rows} rows is \
            missing"
        )),
    }
}

/// An EXR's linear light, display-encoded.
fn encoded(path: &Path) -> Result<(Rgba8, Clipping), PixelError> {
    let image = read_exr(path)?.with_finite(&COLOUR_CHANNELS, path)?;
    let format = |reason: String| PixelError::Format { path: path.to_path_buf(), reason };
    let [r, g, b] = ["R", "G", "B"]
        .map(|name| image.channel(name).ok_or_else(|| format(format!("no channel {name}"))));
    let (r, g, b, a) = (r?, g?, b?, image.channel("A"));
    let pixel = |i: usize| ([r[i], g[i], b[i]], a.map_or(1.0, |a| a[i]));
    let count = image.width * image.height;
    let pixels = (0..count).map(pixel).flat_map(|(colour, alpha)| encoded_pixel(colour, alpha));
    let encoded = Rgba8::new(image.width, image.height, pixels.collect());
    let clipping = (0..count).map(pixel).map(|(colour, alpha)| Clipping::of_pixel(colour, alpha));
    Ok((encoded, clipping.sum()))
}

/// EXR files keep premultiplied colours, ours straight ones.
fn encoded_pixel(colour: [f32; 3], alpha: f32) -> [u8; 4] {
    let encode = |v: f32| to_u8(srgb_from_linear(f64::from((v / alpha).clamp(0.0, 1.0))) as f32);
    let [r, g, b] = colour.map(|v| if alpha > 0.0 { encode(v) } else { 0 });
    [r, g, b, to_u8(alpha)]
}

/// Bytes of an 8-bit RGBA pixel.
const RGBA_BYTES: u64 = 4;
/// Bytes that decoding a JPEG takes for a pixel besides: a progressive one's coefficients.
const COEFFICIENT_BYTES: u64 = 6;

/// Returns the bytes of memory that reading an image takes at its peak, by its header alone.
fn reading_bytes(path: &Path) -> Result<u64, PixelError> {
    if is_exr(path) {
        let (width, height) = exr_size(path)?;
        return Ok(exr_reading_bytes(path)? + RGBA_BYTES * (width * height) as u64);
    }
    let file = File::open(path).map_err(|source| io_error(path, source))?;
    let decoder = decoder(BufReader::new(file), path)?;
    let (width, height) = decoder.dimensions();
    let pixels = u64::from(width) * u64::from(height);
    Ok(decoder.total_bytes() + (RGBA_BYTES + COEFFICIENT_BYTES) * pixels)
}

impl Frame {
    /// Returns the bytes of memory that [`Frame::photograph`] takes at its peak, by the image's
    /// header.
    pub fn reading_bytes(&self) -> Result<u64, DatasetError> {
        Ok(reading_bytes(&self.image)?)
    }

    /// The image that [`Frame::camera`] sees: as it was taken, or with its distortion undone, as
    /// sharp as it was.
    pub fn photograph(&self) -> Result<Rgba8, DatasetError> {
        Ok(self.photograph_and_clipping()?.0)
    }

    /// Returns [`Frame::photograph`], and how many of its pixels were brighter than white.
    pub fn photograph_and_clipping(&self) -> Result<(Rgba8, Clipping), DatasetError> {
        let (image, clipping) = read(&self.image, self.turn == Turn::Upright)?;
        let k = self.taken_with;
        if (image.width, image.height) != (k.width as usize, k.height as usize) {
            let reason = format!(
                "{}×{} pixels where its camera has {}×{}",
                image.width, image.height, k.width, k.height
            );
            return Err(PixelError::Format { path: self.image.clone(), reason }.into());
        }
        Ok((self.seen(image), clipping))
    }

    /// Returns which of [`Frame::photograph`]'s pixels count: those of its mask whose rays the lens
    /// has. `None` if all do. A mask of another size than the photograph's is resampled by nearest
    /// neighbour.
    pub fn mask(&self) -> Result<Option<Mask>, DatasetError> {
        let lens = self.intrinsics().lens_mask();
        let Some(file) = &self.mask else { return Ok(lens) };
        let (image, _) = read(&file.path, self.turn == Turn::Upright)?;
        let size = (self.taken_with.width as usize, self.taken_with.height as usize);
        let mut mask = Mask::of(&self.seen(nearest(&image, size)));
        if file.kind.is_inverted() {
            mask.counts.iter_mut().for_each(|counts| *counts = !*counts);
        }
        if let Some(lens) = lens {
            let counts = mask.counts.iter_mut().zip(lens.counts);
            counts.for_each(|(counts, has_ray)| *counts &= has_ray);
        }
        Ok(Some(mask))
    }

    /// Returns an image of the photograph's pixels as the camera sees it.
    fn seen(&self, image: Rgba8) -> Rgba8 {
        match &self.pinhole {
            Some(pinhole) => undistort_image(&image, &self.taken_with, pinhole),
            None => image,
        }
    }
}

/// Returns an image at another size: each pixel is that of the nearest pixel centre.
fn nearest(image: &Rgba8, (width, height): (usize, usize)) -> Rgba8 {
    let mut data = Vec::with_capacity(4 * width * height);
    for y in 0..height {
        let row = (2 * y + 1) * image.height / (2 * height);
        for x in 0..width {
            let column = (2 * x + 1) * image.width / (2 * width);
            let at = 4 * (row * image.width + column);
            data.extend_from_slice(&image.data[at..at + 4]);
        }
    }
    Rgba8::new(width, height, data)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::jpeg::tests::jpeg;
    use jpeg_encoder::SamplingFactor;
    use scene::Distortion;

    /// An image whose red says the column and whose green says the row.
    fn ramp(width: usize, height: usize) -> Rgba8 {
        let pixel =
            |i: usize| [(i % width * 255 / width) as u8, (i / width * 255 / height) as u8, 90, 255];
        Rgba8::new(width, height, (0..width * height).flat_map(pixel).collect())
    }

    pub(crate) fn write_png(path: &Path, width: usize, height: usize) {
        pixels::write_png(path, &ramp(width, height)).unwrap();
    }

    #[test]
    fn a_jpeg_is_read_by_what_it_is() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let image = ramp(32, 16);
        let rgb: Vec<u8> = image.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
        let mut bytes = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95)
            .encode(&rgb, 32, 16, image::ExtendedColorType::Rgb8)
            .unwrap();
        std::fs::write(&path, &bytes).unwrap();
        assert_eq!(
            look(&path).unwrap(),
            Stored { size: (32, 16), orientation: Orientation::NoTransforms }
        );
        let read = super::read(&path, false).unwrap().0;
        let worst = read.data.iter().zip(&image.data).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(worst < 12, "{worst}");
        for end in 0..bytes.len() {
            std::fs::write(&path, &bytes[..end]).unwrap();
            drop(super::read(&path, false));
        }
        // What its header says is looked at before anything is allocated, and the limit is said.
        let mut huge = bytes.clone();
        let frame = huge.windows(2).position(|marker| marker == b"\xff\xc0").unwrap();
        huge[frame + 5..frame + 9]
            .copy_from_slice(&[20_000u16.to_be_bytes(), 20_000u16.to_be_bytes()].concat());
        std::fs::write(&path, &huge).unwrap();
        let message = look(&path).unwrap_err().to_string();
        assert!(
            message.ends_with(
                "20000×20000 pixels exceed the limit of 268435456 (16384×16384, for \
                    example): make the image smaller"
            ),
            "{message}"
        );
        // The same with an EXIF block (APP1) that asks for a quarter turn: right where the camera's
        // shape says so, else left alone.
        let mut turned = bytes[..2].to_vec();
        turned.extend(
            b"\xff\xe1\x00\x22Exif\0\0II\x2a\0\x08\0\0\0\
            \x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0",
        );
        turned.extend(&bytes[2..]);
        std::fs::write(&path, &turned).unwrap();
        let stored = look(&path).unwrap();
        assert!(stored.size == (32, 16) && stored.is_sideways());
        let of = |width, height| Intrinsics::from_angle_x(width, height, 0.5);
        assert_eq!(fitted(of(32, 16), stored).unwrap(), (of(32, 16), Turn::Stored));
        assert_eq!(fitted(of(64, 32), stored).unwrap(), (of(64, 32).resized(32, 16), Turn::Stored));
        assert_eq!(fitted(of(16, 32), stored).unwrap(), (of(16, 32), Turn::Upright));
        assert!(fitted(of(32, 32), stored).unwrap_err().to_string().contains("another shape"));
        let upright = super::read(&path, true).unwrap().0;
        assert_eq!((upright.width, upright.height), (16, 32));
        assert!(
            upright.data[0] < 20 && upright.data[1] > 200,
            "its bottom left corner is now its top left one"
        );
        std::fs::write(&path, "no image").unwrap();
        assert!(look(&path).unwrap_err().to_string().contains("a.png"));
        let other = dir.path().join("a.dat");
        std::fs::write(&other, "no image").unwrap();
        assert!(look(&other).unwrap_err().to_string().contains("neither PNG, JPEG nor EXR"));
    }

    /// A NaN is neither black nor transparent, and an infinity isn't white.
    #[test]
    fn pixels_that_are_not_finite_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        let read_with = |bad: [f32; 4]| {
            exr::prelude::write_rgba_file(&path, 4, 3, |x, y| {
                let [r, g, b, a] = if (x, y) == (1, 2) { bad } else { [0.25; 4] };
                (r, g, b, a)
            })
            .unwrap();
            super::read(&path, false)
        };
        assert!(read_with([1e9, -1.0, 0.0, 1.0]).is_ok());
        for (index, channel) in COLOUR_CHANNELS.into_iter().enumerate() {
            for (value, words) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf")] {
                let mut bad = [0.25; 4];
                bad[index] = value;
                let message = read_with(bad).unwrap_err().to_string();
                let expected = format!("a.exr: channel {channel} is {words} at column 1, row 2;");
                assert!(message.contains(&expected), "{message}");
            }
        }
    }

    #[test]
    fn a_jpeg_that_is_cut_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.jpg");
        let read = |bytes: &[u8]| {
            fs::write(&path, bytes).unwrap();
            super::read(&path, false).map_err(|error| error.to_string())
        };
        let bytes = jpeg((40, 64), Some(SamplingFactor::R_4_2_0), false, 3);
        let whole = read(&bytes).unwrap();
        assert_eq!(
            read(&bytes[..bytes.len() - 2]),
            Ok(whole.clone()),
            "only the end marker is cut"
        );
        assert_eq!(read(&[&bytes, &b"more"[..]].concat()), Ok(whole));
        let progressive = jpeg((40, 64), Some(SamplingFactor::R_4_2_0), true, 0);
        let third = bytes.windows(2).position(|w| w == [0xff, 0xd1]).unwrap();
        for (bytes, words) in [
            (&bytes[..third], "a.jpg: cut short or damaged: 32 of 64 rows are missing; export"),
            (&bytes[..bytes.len() - 9], "a.jpg: cut short or damaged: 16 of 64 rows are missing;"),
            (&bytes[..100], "a.jpg: cut short or damaged: 64 of 64 rows are missing; export"),
            (&bytes[..20], "a.jpg: its header can't be read (Format error"),
            (&progressive[..progressive.len() - 1], "detail of all 64 rows is missing; export"),
        ] {
            let message = read(bytes).unwrap_err();
            assert!(message.contains(words), "{message}");
        }
    }

    /// Smooth in the direction of the ray, so that what each lens sees is known exactly.
    fn colour_towards([u, v]: [f64; 2]) -> [u8; 4] {
        [(128.0 + 90.0 * (6.0 * u).sin()) as u8, (128.0 + 90.0 * (5.0 * v).cos()) as u8, 60, 255]
    }

    /// Where a distorted position comes from, by fixed-point iteration.
    fn ray_through(intrinsics: &Intrinsics, x: f64, y: f64) -> [f64; 2] {
        let seen = [(x - intrinsics.cx) / intrinsics.fx, (y - intrinsics.cy) / intrinsics.fy];
        let mut at = seen;
        for _ in 0..50 {
            let there = intrinsics.distortion.distort(at);
            at = [at[0] + seen[0] - there[0], at[1] + seen[1] - there[1]];
        }
        at
    }

    fn image_of(ray: &dyn Fn(f64, f64) -> [f64; 2]) -> Rgba8 {
        let pixel = |i: usize| colour_towards(ray((i % 120) as f64 + 0.5, (i / 120) as f64 + 0.5));
        Rgba8::new(120, 90, (0..120 * 90).flat_map(pixel).collect())
    }

    /// A pinhole image seen through a lens and undone is the pinhole image again.
    #[test]
    fn distortion_is_undone() {
        let distortion = Distortion::brown([-0.12, 0.02, 0.0], [0.002, -0.001]);
        let intrinsics = Intrinsics {
            width: 120,
            height: 90,
            fx: 110.0,
            fy: 108.0,
            cx: 61.0,
            cy: 44.0,
            distortion,
        };
        let pinhole = intrinsics.pinhole().unwrap();
        assert!(pinhole.fx != intrinsics.fx);
        let expected =
            image_of(&|x, y| [(x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy]);
        let found = undistort_image(
            &image_of(&|x, y| ray_through(&intrinsics, x, y)),
            &intrinsics,
            &pinhole,
        );
        let worst =
            found.data.iter().zip(&expected.data).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(worst <= 3, "{worst}");
    }
}

use std::fs::{self, File};
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::Path;

use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use pixels::{
    COLOUR_CHANNELS, MAX_PIXELS, Mask, PixelError, Rgba8, exr_reading_bytes, exr_size, read_exr,
    srgb_from_linear, to_u8,
};
use scene::{Intrinsics, undistort_image};

use crate::error::{DatasetError, FrameReason};
use crate::frame::{Frame, Turn};
use crate::jpeg::{END_MARKER, Extent, extent};
use crate::unsupported::unsupported_error;

/// Extensions of supported images.
pub(crate) const IMAGE_EXTENSIONS: [&str; 4] = [".png", ".jpg", ".jpeg", ".exr"];

/// True if a file's name is that of a supported image.
pub fn is_image_name(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    matches!(extension.as_deref(), Some("png" | "jpg" | "jpeg" | "exr"))
}

pub(crate) fn is_exr(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr"))
}

/// Creates the decoder of a PNG or JPEG, recognised by content rather than by name.
fn decoder<R: BufRead + Seek + 'static>(
    file: R,
    path: &Path,
) -> Result<impl ImageDecoder + use<R>, PixelError> {
    let guessed = ImageReader::new(file).with_guessed_format();
    let mut reader = guessed.map_err(PixelError::io(path))?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(8 * MAX_PIXELS as u64);
    reader.limits(limits);
    let reason = match reader.format() {
        Some(ImageFormat::Png | ImageFormat::Jpeg) => match reader.into_decoder() {
            Ok(decoder) => return Ok(decoder),
            Err(error) => format!("cannot read its header ({})", error.to_string().trim_end()),
        },
        _ => match unsupported_error(path) {
            Some(error) => return Err(error),
            None => "neither PNG, JPEG nor EXR".to_owned(),
        },
    };
    Err(PixelError::format(path, reason))
}

/// Size and orientation of an image, from its header.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ImageHeader {
    /// Width and height of the stored image.
    pub(crate) size: (u32, u32),
    /// Orientation from EXIF data.
    pub(crate) orientation: Orientation,
}

impl ImageHeader {
    /// True if EXIF requires a quarter turn.
    pub(crate) fn is_sideways(self) -> bool {
        use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
        matches!(self.orientation, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH)
    }

    /// Returns the treatment of the EXIF orientation for a camera whose shape fits both the stored
    /// and the turned image.
    pub(crate) fn assumed_turn(self) -> Turn {
        if self.orientation == Orientation::NoTransforms { Turn::Stored } else { Turn::Assumed }
    }
}

/// Reads size and orientation from an image's header.
pub(crate) fn read_header(path: &Path) -> Result<ImageHeader, PixelError> {
    if is_exr(path) {
        let (width, height) = exr_size(path)?;
        let size = (width as u32, height as u32);
        return Ok(ImageHeader { size, orientation: Orientation::NoTransforms });
    }
    let file = File::open(path).map_err(PixelError::io(path))?;
    let mut decoder = decoder(BufReader::new(file), path)?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err(PixelError::format(path, format!("{width}×{height} pixels")));
    }
    if u64::from(width) * u64::from(height) > MAX_PIXELS as u64 {
        let (width, height) = (width as usize, height as usize);
        return Err(PixelError::TooLarge { path: path.to_path_buf(), width, height });
    }
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok(ImageHeader { size: (width, height), orientation })
}

/// Resizes a camera to an image, as stored or as turned by EXIF. Returns the resized intrinsics and
/// the treatment of the EXIF orientation. Fails if the aspect ratios differ.
pub(crate) fn fit_camera(
    k: Intrinsics,
    stored: ImageHeader,
) -> Result<(Intrinsics, Turn), FrameReason> {
    let (width, height) = stored.size;
    let is_turned_fit = stored.is_sideways() && has_aspect_of(&k, height, width);
    let is_turned_exactly = stored.is_sideways() && (k.height, k.width) == stored.size;
    if (k.width, k.height) == stored.size {
        let is_settled = stored.is_sideways() && width != height;
        Ok((k, if is_settled { Turn::Stored } else { stored.assumed_turn() }))
    } else if has_aspect_of(&k, width, height) && !is_turned_exactly {
        let is_settled = stored.is_sideways() && !is_turned_fit;
        let turn = if is_settled { Turn::Stored } else { stored.assumed_turn() };
        Ok((k.resized(width, height), turn))
    } else if is_turned_fit {
        Ok((k.resized(height, width), Turn::Upright))
    } else {
        Err(FrameReason::AspectRatio { image: stored.size, camera: (k.width, k.height) })
    }
}

/// Maximum deviation between the aspect ratios of an image and its camera, in addition to rounding;
/// chosen by hand.
const MAX_ASPECT_DEVIATION: f64 = 0.01;

/// True if an image of a size may be a resized copy of the camera's.
pub(crate) fn has_aspect_of(k: &Intrinsics, width: u32, height: u32) -> bool {
    let x_scale = f64::from(width) / f64::from(k.width.max(1));
    let y_scale = f64::from(height) / f64::from(k.height.max(1));
    let rounding = 1.0 / f64::from(width.min(height).max(1));
    (x_scale / y_scale - 1.0).abs() <= MAX_ASPECT_DEVIATION + rounding
}

/// Reads an image, as stored or turned upright by EXIF. Fails if the image is incomplete.
fn read_image(path: &Path, is_upright: bool) -> Result<(Rgba8, Clipping), PixelError> {
    if is_exr(path) {
        return read_exr_photograph(path);
    }
    let mut bytes = fs::read(path).map_err(PixelError::io(path))?;
    let mut has_image_data = true;
    if image::guess_format(&bytes).is_ok_and(|format| format == ImageFormat::Jpeg) {
        has_image_data =
            complete_jpeg(&mut bytes).map_err(|reason| PixelError::format(path, reason))?;
    }
    let mut decoder = decoder(Cursor::new(bytes), path)?;
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    let mut image = DynamicImage::from_decoder(decoder)
        .map_err(|e| PixelError::format(path, format!("incomplete or damaged image ({e})")))?;
    if !has_image_data {
        return Err(PixelError::format(path, "damaged JPEG: headers and image data don't match"));
    }
    if is_upright {
        image.apply_orientation(orientation);
    }
    Ok((image.into(), Clipping::default()))
}

/// Fails if a JPEG lacks image data, which its decoder would replace by grey. Adds a missing end
/// marker, without which the decoder omits the last rows. Returns whether image data were found.
fn complete_jpeg(jpeg: &mut Vec<u8>) -> Result<bool, String> {
    match extent(jpeg) {
        Extent::Whole => Ok(true),
        Extent::Unknown => Ok(false),
        Extent::Unterminated { end } => {
            jpeg.truncate(end);
            jpeg.extend(END_MARKER);
            Ok(true)
        }
        Extent::Missing { rows, height } => {
            Err(format!("cut short or damaged: {rows} of {height} rows are missing"))
        }
        Extent::Coarse { scan, height } => Err(format!(
            "cut short or damaged in scan {scan} of a progressive JPEG: detail of all {height} \
            rows is missing"
        )),
    }
}

/// Reads an EXR with linear light and encodes it for display.
fn read_exr_photograph(path: &Path) -> Result<(Rgba8, Clipping), PixelError> {
    let image = read_exr(path)?.with_finite(&COLOUR_CHANNELS, path)?;
    let [r, g, b] = ["R", "G", "B"].map(|name| {
        image.channel(name).ok_or_else(|| PixelError::format(path, format!("no channel {name}")))
    });
    let (r, g, b, a) = (r?, g?, b?, image.channel("A"));
    let mut data = Vec::with_capacity(4 * r.len());
    let mut clipped = 0;
    for i in 0..r.len() {
        let (colour, alpha) = ([r[i], g[i], b[i]], a.map_or(1.0, |a| a[i]));
        data.extend(encode_pixel(colour, alpha));
        clipped += u64::from(is_clipped(colour, alpha));
    }
    let clipping = Clipping { clipped, pixels: r.len() as u64 };
    Ok((Rgba8::new(image.width, image.height, data), clipping))
}

/// Encodes a premultiplied linear colour as straight 8-bit sRGB.
fn encode_pixel(colour: [f32; 3], alpha: f32) -> [u8; 4] {
    if alpha <= 0.0 {
        return [0, 0, 0, to_u8(alpha)];
    }
    let [r, g, b] = colour.map(|v| {
        let straight = (v / alpha).clamp(0.0, 1.0);
        to_u8(srgb_from_linear(f64::from(straight)) as f32)
    });
    [r, g, b, to_u8(alpha)]
}

/// Maximum relative excess of a premultiplied colour over its alpha that rounding to half floats
/// can cause.
const HALF_ROUNDING: f32 = 1.0 / 1024.0;

/// Counts of pixels whose colour is clipped to 1. Only EXR files have brighter pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clipping {
    /// Number of clipped pixels.
    pub clipped: u64,
    /// Number of pixels of the EXR files.
    pub pixels: u64,
}

impl Clipping {
    /// Adds the counts of another image.
    pub fn add(&mut self, other: Self) {
        self.clipped += other.clipped;
        self.pixels += other.pixels;
    }
}

/// True if a premultiplied colour is brighter than its alpha.
fn is_clipped(colour: [f32; 3], alpha: f32) -> bool {
    let limit = alpha * (1.0 + HALF_ROUNDING);
    alpha > 0.0 && colour.iter().any(|value| *value > limit)
}

/// Bytes of an 8-bit RGBA pixel.
const RGBA_BYTES: u64 = 4;
/// Additional bytes per pixel while a JPEG is decoded: coefficients of a progressive one.
const COEFFICIENT_BYTES: u64 = 6;

/// Returns the peak memory of reading an image in bytes, estimated from its header.
fn reading_bytes(path: &Path) -> Result<u64, PixelError> {
    if is_exr(path) {
        let (width, height) = exr_size(path)?;
        return Ok(exr_reading_bytes(path)? + RGBA_BYTES * (width * height) as u64);
    }
    let file = File::open(path).map_err(PixelError::io(path))?;
    let decoder = decoder(BufReader::new(file), path)?;
    let (width, height) = decoder.dimensions();
    let pixels = u64::from(width) * u64::from(height);
    Ok(decoder.total_bytes() + (RGBA_BYTES + COEFFICIENT_BYTES) * pixels)
}

impl Frame {
    /// Returns the peak memory of [`Frame::photograph`] in bytes, estimated from the image's
    /// header.
    pub fn reading_bytes(&self) -> Result<u64, DatasetError> {
        Ok(reading_bytes(&self.image)?)
    }

    /// Reads the image of [`Frame::camera`], as taken or with its distortion removed.
    pub fn photograph(&self) -> Result<Rgba8, DatasetError> {
        Ok(self.photograph_and_clipping()?.0)
    }

    /// Reads [`Frame::photograph`], and counts its pixels brighter than 1.
    pub fn photograph_and_clipping(&self) -> Result<(Rgba8, Clipping), DatasetError> {
        let (image, clipping) = read_image(&self.image, self.turn == Turn::Upright)?;
        let k = self.stored_intrinsics;
        if (image.width, image.height) != (k.width as usize, k.height as usize) {
            let reason = format!(
                "image is {}×{} pixels, its camera {}×{}",
                image.width, image.height, k.width, k.height
            );
            return Err(PixelError::format(&self.image, reason).into());
        }
        Ok((self.without_distortion(image), clipping))
    }

    /// Returns the mask of [`Frame::photograph`]: pixels that count in its mask file and have a
    /// ray. `None` if all pixels count. A mask file of a different size is resampled by nearest
    /// neighbour.
    pub fn mask(&self) -> Result<Option<Mask>, DatasetError> {
        let lens = self.intrinsics().lens_mask();
        let Some(file) = &self.mask else { return Ok(lens) };
        let (image, _) = read_image(&file.path, self.turn == Turn::Upright)?;
        let k = self.stored_intrinsics;
        let resized = resize_nearest(&image, (k.width as usize, k.height as usize));
        let mut mask = Mask::of(&self.without_distortion(resized));
        for (i, counts) in mask.counts.iter_mut().enumerate() {
            let has_ray = lens.as_ref().is_none_or(|lens| lens.counts[i]);
            *counts = (*counts != file.kind.is_inverted()) && has_ray;
        }
        Ok(Some(mask))
    }

    /// Resamples an image of the stored size to the pinhole camera, if distortion is removed.
    fn without_distortion(&self, image: Rgba8) -> Rgba8 {
        match &self.pinhole {
            Some(pinhole) => undistort_image(&image, &self.stored_intrinsics, pinhole),
            None => image,
        }
    }
}

/// Resizes an image by nearest neighbour.
fn resize_nearest(image: &Rgba8, (width, height): (usize, usize)) -> Rgba8 {
    let mut data = Vec::with_capacity(4 * width * height);
    for y in 0..height {
        let row = (2 * y + 1) * image.height / (2 * height);
        for x in 0..width {
            let column = (2 * x + 1) * image.width / (2 * width);
            let first = 4 * (row * image.width + column);
            data.extend_from_slice(&image.data[first..first + 4]);
        }
    }
    Rgba8::new(width, height, data)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::jpeg::tests::{hidden_jpeg, jpeg};
    use jpeg_encoder::SamplingFactor;
    use scene::Distortion;

    /// Returns an image whose red encodes the column and whose green encodes the row.
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
            read_header(&path).unwrap(),
            ImageHeader { size: (32, 16), orientation: Orientation::NoTransforms }
        );
        let read = super::read_image(&path, false).unwrap().0;
        let worst = read.data.iter().zip(&image.data).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(worst < 12, "{worst}");
        for end in 0..bytes.len() {
            std::fs::write(&path, &bytes[..end]).unwrap();
            drop(super::read_image(&path, false));
        }
        // The header is checked before anything is allocated, and the message names the limit.
        let mut huge = bytes.clone();
        let frame = huge.windows(2).position(|marker| marker == b"\xff\xc0").unwrap();
        huge[frame + 5..frame + 9]
            .copy_from_slice(&[20_000u16.to_be_bytes(), 20_000u16.to_be_bytes()].concat());
        std::fs::write(&path, &huge).unwrap();
        let message = read_header(&path).unwrap_err().to_string();
        assert!(
            message.ends_with(
                "20000×20000 pixels exceed the limit of 268435456 (such as 16384×16384); make the \
                image smaller"
            ),
            "{message}"
        );
        // An EXIF block (APP1) that requires a quarter turn: the image is turned only if the
        // camera has the turned shape.
        let mut turned = bytes[..2].to_vec();
        turned.extend(
            b"\xff\xe1\x00\x22Exif\0\0II\x2a\0\x08\0\0\0\
            \x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0",
        );
        turned.extend(&bytes[2..]);
        std::fs::write(&path, &turned).unwrap();
        let stored = read_header(&path).unwrap();
        assert!(stored.size == (32, 16) && stored.is_sideways());
        let of = |width, height| Intrinsics::from_angle_x(width, height, 0.5);
        assert_eq!(fit_camera(of(32, 16), stored).unwrap(), (of(32, 16), Turn::Stored));
        assert_eq!(
            fit_camera(of(64, 32), stored).unwrap(),
            (of(64, 32).resized(32, 16), Turn::Stored)
        );
        assert_eq!(fit_camera(of(16, 32), stored).unwrap(), (of(16, 32), Turn::Upright));
        assert!(
            fit_camera(of(32, 32), stored)
                .unwrap_err()
                .to_string()
                .contains("aspect ratios must match")
        );
        let upright = super::read_image(&path, true).unwrap().0;
        assert_eq!((upright.width, upright.height), (16, 32));
        assert!(
            upright.data[0] < 20 && upright.data[1] > 200,
            "its bottom left corner is now its top left one"
        );
        std::fs::write(&path, "no image").unwrap();
        assert!(read_header(&path).unwrap_err().to_string().contains("a.png"));
        let other = dir.path().join("a.dat");
        std::fs::write(&other, "no image").unwrap();
        assert!(read_header(&other).unwrap_err().to_string().contains("neither PNG, JPEG nor EXR"));
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
            super::read_image(&path, false)
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
            super::read_image(&path, false).map_err(|error| error.to_string())
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
            (&bytes[..20], "a.jpg: cannot read its header (Format error"),
            (&progressive[..progressive.len() - 1], "detail of all 64 rows is missing; export"),
            (&hidden_jpeg(), "a.jpg: damaged JPEG: headers and image data don't match; export"),
        ] {
            let message = read(bytes).unwrap_err();
            assert!(message.contains(words), "{message}");
        }
    }

    /// Returns a colour that depends smoothly on the ray's direction, so that the image through
    /// each lens is known exactly.
    fn colour_towards([u, v]: [f64; 2]) -> [u8; 4] {
        [(128.0 + 90.0 * (6.0 * u).sin()) as u8, (128.0 + 90.0 * (5.0 * v).cos()) as u8, 60, 255]
    }

    /// Returns the ray through a distorted position, by fixed-point iteration.
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

    /// Removing the distortion of a distorted image returns the pinhole image.
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

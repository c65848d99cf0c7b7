use std::fs::{self, File};
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::Path;

use anyhow::bail;
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use pixels::{
    COLOUR_CHANNELS, MAX_PIXELS, MIN_BRIGHT_LEVEL, Mask, PixelError, Rgba8, exr_reading_bytes,
    exr_size, read_exr, srgb_from_linear, to_u8,
};
use scene::{Intrinsics, undistort_image};

use crate::frame::{Frame, Turn};
use crate::jpeg::{Completeness, END_MARKER, check_completeness};
use crate::unsupported::unsupported_error;

/// Extensions of supported images.
pub(crate) const IMAGE_EXTENSIONS: [&str; 4] = [".png", ".jpg", ".jpeg", ".exr"];

/// True if a file's name is that of a supported image.
pub fn is_image_name(path: &Path) -> bool {
    IMAGE_EXTENSIONS.iter().any(|known| has_extension(path, &known[1..]))
}

pub(crate) fn is_exr(path: &Path) -> bool {
    has_extension(path, "exr")
}

/// True if a file's name has an extension, in any case.
pub(crate) fn has_extension(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|found| found.eq_ignore_ascii_case(extension))
}

/// Creates the decoder of a PNG or JPEG, recognised by content rather than by name.
fn decoder<R: BufRead + Seek + 'static>(
    file: R,
    path: &Path,
) -> Result<impl ImageDecoder + use<R>, PixelError> {
    let guessed = ImageReader::new(file).with_guessed_format();
    let mut reader = guessed.map_err(PixelError::io(path))?;
    let mut limits = Limits::default();
    // Bytes of 16-bit RGBA.
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
    pub(crate) fn turn_if_both_fit(self) -> Turn {
        if self.orientation == Orientation::NoTransforms {
            Turn::Stored
        } else {
            Turn::AssumedStored
        }
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
    PixelError::check_size(path, (width as usize, height as usize))?;
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok(ImageHeader { size: (width, height), orientation })
}

/// Resizes a camera to an image, as stored or as turned by EXIF. Returns the resized intrinsics and
/// the treatment of the EXIF orientation. Fails if the aspect ratios differ.
pub(crate) fn fit_camera(k: Intrinsics, stored: ImageHeader) -> anyhow::Result<(Intrinsics, Turn)> {
    let (width, height) = stored.size;
    let is_turned_fit = stored.is_sideways() && has_aspect_of(&k, height, width);
    let is_turned_exactly = stored.is_sideways() && (k.height, k.width) == stored.size;
    if (k.width, k.height) == stored.size {
        let rules_out_turn = stored.is_sideways() && width != height;
        Ok((k, if rules_out_turn { Turn::Stored } else { stored.turn_if_both_fit() }))
    } else if has_aspect_of(&k, width, height) && !is_turned_exactly {
        let rules_out_turn = stored.is_sideways() && !is_turned_fit;
        let turn = if rules_out_turn { Turn::Stored } else { stored.turn_if_both_fit() };
        Ok((k.resized(width, height), turn))
    } else if is_turned_fit {
        Ok((k.resized(height, width), Turn::Upright))
    } else {
        bail!(
            "the image has {width}×{height} pixels, its camera {}×{}; aspect ratios must match",
            k.width,
            k.height
        )
    }
}

/// Maximum deviation between the aspect ratios of an image and its camera, in addition to rounding;
/// chosen by hand.
const MAX_ASPECT_DEVIATION: f64 = 0.01;

/// True if an image of a size may be a resized copy of the camera's image.
pub(crate) fn has_aspect_of(k: &Intrinsics, width: u32, height: u32) -> bool {
    let x_scale = f64::from(width) / f64::from(k.width.max(1));
    let y_scale = f64::from(height) / f64::from(k.height.max(1));
    let rounding = 1.0 / f64::from(width.min(height).max(1));
    (x_scale / y_scale - 1.0).abs() <= MAX_ASPECT_DEVIATION + rounding
}

/// Reads an image, as stored or turned upright by EXIF. Fails if the image is incomplete.
fn read_image(path: &Path, turn_upright: bool) -> Result<(Rgba8, Clipping), PixelError> {
    if is_exr(path) {
        return read_exr_photograph(path);
    }
    let mut bytes = fs::read(path).map_err(PixelError::io(path))?;
    if image::guess_format(&bytes).is_ok_and(|format| format == ImageFormat::Jpeg) {
        complete_jpeg(&mut bytes).map_err(|reason| PixelError::format(path, reason))?;
    }
    let mut decoder = decoder(Cursor::new(bytes), path)?;
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    let mut image = DynamicImage::from_decoder(decoder)
        .map_err(|e| PixelError::format(path, format!("incomplete or damaged image ({e})")))?;
    if turn_upright {
        image.apply_orientation(orientation);
    }
    Ok((image.into(), Clipping::default()))
}

/// Fails if headers of a JPEG are unreadable, or rows or scans are missing, which its decoder would
/// replace by grey. Adds a missing end marker, without which the decoder omits the last rows.
fn complete_jpeg(jpeg: &mut Vec<u8>) -> Result<(), String> {
    match check_completeness(jpeg) {
        Completeness::Complete => Ok(()),
        Completeness::UnreadableHeader => {
            Err("damaged JPEG: headers and image data don't match".to_owned())
        }
        Completeness::Unterminated { end } => {
            jpeg.truncate(end);
            jpeg.extend(END_MARKER);
            Ok(())
        }
        Completeness::Missing { rows, height } => {
            Err(format!("cut short or damaged: {rows} of {height} rows are missing"))
        }
        Completeness::Coarse { scan, height } => Err(format!(
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
        clipped += u64::from(exceeds_one(colour, alpha));
    }
    let clipping = Clipping { clipped, pixels: r.len() as u64 };
    Ok((Rgba8::new(image.width, image.height, data), clipping))
}

/// Encodes a premultiplied linear colour as straight 8-bit sRGB.
fn encode_pixel(colour: [f32; 3], alpha: f32) -> [u8; 4] {
    if alpha <= 0.0 {
        return [0; 4];
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

/// Counts of pixels whose colour is clipped to 1. Only EXR files can have values above 1.
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
fn exceeds_one(colour: [f32; 3], alpha: f32) -> bool {
    let limit = alpha * (1.0 + HALF_ROUNDING);
    alpha > 0.0 && colour.iter().any(|value| *value > limit)
}

/// Bytes of an 8-bit RGBA pixel.
const RGBA_BYTES: u64 = 4;
/// Additional bytes per pixel while a progressive JPEG is decoded: coefficients of 3 channels with
/// 2 bytes each. Also counted for other JPEGs and for PNG, as an upper bound.
const COEFFICIENT_BYTES: u64 = 6;

impl Frame {
    /// Returns the peak memory in bytes during [`Frame::photograph`], estimated from the image's
    /// header.
    pub fn reading_bytes(&self) -> Result<u64, PixelError> {
        let path = &self.image;
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

    /// Reads the image of [`Frame::camera`], as taken or with its distortion removed.
    pub fn photograph(&self) -> Result<Rgba8, PixelError> {
        Ok(self.photograph_and_clipping()?.0)
    }

    /// Reads [`Frame::photograph`], and counts its pixels brighter than 1.
    pub fn photograph_and_clipping(&self) -> Result<(Rgba8, Clipping), PixelError> {
        let (image, clipping) = read_image(&self.image, self.turn == Turn::Upright)?;
        let k = self.lens_intrinsics;
        if (image.width, image.height) != (k.width as usize, k.height as usize) {
            let reason = format!(
                "image is {}×{} pixels, its camera {}×{}",
                image.width, image.height, k.width, k.height
            );
            return Err(PixelError::format(&self.image, reason));
        }
        Ok((self.without_distortion(image), clipping))
    }

    /// Returns the mask of [`Frame::photograph`]: pixels that count in its mask file and have a
    /// ray. `None` if there is no mask file and every pixel has a ray. A mask file of a different
    /// size is resampled by nearest neighbour. In a file without bright pixels, all pixels that
    /// aren't black count as bright.
    pub fn mask(&self) -> Result<Option<Mask>, PixelError> {
        let lens = self.intrinsics().lens_mask();
        let Some(file) = &self.mask else { return Ok(lens) };
        let (mut image, _) = read_image(&file.path, self.turn == Turn::Upright)?;
        whiten_dark_mask(&mut image);
        let k = self.lens_intrinsics;
        let resized = resize_nearest(&image, (k.width as usize, k.height as usize));
        let mut mask = Mask::of(&self.without_distortion(resized));
        for (i, counts) in mask.counts.iter_mut().enumerate() {
            let has_ray = lens.as_ref().is_none_or(|lens| lens.counts[i]);
            *counts = (*counts != file.kind.is_inverted()) && has_ray;
        }
        Ok(Some(mask))
    }

    /// Converts an image position of [`Frame::photograph`], in pixels, to the image before a
    /// resampling to the pinhole camera.
    pub fn position_in_lens_image(&self, position: [f64; 2]) -> [f64; 2] {
        match &self.pinhole {
            Some(pinhole) => self.lens_intrinsics.source_position(pinhole, position),
            None => position,
        }
    }

    /// True if an image of this size may be a resized copy of the photograph.
    pub fn has_aspect_of(&self, width: u32, height: u32) -> bool {
        has_aspect_of(&self.lens_intrinsics, width, height)
    }

    /// Resamples an image of the size of `lens_intrinsics` to the pinhole camera, if distortion is
    /// removed.
    fn without_distortion(&self, image: Rgba8) -> Rgba8 {
        match &self.pinhole {
            Some(pinhole) => undistort_image(&image, &self.lens_intrinsics, pinhole),
            None => image,
        }
    }
}

/// Sets the pixels of a mask that aren't black to white if all are dark: programs write masks of
/// values 0 and 1, and nerfstudio and COLMAP keep every pixel that isn't 0.
fn whiten_dark_mask(mask: &mut Rgba8) {
    let is_dark = mask.data.chunks_exact(4).all(|p| p[..3].iter().all(|v| *v < MIN_BRIGHT_LEVEL));
    for pixel in mask.data.chunks_exact_mut(4).filter(|p| is_dark && p[..3] != [0; 3]) {
        pixel[..3].fill(u8::MAX);
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
pub(crate) mod tests;

use std::fs::File;
use std::io::{BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

use image::ImageDecoder as _;

use crate::error::{MAX_PIXELS, PixelError};
use crate::image_buffer::Rgba8;

/// Reads a PNG of any type as 8-bit RGBA; without alpha it is opaque.
pub fn read_png(path: &Path) -> Result<Rgba8, PixelError> {
    let file = File::open(path).map_err(PixelError::io(path))?;
    let damaged = |e| PixelError::format(path, format!("not a complete PNG ({e})"));
    let mut reader = image::ImageReader::with_format(BufReader::new(file), image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    // 16-bit RGBA has eight bytes per pixel.
    limits.max_alloc = Some(8 * MAX_PIXELS as u64);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    PixelError::check_size(path, (width as usize, height as usize))?;
    let image = image::DynamicImage::from_decoder(decoder).map_err(damaged)?;
    Ok(image.into())
}

/// Writes a PNG: RGB if all pixels are opaque, otherwise RGBA.
pub fn write_png(path: &Path, image: &Rgba8) -> Result<(), PixelError> {
    let bytes = encode_png(image);
    std::fs::write(path, bytes).map_err(PixelError::io(path))
}

/// Returns the bytes that [`write_png`] writes.
pub fn encode_png(image: &Rgba8) -> Vec<u8> {
    let opaque = image.data.chunks_exact(4).all(|p| p[3] == 255);
    let rgb: Vec<u8>;
    let data = if opaque {
        rgb = image.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
        &rgb
    } else {
        &image.data
    };
    let mut bytes = Vec::new();
    encoder(&mut bytes, image.width, image.height, !opaque)
        .write_header()
        .and_then(|mut writer| writer.write_image_data(data))
        .expect("memory can be written");
    bytes
}

fn encoder<W: Write>(out: W, width: usize, height: usize, alpha: bool) -> png::Encoder<'static, W> {
    let mut encoder = png::Encoder::new(out, width as u32, height as u32);
    encoder.set_color(if alpha { png::ColorType::Rgba } else { png::ColorType::Rgb });
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    encoder
}

/// Incremental writer of an opaque RGB PNG: memory doesn't grow with the image.
pub struct PngRows {
    stream: png::StreamWriter<'static, BufWriter<File>>,
    path: PathBuf,
}

impl PngRows {
    /// Creates the file and writes its header.
    pub fn create(path: &Path, width: usize, height: usize) -> Result<Self, PixelError> {
        let file = File::create(path).map_err(PixelError::io(path))?;
        let started = encoder(BufWriter::new(file), width, height, false).write_header();
        let stream =
            started.and_then(png::Writer::into_stream_writer).map_err(|e| png_error(path, e))?;
        Ok(Self { stream, path: path.to_path_buf() })
    }

    /// Appends whole rows of 8-bit samples.
    pub fn write(&mut self, samples: &[u8]) -> Result<(), PixelError> {
        self.stream.write_all(samples).map_err(PixelError::io(&self.path))
    }

    /// Finishes the file after the last row.
    pub fn finish(self) -> Result<(), PixelError> {
        let path = self.path;
        self.stream.finish().map_err(|e| png_error(&path, e))
    }
}

fn png_error(path: &Path, error: png::EncodingError) -> PixelError {
    match error {
        png::EncodingError::IoError(source) => PixelError::io(path)(source),
        other => PixelError::format(path, other.to_string()),
    }
}

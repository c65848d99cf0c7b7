use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::path::Path;

use exr::block::UncompressedBlock;
use exr::block::writer::ChunksWriter as _;
use exr::meta::attribute::{AttributeValue, ChannelDescription, ChannelList, LineOrder, Text};
use exr::meta::header::Header;
use exr::meta::{BlockDescription, MetaData};
use exr::prelude::{Compression, ReadChannels as _, ReadLayers as _, Vec2};

use crate::error::PixelError;
use crate::image_buffer::Image;
use crate::png_file::read_png;

/// Precision of an EXR channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleType {
    /// 16-bit float, for colour and opacity.
    Half,
    /// 32-bit float, for depth.
    Float,
}

/// Description of a channel to write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Name: `R`, `G`, `B`, `A`, `Z`, or a descriptive one.
    pub name: &'static str,
    /// Precision of the samples.
    pub sample_type: SampleType,
}

/// Channels of a view's colours, premultiplied by alpha.
pub const COLOUR_CHANNELS: [&str; 4] = ["R", "G", "B", "A"];
/// Channels of a depth map.
pub const DEPTH_CHANNELS: [&str; 2] = ["Z", "A"];

/// Content of an EXR file's display window; zero outside the data window.
#[derive(Clone, Debug, PartialEq)]
pub struct ExrImage {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Name and samples of every channel, sorted by name.
    pub channels: Vec<(String, Vec<f32>)>,
}

impl ExrImage {
    /// Returns the samples of a channel.
    pub fn channel(&self, name: &str) -> Option<&[f32]> {
        self.channels.iter().find(|(n, _)| n == name).map(|(_, samples)| samples.as_slice())
    }

    /// Returns the image, or fails at the first sample of the named channels that is NaN or
    /// infinite; `path` names the file.
    pub fn with_finite(self, names: &[&str], path: &Path) -> Result<Self, PixelError> {
        for name in names {
            let samples = self.channel(name).unwrap_or_default();
            if let Some(index) = samples.iter().position(|sample| !sample.is_finite()) {
                let pixel = [index % self.width, index / self.width];
                let remedy = "export the image again with finite samples";
                return Err(not_finite(path, name, pixel, samples[index], remedy));
            }
        }
        Ok(self)
    }

    /// Returns channels R, G, B and A as one image; `None` if one is missing.
    pub fn premultiplied(&self) -> Option<Image> {
        let [Some(r), Some(g), Some(b), Some(a)] = COLOUR_CHANNELS.map(|name| self.channel(name))
        else {
            return None;
        };
        let data = (0..r.len()).flat_map(|i| [r[i], g[i], b[i], a[i]]).collect();
        Some(Image::new(self.width, self.height, 4, data))
    }
}

/// Number of rows that ZIP16 compresses together.
const BAND_ROWS: usize = 16;

/// Writes an EXR file (scan lines, ZIP) with reproducible bytes: increasing line order, one
/// attribute.
///
/// `band(first_row, rows, samples)` fills up to 16 rows at a time, with `channels` interleaved in
/// the given order, so that memory doesn't grow with the image. Another thread compresses the
/// previous rows meanwhile. `note` describes the colours. Fails at the first sample that isn't
/// finite.
pub fn write_exr<E: From<PixelError>>(
    path: &Path,
    (width, height): (usize, usize),
    channels: &[Channel],
    note: &str,
    mut band: impl FnMut(usize, usize, &mut [f32]) -> Result<(), E>,
) -> Result<(), E> {
    let mut order: Vec<usize> = (0..channels.len()).collect();
    order.sort_by_key(|&i| channels[i].name);
    let header = header((width, height), order.iter().map(|&i| &channels[i]), note);
    let file = File::create(path).map_err(PixelError::io(path))?;
    let mut failure: Option<E> = None;
    let mut samples = vec![0.0f32; width * BAND_ROWS * channels.len()];
    let written = exr::block::write(
        BufWriter::new(file),
        [header].into_iter().collect(),
        true,
        |meta, writer| {
            let mut previous: Option<(usize, UncompressedBlock)> = None;
            for (index, block) in exr::block::enumerate_ordered_header_block_indices(&meta.headers)
            {
                let (first, rows) = (block.pixel_position.y(), block.pixel_size.height());
                let samples = &mut samples[..width * rows * channels.len()];
                let mut compressed = None;
                let filled = rayon::in_place_scope(|scope| {
                    if let Some((index, block)) = previous.take() {
                        let (compressed, headers) = (&mut compressed, &meta.headers);
                        scope.spawn(move |_| {
                            *compressed = Some((index, block.compress_to_chunk(headers)));
                        });
                    }
                    band(first, rows, samples).and_then(|()| {
                        check_finite(path, channels, width, first, samples)?;
                        Ok(block_bytes(samples, width, channels, &order))
                    })
                });
                if let Some((index, chunk)) = compressed {
                    writer.write_chunk(index, chunk?)?;
                }
                match filled {
                    Ok(data) => previous = Some((index, UncompressedBlock { index: block, data })),
                    Err(error) => {
                        failure = Some(error);
                        return Err(exr::error::Error::Aborted);
                    }
                }
            }
            let Some((index, block)) = previous else { return Ok(()) };
            writer.write_chunk(index, block.compress_to_chunk(&meta.headers)?)
        },
    );
    match (failure, written) {
        (Some(error), _) => Err(error),
        (None, Ok(())) => Ok(()),
        (None, Err(error)) => Err(exr_error(path, error).into()),
    }
}

/// Creates the header; `channels` are sorted by name.
fn header<'a>(
    size: (usize, usize),
    channels: impl Iterator<Item = &'a Channel>,
    note: &str,
) -> Header {
    let descriptions = channels.map(|channel| ChannelDescription {
        name: Text::from(channel.name),
        sample_type: match channel.sample_type {
            SampleType::Half => exr::meta::attribute::SampleType::F16,
            SampleType::Float => exr::meta::attribute::SampleType::F32,
        },
        quantize_linearly: false,
        sampling: (1, 1).into(),
    });
    let list = ChannelList::new(descriptions.collect());
    // The crate's default line order varies: among 40 files of one image no two were equal.
    let mut header = Header::new(Text::from("views"), size, list.list).with_encoding(
        Compression::ZIP16,
        BlockDescription::ScanLines,
        LineOrder::Increasing,
    );
    // Custom attributes are in a hash map: two would have no fixed order.
    header.own_attributes.layer_name = None;
    header.own_attributes.other.insert(Text::from("note"), AttributeValue::Text(Text::from(note)));
    header
}

/// Fails at the first sample, in a band of rows from `first`, that is NaN or infinite; `path` names
/// the file that would have the samples.
pub fn check_finite(
    path: &Path,
    channels: &[Channel],
    width: usize,
    first: usize,
    samples: &[f32],
) -> Result<(), PixelError> {
    let Some(index) = samples.iter().position(|v| !v.is_finite()) else { return Ok(()) };
    let pixel = index / channels.len();
    let name = channels[index % channels.len()].name;
    let pixel = [pixel % width, first + pixel / width];
    Err(not_finite(path, name, pixel, samples[index], "the file was not written"))
}

fn not_finite(
    path: &Path,
    channel: &str,
    [x, y]: [usize; 2],
    value: f32,
    remedy: &str,
) -> PixelError {
    PixelError::Unsupported(format!(
        "{}: channel {channel} is {value} at column {x}, row {y}; {remedy}",
        path.display()
    ))
}

/// Returns the samples line by line, channel by channel (sorted by name), native-endian: the layout
/// that `exr` compresses.
fn block_bytes(samples: &[f32], width: usize, channels: &[Channel], order: &[usize]) -> Vec<u8> {
    let mut data = Vec::with_capacity(samples.len() * 4);
    for line in samples.chunks_exact(width * channels.len()) {
        for &channel in order {
            let line = line.iter().skip(channel).step_by(channels.len());
            match channels[channel].sample_type {
                SampleType::Half => {
                    for v in line {
                        // ±65504, the largest finite half; larger values would become infinite.
                        data.extend(half::f16::from_f32(v.clamp(-65504.0, 65504.0)).to_ne_bytes());
                    }
                }
                SampleType::Float => line.for_each(|v| data.extend(v.to_ne_bytes())),
            }
        }
    }
    data
}

fn open(path: &Path) -> Result<BufReader<File>, PixelError> {
    File::open(path).map(BufReader::new).map_err(PixelError::io(path))
}

/// Reads the image's width and height, those of the display window, from the header; fails above
/// [`MAX_PIXELS`](crate::MAX_PIXELS).
pub fn exr_size(path: &Path) -> Result<(usize, usize), PixelError> {
    Ok(read_windows(path)?.size)
}

/// Returns the peak memory of [`read_exr`] in bytes, estimated from the header: 4 bytes for each
/// sample of the data window, and 4 for each sample of the display window.
pub fn exr_reading_bytes(path: &Path) -> Result<u64, PixelError> {
    let layers = read_header(path)?.headers;
    let samples = layers.iter().map(|h| {
        let pixels = h.layer_size.area() + h.shared_attributes.display_window.size.area();
        (pixels * h.channels.list.len()) as u64
    });
    Ok(4 * samples.sum::<u64>())
}

/// Image's size, and the position of the first layer's data window in the image.
struct Windows {
    /// Width and height of the display window.
    size: (usize, usize),
    /// Column and row of the data window's first pixel.
    start: (usize, usize),
}

/// Reads the windows of the first layer from the header. Fails if the data window is not inside the
/// display window: pixels outside the image have no place in it.
fn read_windows(path: &Path) -> Result<Windows, PixelError> {
    let meta = read_header(path)?;
    let first = meta.headers.first().ok_or_else(|| PixelError::format(path, "no layer"))?;
    let (data, image) = (first.data_window(), first.shared_attributes.display_window);
    // The difference of two positions may exceed an i32.
    let start = |from: i32, origin: i32, length: usize, limit: usize| {
        let start = usize::try_from(i64::from(from) - i64::from(origin)).ok()?;
        (start.checked_add(length)? <= limit).then_some(start)
    };
    let (Vec2(x, y), Vec2(left, top)) = (data.position, image.position);
    let left = start(x, left, data.size.width(), image.size.width());
    let top = start(y, top, data.size.height(), image.size.height());
    let size = (image.size.width(), image.size.height());
    if size.0 == 0 || size.1 == 0 {
        return Err(PixelError::format(path, format!("{}×{} pixels", size.0, size.1)));
    }
    if let (Some(left), Some(top)) = (left, top) {
        return Ok(Windows { size, start: (left, top) });
    }
    let [data, image] = [data, image].map(|window| {
        let (Vec2(width, height), Vec2(x, y)) = (window.size, window.position);
        format!("{width}×{height} at ({x}, {y})")
    });
    Err(PixelError::Unsupported(format!(
        "{}: data window ({data}) exceeds display window ({image}); crop the image to its display \
        window",
        path.display()
    )))
}

/// Bytes of a chunk's entry in the offset table.
const OFFSET_BYTES: u64 = 8;

fn read_header(path: &Path) -> Result<MetaData, PixelError> {
    let file = open(path)?;
    let length = file.get_ref().metadata().map(|metadata| metadata.len());
    let length = length.map_err(PixelError::io(path))?;
    let meta = MetaData::read_from_buffered(file, false).map_err(|e| exr_error(path, e))?;
    for header in &meta.headers {
        for size in [header.layer_size, header.shared_attributes.display_window.size] {
            PixelError::check_size(path, (size.width(), size.height()))?;
        }
    }
    // Decoding would first allocate memory for the whole table, and for all pixels.
    let chunks: u64 = meta.headers.iter().map(|header| header.chunk_count as u64).sum();
    if OFFSET_BYTES * chunks > length {
        let reason = "incomplete or damaged EXR (shorter than its offset table)";
        return Err(PixelError::format(path, reason));
    }
    Ok(meta)
}

/// Reads every channel of the first layer as f32, padded with zeros to the display window.
pub fn read_exr(path: &Path) -> Result<ExrImage, PixelError> {
    let windows = read_windows(path)?;
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .non_parallel()
        .from_buffered(open(path)?)
        .map_err(|e| exr_error(path, e))?;
    let layer =
        image.layer_data.into_iter().next().ok_or_else(|| PixelError::format(path, "no layer"))?;
    let data_width = layer.size.width();
    let channels = layer
        .channel_data
        .list
        .into_iter()
        .map(|c| {
            let samples = c.sample_data.values_as_f32().collect();
            (c.name.to_string(), padded(samples, data_width, &windows))
        })
        .collect();
    let (width, height) = windows.size;
    Ok(ExrImage { width, height, channels })
}

/// Pads the samples of a data window of the given width with zeros to the display window.
fn padded(samples: Vec<f32>, data_width: usize, windows: &Windows) -> Vec<f32> {
    let ((width, height), (left, top)) = (windows.size, windows.start);
    if samples.len() == width * height {
        return samples;
    }
    let mut image = vec![0.0; width * height];
    for (row, line) in samples.chunks_exact(data_width.max(1)).enumerate() {
        let start = (top + row) * width + left;
        image[start..start + data_width].copy_from_slice(line);
    }
    image
}

fn exr_error(path: &Path, error: exr::error::Error) -> PixelError {
    match error {
        exr::error::Error::Io(source) if source.kind() != std::io::ErrorKind::UnexpectedEof => {
            PixelError::io(path)(source)
        }
        other => PixelError::format(path, format!("incomplete or damaged EXR ({other})")),
    }
}

/// Reads a view's image as premultiplied RGBA, from a PNG with straight alpha or none, or from an
/// EXR with premultiplied channels R, G, B, A.
pub fn read_premultiplied(path: &Path) -> Result<Image, PixelError> {
    if path.extension().is_none_or(|e| e != "exr") {
        return Ok(Image::premultiplied(&read_png(path)?));
    }
    let image = read_exr(path)?.with_finite(&COLOUR_CHANNELS, path)?;
    image.premultiplied().ok_or_else(|| PixelError::format(path, "expected channels R, G, B and A"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CHANNELS: [Channel; 3] = [
        Channel { name: "R", sample_type: SampleType::Half },
        Channel { name: "A", sample_type: SampleType::Half },
        Channel { name: "Z", sample_type: SampleType::Float },
    ];

    fn value(x: usize, y: usize, c: usize) -> f32 {
        if c == 2 { 2.0 + (x * 7 + y) as f32 / 3.0 } else { (x + y * 3 + c) as f32 / 256.0 }
    }

    fn write(path: &Path, width: usize, height: usize) {
        write_exr(
            path,
            (width, height),
            &CHANNELS,
            "test",
            |first, rows, samples| -> Result<(), PixelError> {
                assert_eq!(samples.len(), width * rows * 3);
                for (i, v) in samples.iter_mut().enumerate() {
                    *v = value(i / 3 % width, first + i / 3 / width, i % 3);
                }
                Ok(())
            },
        )
        .unwrap();
    }

    #[test]
    fn written_images_are_read_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        for (width, height) in [(1, 1), (5, 40), (33, 16)] {
            write(&path, width, height);
            let image = read_exr(&path).unwrap();
            assert_eq!((image.width, image.height), (width, height));
            assert_eq!(exr_size(&path).unwrap(), (width, height));
            let names: Vec<_> = image.channels.iter().map(|(n, _)| n.as_str()).collect();
            assert_eq!(names, ["A", "R", "Z"]);
            for (c, name) in ["R", "A", "Z"].into_iter().enumerate() {
                for (i, &v) in image.channel(name).unwrap().iter().enumerate() {
                    let expected = value(i % width, i / width, c);
                    assert!(
                        (v - expected).abs() <= if c == 2 { 0.0 } else { expected * 1e-3 },
                        "{name} {i}: {v} {expected}"
                    );
                }
            }
        }
    }

    /// Sets the windows of a file to (left, top, right, bottom).
    fn set_windows(path: &Path, data: [i32; 4], display: [i32; 4]) {
        let mut bytes = std::fs::read(path).unwrap();
        for (name, window) in
            [(&b"dataWindow\0box2i\0"[..], data), (b"displayWindow\0box2i\0", display)]
        {
            let start = bytes.windows(name.len()).position(|w| w == name).unwrap();
            // After the length of the attribute (4 bytes).
            let first = start + name.len() + 4;
            bytes[first..first + 16].copy_from_slice(&window.map(i32::to_le_bytes).concat());
        }
        std::fs::write(path, bytes).unwrap();
    }

    /// An image cropped to its content keeps its position in the display window.
    #[test]
    fn cropped_images_are_padded() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        write(&path, 4, 3);
        let whole = read_exr(&path).unwrap();
        set_windows(&path, [0, 0, 3, 2], [-2, -1, 4, 3]);
        assert_eq!(exr_size(&path).unwrap(), (7, 5));
        assert_eq!(exr_reading_bytes(&path).unwrap(), 4 * 3 * (4 * 3 + 7 * 5));
        let image = read_exr(&path).unwrap();
        assert_eq!((image.width, image.height), (7, 5));
        for name in ["R", "A", "Z"] {
            let (padded, cropped) = (image.channel(name).unwrap(), whole.channel(name).unwrap());
            assert_eq!(padded.len(), 7 * 5);
            for (i, &value) in padded.iter().enumerate() {
                let (x, y) = ((i % 7).wrapping_sub(2), (i / 7).wrapping_sub(1));
                let expected = if x < 4 && y < 3 { cropped[y * 4 + x] } else { 0.0 };
                assert_eq!(value, expected, "{name} {x} {y}");
            }
        }
        for display in [[1, 0, 9, 9], [0, 0, 2, 9], [-9, -9, -1, -1]] {
            set_windows(&path, [0, 0, 3, 2], display);
            for error in [exr_size(&path).unwrap_err(), read_exr(&path).unwrap_err()] {
                let message = error.to_string();
                let expected = "data window (4×3 at (0, 0)) exceeds display window (";
                assert!(message.contains(expected), "{message}");
            }
        }
    }

    /// The header declares 60 million rows, for which the reader must not allocate memory.
    #[test]
    fn a_file_without_its_offset_table_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        write(&path, 4, 3);
        set_windows(&path, [0, 0, 3, 59_999_999], [0, 0, 3, 59_999_999]);
        for error in [exr_size(&path).unwrap_err(), read_exr(&path).unwrap_err()] {
            let message = error.to_string();
            assert!(message.contains("(shorter than its offset table); export"), "{message}");
        }
    }

    #[test]
    fn repeated_writes_give_equal_files() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        let hashes: std::collections::BTreeSet<_> = (0..40)
            .map(|_| {
                write(&path, 64, 100);
                blake3::hash(&std::fs::read(&path).unwrap()).to_hex().to_string()
            })
            .collect();
        assert_eq!(hashes.len(), 1);
    }

    #[test]
    fn nan_never_reaches_a_file() {
        let dir = tempfile::tempdir().unwrap();
        let result =
            write_exr(&dir.path().join("a.exr"), (4, 4), &CHANNELS, "", |_, _, samples| {
                samples.fill(0.0);
                samples[3 * 5 + 2] = f32::NAN;
                Ok::<(), PixelError>(())
            });
        let message = result.unwrap_err().to_string();
        let expected = "a.exr: channel Z is NaN at column 1, row 1; the file was not written";
        assert!(message.ends_with(expected), "{message}");
    }

    #[test]
    fn nonfinite_samples_are_named_when_read() {
        let path = Path::new("a.exr");
        let image = |value: f32| ExrImage {
            width: 3,
            height: 2,
            channels: vec![
                ("A".to_owned(), vec![1.0; 6]),
                ("Z".to_owned(), vec![1.0, 1.0, 1.0, 1.0, 1.0, value]),
            ],
        };
        for (value, text) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf"), (-f32::INFINITY, "-inf")] {
            let message = image(value).with_finite(&DEPTH_CHANNELS, path).unwrap_err().to_string();
            let expected = format!("a.exr: channel Z is {text} at column 2, row 1; export");
            assert!(message.starts_with(&expected), "{message}");
            // Channel Z isn't checked if only colour channels are read.
            assert!(image(value).with_finite(&COLOUR_CHANNELS, path).is_ok());
        }
    }

    #[test]
    fn truncated_files_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        write(&path, 20, 20);
        let bytes = std::fs::read(&path).unwrap();
        for end in (0..bytes.len()).step_by(37) {
            std::fs::write(&path, &bytes[..end]).unwrap();
            assert!(read_exr(&path).is_err(), "{end} of {} bytes", bytes.len());
        }
    }
}

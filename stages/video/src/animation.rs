//! Writer of animated PNG files.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use pixels::Rgba8;

/// Incremental writer of an animated PNG of opaque frames, which repeats forever.
pub(crate) struct AnimatedPng {
    writer: png::Writer<BufWriter<File>>,
}

impl AnimatedPng {
    /// Creates the file for the given number of frames, at `rate` frames per second, at most 600.
    pub(crate) fn create(
        path: &Path,
        (width, height): (usize, usize),
        frames: u32,
        rate: f64,
    ) -> anyhow::Result<Self> {
        let file = BufWriter::new(File::create(path)?);
        let mut encoder = png::Encoder::new(file, width as u32, height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_compression(png::Compression::Balanced);
        encoder.set_animated(frames, 0)?;
        // In hundredths, so that rates of films, such as 29.97, are exact.
        encoder.set_frame_delay(100, (100.0 * rate).round().max(1.0) as u16)?;
        Ok(Self { writer: encoder.write_header()? })
    }

    /// Appends a frame of the animation's size; its alpha is ignored.
    pub(crate) fn add(&mut self, frame: &Rgba8) -> anyhow::Result<()> {
        let rgb: Vec<u8> = frame.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
        Ok(self.writer.write_image_data(&rgb)?)
    }

    /// Finishes the file after the last frame.
    pub(crate) fn finish(self) -> anyhow::Result<()> {
        Ok(self.writer.finish()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_and_their_times_are_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("video.png");
        let mut animation = AnimatedPng::create(&path, (3, 2), 2, 15.0).unwrap();
        let frame = |level| Rgba8::new(3, 2, vec![level; 4 * 6]);
        for level in [10, 20] {
            animation.add(&frame(level)).unwrap();
        }
        animation.finish().unwrap();
        let file = std::io::BufReader::new(File::open(&path).unwrap());
        let mut reader = png::Decoder::new(file).read_info().unwrap();
        for level in [10, 20] {
            let mut data = vec![0; 18];
            reader.next_frame(&mut data).unwrap();
            assert_eq!(data, [level; 18]);
            let frame = reader.info().frame_control.unwrap();
            assert_eq!((frame.delay_num, frame.delay_den), (100, 1500));
        }
        let frames = reader.info().animation_control.unwrap();
        assert_eq!((frames.num_frames, frames.num_plays), (2, 0));
    }
}

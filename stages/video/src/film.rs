//! Films of frames: MP4 by ffmpeg, otherwise an animated PNG.

use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Read as _};
use std::path::{Path, PathBuf};
use std::process::{self, Command, Stdio};
use std::time::Duration;

use anyhow::Context as _;
use pixels::{Filter, read_png, resize_pillow};
use stage::{Context, Progress};

/// Interval at which ffmpeg and interruptions are checked; chosen by hand.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Constant rate factor of the H.264 encoder, from 0 (lossless) to 51. x264's documentation calls
/// 17 or 18 visually lossless or nearly so.
const H264_RATE_FACTOR: &str = "18";

/// Maximum width of an animated PNG, in pixels: its compression is lossless. Chosen by hand.
const MAX_ANIMATION_WIDTH: usize = 640;
/// Rate above which an animated PNG has every other frame only; chosen by hand.
const MAX_ANIMATION_RATE: f64 = 20.0;

/// Frames of a film.
pub(crate) struct Film<'a> {
    /// Folder of the film and of `frames/`, relative to the output: empty, or ending in `/`.
    pub(crate) prefix: &'a str,
    /// Number of frames.
    pub(crate) frames: usize,
    /// Frames per second.
    pub(crate) rate: f64,
}

impl Film<'_> {
    /// Returns the path of a frame. `stem` is the frame's number in five digits, or ffmpeg's
    /// pattern for all numbers.
    pub(crate) fn frame_path(&self, context: &Context, stem: &str) -> anyhow::Result<PathBuf> {
        context.output_path(&format!("{}frames/{stem}.png", self.prefix))
    }

    /// Writes `video.mp4` by ffmpeg; without ffmpeg, or if it fails, `video.png`.
    pub(crate) fn write(&self, context: &Context) -> anyhow::Result<()> {
        let progress = context.progress("encoding", self.frames as u64);
        let path = context.output_path(&format!("{}video.mp4", self.prefix))?;
        let output = output_of(context, &mut self.ffmpeg(context, &path)?, &progress);
        context.check_interrupt()?;
        let reason = match output {
            Ok(output) if output.status.success() => {
                let (rate, seconds) = (self.rate, self.frames as f64 / self.rate);
                context.log_line(format!(
                    "video.mp4: H.264, quality CRF {H264_RATE_FACTOR}, {rate} frames per second, \
                    {seconds:.1} s"
                ));
                return Ok(());
            }
            Ok(output) => {
                let message = String::from_utf8_lossy(&output.stderr);
                format!("ffmpeg failed: {}", message.lines().next().unwrap_or("no message"))
            }
            Err(e) if e.kind() == io::ErrorKind::NotFound => "ffmpeg isn't installed".to_owned(),
            Err(e) => return Err(e).context("cannot run ffmpeg"),
        };
        // A partial film can't be played.
        std::fs::remove_file(&path)
            .or_else(|e| if e.kind() == io::ErrorKind::NotFound { Ok(()) } else { Err(e) })?;
        context.log_line(format!("no video.mp4: {reason}; video.png is an animated PNG instead"));
        self.write_animation(context, &progress)
    }

    /// Returns the call of ffmpeg.
    fn ffmpeg(&self, context: &Context, film: &Path) -> anyhow::Result<Command> {
        let rate = self.rate.to_string();
        let mut command = Command::new("ffmpeg");
        command.args(["-loglevel", "error", "-nostdin", "-y", "-framerate", &rate, "-i"]);
        command.arg(self.frame_path(context, "%05d")?);
        command.args(["-c:v", "libx264", "-crf", H264_RATE_FACTOR, "-pix_fmt", "yuv420p"]);
        command.args(["-movflags", "+faststart", "-progress", "pipe:1"]);
        command.arg(film).stdin(Stdio::null());
        Ok(command)
    }

    /// Writes `video.png`, an animated PNG. Frames are at most [`MAX_ANIMATION_WIDTH`] wide; above
    /// [`MAX_ANIMATION_RATE`] every other frame is left out.
    fn write_animation(&self, context: &Context, progress: &Progress) -> anyhow::Result<()> {
        let path = context.output_path(&format!("{}video.png", self.prefix))?;
        let step = if self.rate > MAX_ANIMATION_RATE { 2 } else { 1 };
        let rate = self.rate / step as f64;
        let mut animation = None;
        for index in (0..self.frames).step_by(step) {
            context.check_interrupt()?;
            let frame = read_png(&self.frame_path(context, &format!("{index:05}"))?)?;
            let width = frame.width.min(MAX_ANIMATION_WIDTH);
            let height = (frame.height * width).div_ceil(frame.width);
            let frame = resize_pillow(&frame, width, height, Filter::Lanczos);
            let animation = match &mut animation {
                Some(animation) => animation,
                None => {
                    let frames = self.frames.div_ceil(step) as u32;
                    animation.insert(create_animation(&path, (width, height), frames, rate)?)
                }
            };
            let pixels = frame.data.chunks_exact(4);
            let rgb: Vec<u8> = pixels.flat_map(|p| [p[0], p[1], p[2]]).collect();
            animation.write_image_data(&rgb)?;
            progress.set(index as u64, "");
        }
        Ok(animation.map_or(Ok(()), png::Writer::finish)?)
    }
}

/// Creates an animated PNG of opaque frames, which repeats forever, with the given number of
/// frames, at `rate` frames per second, at most 600.
fn create_animation(
    path: &Path,
    (width, height): (usize, usize),
    frames: u32,
    rate: f64,
) -> anyhow::Result<png::Writer<BufWriter<File>>> {
    let file = BufWriter::new(File::create(path)?);
    let mut encoder = png::Encoder::new(file, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Balanced);
    encoder.set_animated(frames, 0)?;
    // In hundredths, so that rates of films, such as 29.97, are exact.
    encoder.set_frame_delay(100, (100.0 * rate).round().max(1.0) as u16)?;
    Ok(encoder.write_header()?)
}

/// Runs ffmpeg and collects its stderr; kills ffmpeg if the stage is interrupted. `progress` gets
/// the frames that ffmpeg reports on stdout.
fn output_of(
    context: &Context,
    command: &mut Command,
    progress: &Progress,
) -> io::Result<process::Output> {
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
    let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
    std::thread::scope(|scope| {
        let stderr = scope.spawn(|| {
            let mut bytes = Vec::new();
            stderr.map_or(Ok(0), |mut pipe| pipe.read_to_end(&mut bytes)).map(|_| bytes)
        });
        scope.spawn(|| {
            let lines = stdout.map(BufReader::new).into_iter().flat_map(BufRead::lines);
            for line in lines.map_while(Result::ok) {
                if let Some(frame) = encoded_frames(&line) {
                    progress.set(frame, "");
                }
            }
        });
        let status = loop {
            if let Some(status) = child.try_wait()? {
                break status;
            }
            if context.is_interrupted() {
                child.kill()?;
            }
            std::thread::sleep(POLL_INTERVAL);
        };
        let stderr = stderr.join().unwrap_or_else(|_| Ok(Vec::new()))?;
        Ok(process::Output { status, stdout: Vec::new(), stderr })
    })
}

/// Returns the number of encoded frames in a line of ffmpeg's `-progress`.
fn encoded_frames(line: &str) -> Option<u64> {
    line.strip_prefix("frame=")?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_and_their_times_are_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("video.png");
        let mut animation = create_animation(&path, (3, 2), 2, 15.0).unwrap();
        for level in [10, 20] {
            animation.write_image_data(&[level; 18]).unwrap();
        }
        animation.finish().unwrap();
        let file = BufReader::new(File::open(&path).unwrap());
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

    #[test]
    fn frame_counts_of_ffmpeg_are_read() {
        assert_eq!(encoded_frames("frame=12"), Some(12));
        assert_eq!(encoded_frames("frame=  7"), Some(7));
        assert!(
            ["frame=", "fps=3", "progress=end"].into_iter().all(|l| encoded_frames(l).is_none())
        );
    }
}

//! `video`: rendered views as a film, colour and depth side by side.
//!
//! The stage is a sink. It writes a PNG per frame and, if `ffmpeg` is installed, `video.mp4`. Each
//! point of a sweep has its own folder.

use std::io::{self, BufRead, BufReader, Read as _};
use std::path::Path;
use std::process::{self, Command, Stdio};
use std::time::Duration;

use anyhow::Context as _;
use artifact::{Failure, RunNode, RunRecord, label, sink_folders};
use pixels::{DepthMap, Rgba8, common_range, read_exr, write_png};
use rayon::prelude::*;
use scene::{View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Progress, Stage};

/// Parameters of `video`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Frames per second.
    #[schemars(range(min = 1, max = 240))]
    pub frames_per_second: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self { frames_per_second: 30 }
    }
}

/// Interval at which ffmpeg and interruptions are checked; chosen by hand.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// The stage.
pub struct Video;

impl Stage for Video {
    type Params = Params;
    const NAME: &'static str = "video";
    const SUMMARY: &'static str = "Makes a film of rendered views, colour and depth side by side.";
    const SINK: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![(
            "run",
            Input::required(&["run"], "folder with run.json, the record of the rendered views"),
        )]
    }

    fn output() -> Output {
        Output::kind("video")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let run: RunRecord = context.input("run")?.read_json("run.json")?;
        run.check().map_err(|e| Failure::BadInput(e.to_string()))?;
        let rendered: Vec<&RunNode> = run.nodes.iter().filter(|n| n.kind == "views").collect();
        if rendered.is_empty() {
            return Err(Failure::BadInput("run.json has no rendered views".to_owned()).into());
        }
        for (node, prefix) in rendered.iter().zip(sink_folders(&rendered)) {
            make_film(context, params, &node.folder, &prefix)
                .with_context(|| label(&node.stage, &node.point))?;
        }
        Ok(())
    }
}

/// Writes the frames, and the film if ffmpeg is available.
fn make_film(
    context: &Context,
    params: &Params,
    folder: &Path,
    prefix: &str,
) -> anyhow::Result<()> {
    let views = Views::read_folder(folder)?;
    if views.views.iter().any(|view| size_of_view(view) != size_of_view(&views.views[0])) {
        return Err(Failure::BadInput(
            "views have different sizes; set render-depth.size".to_owned(),
        )
        .into());
    }
    let progress = context.progress("drawing", 2 * views.views.len() as u64);
    // All frames have one range of depths: with a range per frame, colours would flicker.
    let ranges = views.views.par_iter().map(|view| -> anyhow::Result<Option<(f32, f32)>> {
        progress.add(1);
        let Some(file) = &view.depth else { return Ok(None) };
        let image = read_exr(&folder.join(file))?;
        Ok(DepthMap::of(&image).and_then(|map| map.range()))
    });
    let ranges = ranges.collect::<anyhow::Result<Vec<_>>>()?;
    let range = common_range(ranges.into_iter().flatten());
    views.views.par_iter().enumerate().try_for_each(|(i, view)| {
        context.check_interrupt()?;
        let frame = draw_frame(&views, view, folder, range)?;
        let path = context.output_path(&format!("{prefix}frames/{i:05}.png"))?;
        write_png(&path, &with_even_size(&frame))?;
        progress.add(1);
        anyhow::Ok(())
    })?;
    let frames = context.output_path(&format!("{prefix}frames/%05d.png"))?;
    let film = context.output_path(&format!("{prefix}video.mp4"))?;
    let progress = context.progress("encoding", views.views.len() as u64);
    encode(context, params, &frames, &film, &progress)
}

fn size_of_view(view: &View) -> (u32, u32) {
    (view.camera.intrinsics.width, view.camera.intrinsics.height)
}

/// Draws a view's colour and, with a range of depths, its depth on the right.
fn draw_frame(
    views: &Views,
    view: &View,
    folder: &Path,
    range: Option<(f32, f32)>,
) -> anyhow::Result<Rgba8> {
    let image = view.image.as_ref();
    let image = image.with_context(|| format!("view {} has no image", view.camera.name))?;
    let colour = views.read_over(&folder.join(image))?.to_rgba8();
    let (Some(file), Some(range)) = (&view.depth, range) else { return Ok(colour) };
    let image = read_exr(&folder.join(file))?;
    Ok(match DepthMap::of(&image) {
        Some(map) => side_by_side(&colour, &map.draw(image.width, range)),
        None => colour,
    })
}

/// Joins two images of equal height.
fn side_by_side(left: &Rgba8, right: &Rgba8) -> Rgba8 {
    let mut data = Vec::with_capacity(left.data.len() + right.data.len());
    let right_rows = right.data.chunks_exact(4 * right.width);
    for (left_row, right_row) in left.data.chunks_exact(4 * left.width).zip(right_rows) {
        data.extend_from_slice(left_row);
        data.extend_from_slice(right_row);
    }
    Rgba8::new(left.width + right.width, left.height, data)
}

/// Repeats the last column and row of an image with odd sizes, which yuv420p doesn't allow.
fn with_even_size(image: &Rgba8) -> Rgba8 {
    let (width, height) = (image.width.next_multiple_of(2), image.height.next_multiple_of(2));
    let mut data = Vec::with_capacity(4 * width * height);
    for y in 0..height {
        for x in 0..width {
            let pixel = y.min(image.height - 1) * image.width + x.min(image.width - 1);
            data.extend_from_slice(&image.data[4 * pixel..4 * (pixel + 1)]);
        }
    }
    Rgba8::new(width, height, data)
}

/// Encodes the film by ffmpeg; without ffmpeg, or if it fails, logs that only the frames exist.
fn encode(
    context: &Context,
    params: &Params,
    frames: &Path,
    film: &Path,
    progress: &Progress,
) -> anyhow::Result<()> {
    let rate = params.frames_per_second.to_string();
    let mut command = Command::new("ffmpeg");
    command.args(["-loglevel", "error", "-nostdin", "-y", "-framerate", &rate, "-i"]).arg(frames);
    command.args(["-pix_fmt", "yuv420p", "-movflags", "+faststart"]);
    command.args(["-progress", "pipe:1"]).arg(film).stdin(Stdio::null());
    let folder = frames.parent().unwrap_or(frames).display();
    let output = output_of(context, &mut command, progress);
    context.check_interrupt()?;
    match output {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => {
            let message = String::from_utf8_lossy(&output.stderr);
            context.log_line(format!(
                "no video.mp4: ffmpeg failed: {}; only frames are written",
                message.lines().next().unwrap_or("no message")
            ));
            // A partial film can't be played.
            std::fs::remove_file(film).or_else(|e| {
                if e.kind() == std::io::ErrorKind::NotFound { Ok(()) } else { Err(e) }
            })?;
            Ok(())
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            context.log_line("no video.mp4: ffmpeg isn't installed; only frames are written");
            Ok(())
        }
        Err(e) => Err(e).with_context(|| format!("cannot run ffmpeg for {folder}")),
    }
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
    fn ffmpeg_reports_frames() {
        assert_eq!(encoded_frames("frame=12"), Some(12));
        assert_eq!(encoded_frames("frame=  7"), Some(7));
        assert!(
            ["frame=", "fps=3", "progress=end"].into_iter().all(|l| encoded_frames(l).is_none())
        );
    }

    #[test]
    fn frames_have_even_sizes_and_both_images() {
        let one = |width: usize, level: u8| Rgba8::new(width, 3, vec![level; 4 * width * 3]);
        let frame = with_even_size(&side_by_side(&one(3, 10), &one(2, 20)));
        assert_eq!((frame.width, frame.height), (6, 4));
        let row: Vec<u8> = frame.data[3 * 6 * 4..].chunks_exact(4).map(|p| p[0]).collect();
        assert_eq!(row, [10, 10, 10, 20, 20, 20]);
    }
}

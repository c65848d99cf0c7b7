//! `video`: rendered views as a film, colour and depth side by side.
//!
//! A sink: it writes one PNG a frame and, where `ffmpeg` is installed, `video.mp4`; without it the
//! frames are the film. A sweep's points get a folder each.

use std::io::{self, Read as _};
use std::path::Path;
use std::process::{self, Command, Stdio};
use std::time::Duration;

use anyhow::Context as _;
use artifact::{Failure, RunNode, RunRecord, folders_of, label};
use contract::{Input, Output};
use pixels::{DepthMap, Rgba8, common_range, read_exr, write_png};
use rayon::prelude::*;
use scene::{View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Stage};

/// Parameters of `video`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Frames a second.
    #[schemars(range(min = 1, max = 240))]
    pub frames_per_second: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self { frames_per_second: 30 }
    }
}

/// Time between two checks whether ffmpeg has ended.
const INTERVAL: Duration = Duration::from_millis(20);

/// The stage.
pub struct Video;

impl Stage for Video {
    type Params = Params;
    const NAME: &'static str = "video";
    const SUMMARY: &'static str = "Shows rendered views as a film, colour and depth side by side.";
    const SINK: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![(
            "run",
            Input::required(
                &["run"],
                "folder with run.json: the record of what rendered the views",
            ),
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
            return Err(
                Failure::BadInput("run.json: nothing in it rendered views".to_owned()).into()
            );
        }
        for (node, prefix) in rendered.iter().zip(folders_of(&rendered)) {
            film(context, params, &node.folder, &prefix)
                .with_context(|| label(&node.stage, &node.point))?;
        }
        Ok(())
    }
}

/// Frames, and the film where that can be made.
fn film(context: &Context, params: &Params, folder: &Path, prefix: &str) -> anyhow::Result<()> {
    let views = Views::of_folder(folder)?;
    let size = |view: &View| (view.camera.intrinsics.width, view.camera.intrinsics.height);
    if views.views.iter().any(|view| size(view) != size(&views.views[0])) {
        return Err(Failure::BadInput(
            "the views have several sizes; set size in render-depth".to_owned(),
        )
        .into());
    }
    let progress = context.progress("drawing", 2 * views.views.len() as u64);
    // One range of depths for all frames: colours that change with the frame would flicker.
    let ranges = views.views.par_iter().map(|view| -> anyhow::Result<Option<(f32, f32)>> {
        progress.add(1);
        let Some(file) = &view.depth else { return Ok(None) };
        let image = read_exr(&folder.join(file))?;
        Ok(DepthMap::of(&image).and_then(|map| map.range()))
    });
    let ranges = ranges.collect::<anyhow::Result<Vec<_>>>()?;
    let range = common_range(ranges.into_iter().flatten());
    views
        .views
        .par_iter()
        .enumerate()
        .map(|(i, view)| {
            context.check_interrupt()?;
            let image = view
                .image
                .as_ref()
                .with_context(|| format!("view {}: it has no image", view.camera.name))?;
            let colour = views.read_over(&folder.join(image))?.to_rgba8();
            let depth = match (&view.depth, range) {
                (Some(file), Some(range)) => {
                    let image = read_exr(&folder.join(file))?;
                    DepthMap::of(&image).map(|map| map.draw(image.width, range))
                }
                _ => None,
            };
            let frame = depth.map_or_else(|| colour.clone(), |depth| side_by_side(&colour, &depth));
            write_png(&context.output_path(&format!("{prefix}frames/{i:05}.png"))?, &even(&frame))?;
            progress.add(1);
            Ok(())
        })
        .collect::<anyhow::Result<Vec<()>>>()?;
    let frames = context.output_path(&format!("{prefix}frames/%05d.png"))?;
    encode(context, params, &frames, &context.output_path(&format!("{prefix}video.mp4"))?)
}

/// Two images of one height as one.
fn side_by_side(left: &Rgba8, right: &Rgba8) -> Rgba8 {
    let rows = left.data.chunks_exact(4 * left.width).zip(right.data.chunks_exact(4 * right.width));
    Rgba8::new(
        left.width + right.width,
        left.height,
        rows.flat_map(|(a, b)| [a, b].concat()).collect(),
    )
}

/// With a last column and row twice where sizes are odd, which films can't have.
fn even(image: &Rgba8) -> Rgba8 {
    let (width, height) = (image.width.next_multiple_of(2), image.height.next_multiple_of(2));
    let pixels = (0..width * height).flat_map(|i| {
        let (x, y) = ((i % width).min(image.width - 1), (i / width).min(image.height - 1));
        let at = 4 * (y * image.width + x);
        [image.data[at], image.data[at + 1], image.data[at + 2], image.data[at + 3]]
    });
    Rgba8::new(width, height, pixels.collect())
}

/// Makes the film by ffmpeg; without it, or where it fails, says so: the frames are there.
fn encode(context: &Context, params: &Params, frames: &Path, film: &Path) -> anyhow::Result<()> {
    let rate = params.frames_per_second.to_string();
    let mut command = Command::new("ffmpeg");
    command.args(["-loglevel", "error", "-nostdin", "-y", "-framerate", &rate, "-i"]).arg(frames);
    command.args(["-pix_fmt", "yuv420p", "-movflags", "+faststart"]).arg(film).stdin(Stdio::null());
    let folder = frames.parent().unwrap_or(frames).display();
    let output = output_of(context, &mut command);
    context.check_interrupt()?;
    match output {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => {
            let said = String::from_utf8_lossy(&output.stderr);
            context.say(format!(
                "no video.mp4: ffmpeg said {:?}; the frames are there",
                said.lines().next().unwrap_or("nothing")
            ));
            // What it left is no film.
            std::fs::remove_file(film).or_else(|e| {
                if e.kind() == std::io::ErrorKind::NotFound { Ok(()) } else { Err(e) }
            })?;
            Ok(())
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            context.say("no video.mp4, since ffmpeg isn't installed; the frames are there");
            Ok(())
        }
        Err(e) => Err(e).with_context(|| format!("cannot start ffmpeg for {folder}")),
    }
}

/// Runs a program that says little, and kills it when a signal asks the stage to stop.
fn output_of(context: &Context, command: &mut Command) -> io::Result<process::Output> {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn()?;
    let pipe = child.stderr.take();
    let words = std::thread::spawn(|| {
        let mut bytes = Vec::new();
        pipe.map_or(Ok(0), |mut pipe| pipe.read_to_end(&mut bytes)).map(|_| bytes)
    });
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if context.interrupted() {
            child.kill()?;
        }
        std::thread::sleep(INTERVAL);
    };
    let stderr = words.join().unwrap_or_else(|_| Ok(Vec::new()))?;
    Ok(process::Output { status, stdout: Vec::new(), stderr })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_have_even_sizes_and_both_images() {
        let one = |width: usize, level: u8| Rgba8::new(width, 3, vec![level; 4 * width * 3]);
        let frame = even(&side_by_side(&one(3, 10), &one(2, 20)));
        assert_eq!((frame.width, frame.height), (6, 4));
        let row: Vec<u8> = frame.data[3 * 6 * 4..].chunks_exact(4).map(|p| p[0]).collect();
        assert_eq!(row, [10, 10, 10, 20, 20, 20]);
    }
}

//! `video`: rendered views as a film, colour and depth side by side.
//!
//! The stage is a sink. It writes a PNG per frame and a film: `video.mp4` by `ffmpeg`, or
//! `video.png` if `ffmpeg` is missing or fails. Each point of a sweep has its own folder.

mod film;

use std::path::Path;

use anyhow::Context as _;
use artifact::{Failure, FailureExt as _, RunNode, RunRecord, bail_bad_input, label, sink_folders};
use pixels::{DepthMap, Rgba8, common_range, read_exr, write_png};
use rayon::prelude::*;
use scene::{View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Stage};

use crate::film::Film;

/// Parameters of `video`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Frames per second. Default: those of the camera path, otherwise 30.
    #[schemars(range(min = 1, max = 240), extend("x-default" = "by camera path"))]
    pub frames_per_second: Option<u32>,
    /// Draws depth to the right of colour.
    pub show_depth: bool,
}

impl Default for Params {
    fn default() -> Self {
        Self { frames_per_second: None, show_depth: true }
    }
}

/// Frames per second of views whose camera path is unknown; chosen by hand.
const DEFAULT_FRAMES_PER_SECOND: f64 = 30.0;

/// Part of a camera path, `camera_path.json`.
#[derive(Deserialize)]
struct CameraPath {
    /// Frames per second.
    fps: f64,
}

/// The stage.
pub struct Video;

impl Stage for Video {
    type Params = Params;
    const NAME: &'static str = "video";
    const SUMMARY: &'static str =
        "Makes a film of rendered or refined views, colour and depth side by side.";
    const SINK: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        Input::of_sink(
            "in pipeline.yaml: a block that renders views; nerf-sr passes a folder with its \
            record, run.json",
        )
    }

    fn output() -> Output {
        Output::kind("video")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let run = RunRecord::read(context.input("run")?)?;
        let rendered: Vec<&RunNode> =
            run.nodes.iter().filter(|n| n.is_shown && n.kind == "views").collect();
        if rendered.is_empty() {
            bail_bad_input!("run.json has no rendered views");
        }
        for (node, prefix) in rendered.iter().zip(sink_folders(&rendered)) {
            let rate = match params.frames_per_second {
                Some(rate) => f64::from(rate),
                None => path_rate(&run, node)?.unwrap_or(DEFAULT_FRAMES_PER_SECOND),
            };
            make_film(context, params.show_depth, &node.folder, &prefix, rate)
                .with_context(|| label(&node.stage, &node.point))?;
        }
        Ok(())
    }
}

/// Returns the rate of the camera path from which a node's views were rendered; `None` if their
/// cameras are no path. Refined views have the path of the views that were refined, whatever other
/// views the refinement took.
fn path_rate(run: &RunRecord, node: &RunNode) -> Result<Option<f64>, Failure> {
    let input = ["views", "cameras"].iter().find_map(|name| node.inputs.get(*name)?.node);
    let Some(parent) = input.and_then(|index| run.nodes.get(index)) else { return Ok(None) };
    if parent.kind == "views" {
        return path_rate(run, parent);
    }
    let file = parent.folder.join("camera_path.json");
    if parent.kind != "cameras" || !file.is_file() {
        return Ok(None);
    }
    let bytes = std::fs::read(&file).bad_input(file.display())?;
    let path: CameraPath = serde_json::from_slice(&bytes).bad_input(file.display())?;
    Ok(Some(path.fps))
}

/// Writes the frames and the film.
fn make_film(
    context: &Context,
    with_depth: bool,
    folder: &Path,
    prefix: &str,
    rate: f64,
) -> anyhow::Result<()> {
    let views = Views::read_folder(folder)?;
    let size = |view: &View| [view.camera.intrinsics.width, view.camera.intrinsics.height];
    if views.views.iter().any(|view| size(view) != size(&views.views[0])) {
        bail_bad_input!("views have different sizes; set render-depth.size");
    }
    let progress = context.progress("drawing", 2 * views.views.len() as u64);
    // All frames have one range of depths: with a range per frame, colours would flicker.
    let ranges = views.views.par_iter().map(|view| -> anyhow::Result<Option<(f32, f32)>> {
        progress.add(1);
        let Some(file) = view.depth.as_ref().filter(|_| with_depth) else { return Ok(None) };
        let image = read_exr(&folder.join(file))?;
        Ok(DepthMap::of(&image).and_then(|map| map.range()))
    });
    let ranges = ranges.collect::<anyhow::Result<Vec<_>>>()?;
    let range = common_range(ranges.into_iter().flatten());
    let film = Film { prefix, frames: views.views.len(), rate };
    views.views.par_iter().enumerate().try_for_each(|(i, view)| {
        context.check_interrupt()?;
        let frame = side_by_side(&draw_frame(&views, view, folder, range)?);
        write_png(&film.frame_path(context, &format!("{i:05}"))?, &frame)?;
        progress.add(1);
        anyhow::Ok(())
    })?;
    film.write(context)
}

/// Draws a view's colour and, with a range of depths, its depth.
fn draw_frame(
    views: &Views,
    view: &View,
    folder: &Path,
    range: Option<(f32, f32)>,
) -> anyhow::Result<Vec<Rgba8>> {
    let image = view.image.as_ref();
    let image = image.with_context(|| format!("view {} has no image", view.camera.name))?;
    let colour = views.read_over(&folder.join(image))?.to_rgba8();
    let (Some(file), Some(range)) = (&view.depth, range) else { return Ok(vec![colour]) };
    let image = read_exr(&folder.join(file))?;
    let Some(map) = DepthMap::of(&image) else { return Ok(vec![colour]) };
    if image.height != colour.height {
        bail_bad_input!(
            "view {}: image and depth have different heights, {} and {} pixels",
            view.camera.name,
            colour.height,
            image.height
        );
    }
    let depth = map.draw(image.width, range);
    Ok(vec![colour, depth])
}

/// Joins images of equal height side by side. Repeats the last column and row of odd sizes, which
/// yuv420p doesn't allow.
fn side_by_side(images: &[Rgba8]) -> Rgba8 {
    let width: usize = images.iter().map(|image| image.width).sum();
    let mut data = Vec::new();
    for y in 0..images[0].height.next_multiple_of(2) {
        for image in images {
            let row = y.min(image.height - 1) * image.width;
            data.extend_from_slice(&image.data[4 * row..4 * (row + image.width)]);
        }
        if width % 2 == 1 {
            data.extend_from_within(data.len() - 4..);
        }
    }
    Rgba8::new(width.next_multiple_of(2), images[0].height.next_multiple_of(2), data)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_have_even_sizes_and_both_images() {
        let image = |width: usize, level: u8| Rgba8::new(width, 3, vec![level; 4 * width * 3]);
        let frame = side_by_side(&[image(3, 10), image(2, 20)]);
        assert_eq!((frame.width, frame.height), (6, 4));
        let row: Vec<u8> = frame.data[3 * 6 * 4..].chunks_exact(4).map(|p| p[0]).collect();
        assert_eq!(row, [10, 10, 10, 20, 20, 20]);
    }

    /// Views refined with references have their own path's rate; the references have no path.
    #[test]
    fn refined_views_have_the_rate_of_their_path() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("camera_path.json"), r#"{"fps": 24}"#).unwrap();
        let node = |kind: &str, inputs: serde_json::Value| {
            serde_json::json!({"stage": kind, "point": "", "kind": kind, "key": "", "output": "",
                "folder": folder.path(), "parameters": {}, "inputs": inputs, "started_unix": 0,
                "seconds": 0.0, "threads": 1})
        };
        let run: RunRecord = serde_json::from_value(serde_json::json!({"nodes": [
            node("cameras", serde_json::json!({})),
            node("views", serde_json::json!({"cameras": {"node": 0}})),
            node("views", serde_json::json!({})),
            node("views", serde_json::json!(
                {"reference-views": {"node": 2}, "views": {"node": 1}}
            )),
        ]}))
        .unwrap();
        let rates: Vec<_> = run.nodes.iter().map(|node| path_rate(&run, node).unwrap()).collect();
        assert_eq!(rates, [None, Some(24.0), None, Some(24.0)]);
    }
}

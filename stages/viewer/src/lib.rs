//! `viewer`: a trained field as one HTML page to look around in, without the field or a network.
//!
//! The stage is a sink. It bakes the field into a sparse volume and writes this volume, the
//! training cameras, their LR photographs and a small WebGL2 renderer into `index.html`. Each point
//! of a sweep has its own folder.
//!
//! * `bake`: the field as voxels with opacity, mean colour and view dependence (`view`). As in
//!   SNeRG (Hedman et al. 2021), view dependence is added once per ray, to the composited colour.
//!   Voxels that no training camera sees are left out (`visibility`).
//! * `bricks`, `atlas`: voxels in bricks of 8³, packed into deflated bytes.
//! * `page`: the HTML file; script, style and shader are in `src/page/`.
//! * `overview`: initial camera and centre of rotation.
//!
//! Positions are those of the field's unit cube ([`scene::Space`]; `space`), and the shader maps
//! its rays into the cube as the field does (docs/design/042).

mod atlas;
mod bake;
mod bricks;
mod overview;
mod page;
mod space;
mod view;
mod visibility;

use std::path::Path;

use anyhow::Context as _;
use artifact::{GivenInput, RunNode, RunRecord, bail_bad_input, sink_folders};
use base64::Engine as _;
use pixels::{
    DEGRADATION_FILE, Degradation, Filter, Image, Rgba8, encode_png, read_premultiplied,
    resize_pillow,
};
use scene::{Bounds, Camera, Space, Views, undistort_image};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Stage};

use crate::atlas::Atlas;
use crate::bake::{Baker, Shape, Volume};
use crate::page::{ImageSize, PageCamera, PageScene};

/// Parameters of `viewer`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Voxels along each side of the field's unit cube; a multiple of 8. Memory and file size grow
    /// with the square of the resolution; the time to bake grows with its cube.
    #[schemars(range(min = 32, max = 512), extend("multipleOf" = 8))]
    pub resolution: u32,
    /// Maximum number of LR photographs in the page, spread evenly over the training views.
    #[schemars(range(min = 0, max = 1000))]
    pub photographs: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self { resolution: 256, photographs: 100 }
    }
}

/// Maximum width in pixels of the LR photographs in the page; chosen by hand. Wider ones are
/// shrunk.
const MAX_PHOTOGRAPH_WIDTH: usize = 400;

/// Remedy for short memory, as a sentence fragment.
const REMEDY: &str = "choose a smaller resolution, or end other programs";

/// The stage.
pub struct Viewer;

impl Stage for Viewer {
    type Params = Params;
    const NAME: &'static str = "viewer";
    const SUMMARY: &'static str = "Bakes a field into one HTML page to look around in.";
    const LIBTORCH: bool = cfg!(feature = "torch");
    const SINK: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        Input::of_sink(
            "in pipeline.yaml: a block that trains a field; nerf-sr passes a folder with its \
            record, run.json",
        )
    }

    fn output() -> Output {
        Output::kind("page")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let run = RunRecord::read(context.input("run")?)?;
        let is_shown_field = |i: &usize| run.nodes[*i].is_shown && run.nodes[*i].kind == "field";
        let indices: Vec<usize> = (0..run.nodes.len()).filter(is_shown_field).collect();
        let fields: Vec<&RunNode> = indices.iter().map(|&i| &run.nodes[i]).collect();
        if fields.is_empty() {
            bail_bad_input!("run.json has no field to show; set input `run: train-ss`");
        }
        for (index, prefix) in indices.into_iter().zip(sink_folders(&fields)) {
            let node = &run.nodes[index];
            write_page(context, params, &run, index, &prefix)
                .with_context(|| format!("{} {}", node.stage, node.point).trim_end().to_owned())?;
        }
        Ok(())
    }
}

/// Bakes one field and writes its page.
fn write_page(
    context: &Context,
    params: &Params,
    run: &RunRecord,
    index: usize,
    prefix: &str,
) -> anyhow::Result<()> {
    let node = &run.nodes[index];
    let input = GivenInput::open("field", &node.folder)?;
    let (file, fields) = fields::read_point_fields(&input)?;
    let folder = node.inputs.get("scene").map(|input| run.folder_of(input));
    let folder = folder.context("the field's training has no input `scene`")?;
    let views = Views::read_folder(&folder)?;
    let cameras: Vec<&Camera> = views.views.iter().map(|view| &view.camera).collect();
    let resolution = params.resolution as usize;
    let observers = visibility::observers(&cameras, resolution);
    let baker = Baker { sources: &fields, bounds: &file.bounds, cameras: &observers, resolution };
    let volume = bake(context, &baker)?;
    let atlas = Atlas::pack(&volume, |bytes| context.progress("packing", bytes))?;
    let (centre, size) = overview::centre_and_size(&file.bounds, &volume);
    let up = overview::up_direction(&cameras);
    let scene = PageScene {
        name: scene_name(run, index),
        resolution,
        bricks: atlas.bricks,
        components: atlas.components.for_shader(),
        background: file.background.grey_level(),
        bounds: page_bounds(&file.bounds),
        centre: centre.to_array(),
        size,
        film_width: film_width(&folder, &cameras)?,
        frustum_depth: overview::frustum_depth(&cameras, size),
        up: up.to_array(),
        start: overview::start_camera(&cameras, up),
        cameras: page_cameras(params, &folder, &views)?,
    };
    let html = page::page(&scene, &atlas)?.into_string();
    context.write_text(&format!("{prefix}index.html"), &html)
}

/// Returns the name of a field's data set: the last part of its path.
fn scene_name(run: &RunRecord, field: usize) -> String {
    let data_set = match &run.data_sets[..] {
        [] => String::new(),
        [only] => only.clone(),
        _ => run.data_set(field),
    };
    let name = Path::new(&data_set).file_name().and_then(|name| name.to_str());
    name.unwrap_or("scene").to_owned()
}

/// Returns the width of a recorded video in pixels: that of the scene's HR images, if known.
fn film_width(folder: &Path, cameras: &[&Camera]) -> anyhow::Result<u32> {
    let input = GivenInput::open("scene", folder)?;
    let degradation: Option<Degradation> = input.read_optional_json(DEGRADATION_FILE)?;
    let lr_width = cameras.first().map_or(1, |camera| camera.intrinsics.width);
    Ok(degradation.map_or(lr_width, |degradation| degradation.hr[0]))
}

/// Bakes a field. Fails if memory is short.
fn bake(context: &Context, baker: &Baker<'_>) -> anyhow::Result<Volume> {
    let bricks = baker.bricks(&context.progress("finding density", baker.max_bricks()))?;
    context.check_memory("baking", Shape::memory_need(&bricks), REMEDY)?;
    let progress = context.progress("baking", baker.steps(&bricks));
    let shape = baker.shape(bricks, &progress)?;
    context.check_memory("baking", shape.volume_memory_need(), REMEDY)?;
    Ok(baker.volume(&shape, &progress)?)
}

/// Returns the bounds of the page's rays. A viewer may be nearer than the cameras were. In a box
/// and NDC, the cube ends the rays, so `far` needs no limit.
fn page_bounds(bounds: &Bounds) -> Bounds {
    // JSON has no infinity.
    let far = if bounds.space == Space::Contraction { bounds.far } else { 1e30 };
    Bounds { near: 0.0, far, ..*bounds }
}

/// Returns the training cameras, some of them with their photograph.
fn page_cameras(params: &Params, folder: &Path, views: &Views) -> anyhow::Result<Vec<PageCamera>> {
    let count = views.views.len();
    let photographs = params.photographs as usize;
    let mut cameras = Vec::with_capacity(count);
    for (i, view) in views.views.iter().enumerate() {
        // Spread evenly: a photograph wherever i * photographs / count reaches the next integer.
        let has_photograph = (i + 1) * photographs / count > i * photographs / count;
        let intrinsics = view.camera.intrinsics;
        // The page draws a pinhole camera instead of a fisheye one, and ignores other distortion,
        // which is small enough.
        let is_fisheye = intrinsics.distortion.is_fisheye();
        let pinhole = is_fisheye.then(|| intrinsics.pinhole()).flatten();
        let photograph = match &view.image {
            Some(file) if has_photograph => {
                let image = straight_alpha(&read_premultiplied(&folder.join(file))?);
                let image = match pinhole {
                    Some(pinhole) => undistort_image(&image, &intrinsics, &pinhole),
                    None => image,
                };
                Some(shrunk(image, MAX_PHOTOGRAPH_WIDTH))
            }
            _ => None,
        };
        cameras.push(PageCamera {
            name: view.camera.name.clone(),
            camera_to_world: view.camera.camera_to_world,
            intrinsics: pinhole.unwrap_or(intrinsics),
            photograph: photograph.as_ref().map(data_uri),
            photograph_size: photograph.map(|p| ImageSize { width: p.width, height: p.height }),
        });
    }
    Ok(cameras)
}

/// Converts premultiplied RGBA to 8 bits with straight alpha, so that the page's background is
/// behind the photograph, too.
fn straight_alpha(image: &Image) -> Rgba8 {
    let mut data = image.data.clone();
    for pixel in data.as_chunks_mut::<4>().0 {
        let [.., alpha] = *pixel;
        if alpha > 0.0 {
            pixel[..3].iter_mut().for_each(|level| *level /= alpha);
        }
    }
    Image::new(image.width, image.height, 4, data).to_rgba8()
}

/// Shrinks an image by a whole factor to at most `max_width` pixels in width.
fn shrunk(image: Rgba8, max_width: usize) -> Rgba8 {
    let factor = image.width.div_ceil(max_width);
    if factor < 2 {
        return image;
    }
    let [width, height] = [image.width, image.height].map(|size| size.div_ceil(factor));
    resize_pillow(&image, width, height, Filter::Box)
}

fn data_uri(image: &Rgba8) -> String {
    let text = base64::engine::general_purpose::STANDARD.encode(encode_png(image));
    format!("data:image/png;base64,{text}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In a sweep over data sets, each page has the name of its own field's data set.
    #[test]
    fn a_page_is_named_by_its_data_set() {
        let node = |kind: &str, inputs: serde_json::Value| {
            serde_json::json!({"stage": kind, "point": "", "kind": kind, "key": "", "output": "",
                "folder": "", "parameters": {}, "inputs": inputs, "started_unix": 0,
                "seconds": 0.0, "threads": 1})
        };
        let scene =
            |folder: &str| node("scene", serde_json::json!({"dataset": {"folder": folder}}));
        let field = |scene: usize| node("field", serde_json::json!({"scene": {"node": scene}}));
        let nodes = [scene("data/chair"), scene("data/lego"), field(0), field(1)];
        for (data_sets, names) in [
            (vec!["data/chair", "data/lego"], ["chair", "lego"]),
            (vec!["data/ship"], ["ship"; 2]),
            (vec![], ["scene"; 2]),
        ] {
            let run = serde_json::json!({"nodes": nodes, "data_sets": data_sets});
            let run: RunRecord = serde_json::from_value(run).unwrap();
            assert_eq!([2, 3].map(|field| scene_name(&run, field)), names);
        }
    }
}

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
//! Positions are those of the field's unit cube ([`scene::Space`]), and the shader maps its rays
//! into the cube as the field does for a box. The other spaces are refused, because their fields
//! are too hazy to be baked (docs/design/042).

mod atlas;
mod bake;
mod bricks;
mod overview;
mod page;
mod view;
mod visibility;

use std::path::Path;

use anyhow::Context as _;
use artifact::{Failure, FailureExt as _, GivenInput, RunNode, RunRecord, sink_folders};
use base64::Engine as _;
use fields::{FieldFile, FieldModel};
use pixels::{Filter, Rgba8, encode_png, resize_pillow};
use radiance::Field;
use scene::{Bounds, Camera, Intrinsics, Space, Views, undistort_image};
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
    /// with its square, the time to bake with its cube.
    #[schemars(range(min = 32, max = 512), extend("multipleOf" = 8))]
    pub resolution: u32,
    /// Maximum number of LR photographs in the page, spread evenly over the training views.
    #[schemars(range(min = 0, max = 1000))]
    pub photographs: u32,
    /// Maximum width in pixels of the LR photographs in the page; wider ones are shrunk.
    #[schemars(range(min = 16, max = 4096))]
    pub photograph_width: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self { resolution: 256, photographs: 100, photograph_width: 400 }
    }
}

/// Remedy for short memory, as a sentence fragment.
const REMEDY: &str = "choose a smaller resolution, or end other programs";

/// The stage.
pub struct Viewer;

impl Stage for Viewer {
    type Params = Params;
    const NAME: &'static str = "viewer";
    const SUMMARY: &'static str = "Bakes a field into one HTML page to look around in.";
    const SINK: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![(
            "run",
            Input::required(&["run"], "folder with run.json, the record of the field's training"),
        )]
    }

    fn output() -> Output {
        Output::kind("page")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let run: RunRecord = context.input("run")?.read_json("run.json")?;
        run.check().map_err(|e| Failure::BadInput(e.to_string()))?;
        let fields: Vec<&RunNode> =
            run.nodes.iter().filter(|n| n.is_shown && n.kind == "field").collect();
        if fields.is_empty() {
            let message = "run.json has no field to show; set input `run: train-ss`";
            return Err(Failure::BadInput(message.to_owned()).into());
        }
        for (node, prefix) in fields.iter().zip(sink_folders(&fields)) {
            write_page(context, params, &run, node, &prefix)
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
    node: &RunNode,
    prefix: &str,
) -> anyhow::Result<()> {
    let (file, fields) = read_fields(&node.folder)?;
    check_space(&file.bounds)?;
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
        resolution,
        bricks: atlas.bricks,
        components: atlas.components.for_shader(),
        background: file.background.grey_level(),
        // Only the box's faces limit rays: a viewer may be nearer or farther than the cameras were.
        bounds: Bounds { near: 0.0, far: 1e30, ..file.bounds },
        centre: centre.to_array(),
        size,
        up: up.to_array(),
        start: overview::start_camera(&cameras, up),
        cameras: page_cameras(params, &folder, &views)?,
    };
    let html = page::page(&scene, &atlas)?.into_string();
    let path = context.output_path(&format!("{prefix}index.html"))?;
    std::fs::write(&path, html).with_context(|| format!("cannot write {}", path.display()))
}

/// Bakes a field. Fails if memory is short.
fn bake(context: &Context, baker: &Baker<'_, Field>) -> anyhow::Result<Volume> {
    let bricks = baker.bricks();
    context.check_memory("baking", Shape::memory_need(&bricks), REMEDY)?;
    let progress = context.progress("baking", baker.steps(&bricks));
    let shape = baker.shape(bricks, &progress);
    context.check_memory("baking", shape.volume_memory_need(), REMEDY)?;
    Ok(baker.volume(&shape, &progress))
}

/// Refuses NDC and contraction. Their fields are hazy: a voxel's own view features lack what a ray
/// through haze composites, and pages look washed out (docs/design/042).
fn check_space(bounds: &Bounds) -> Result<(), Failure> {
    let space = match bounds.space {
        Space::Box => return Ok(()),
        Space::Ndc(_) => "ndc",
        Space::Contraction => "contraction",
    };
    Err(Failure::BadInput(format!(
        "field.json: the viewer can't show a field with space {space}; if the scene fits into a \
        box, set prep.space to box"
    )))
}

/// Reads all fields of an artifact.
fn read_fields(folder: &Path) -> anyhow::Result<(FieldFile, Vec<Field>)> {
    let input = GivenInput::open("field", folder)?;
    let file = fields::read_field_file(&input)?;
    let FieldModel::Grid(architecture) = file.field else {
        let message = "the paper's field can't be baked; train with `field: grid` to view it";
        return Err(Failure::BadInput(message.to_owned()).into());
    };
    let fields = (0..file.members)
        .map(|i| Field::read(&input.path(&FieldFile::member_file(i)), architecture, file.bounds))
        .collect::<Result<_, _>>()
        .bad_input("field")?;
    Ok((file, fields))
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
        let pinhole = pinhole_of_fisheye(&intrinsics);
        let photograph = match &view.image {
            Some(file) if has_photograph => {
                let image = views.read_over(&folder.join(file))?.to_rgba8();
                let image = match pinhole {
                    Some(pinhole) => undistort_image(&image, &intrinsics, &pinhole),
                    None => image,
                };
                Some(shrunk(image, params.photograph_width as usize))
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

/// Returns the pinhole camera that the page draws instead of a fisheye camera. The page ignores
/// other distortion, which is small enough.
fn pinhole_of_fisheye(intrinsics: &Intrinsics) -> Option<Intrinsics> {
    if intrinsics.distortion.is_fisheye() { intrinsics.pinhole() } else { None }
}

/// Shrinks an image by a whole factor to at most `max_width` pixels in width.
fn shrunk(image: Rgba8, max_width: usize) -> Rgba8 {
    let factor = image.width.div_ceil(max_width);
    if factor < 2 {
        return image;
    }
    let [width, height] = [image.width, image.height].map(|size| size.div_ceil(factor).max(1));
    resize_pillow(&image, width, height, Filter::Box)
}

fn data_uri(image: &Rgba8) -> String {
    let text = base64::engine::general_purpose::STANDARD.encode(encode_png(image));
    format!("data:image/png;base64,{text}")
}

//! `viewer`: a trained field as one HTML page to look around in, without the field or a network.
//!
//! A sink. It bakes the field into a sparse volume and puts this volume, the training cameras,
//! their LR photographs and a small WebGL2 renderer into `index.html`. A sweep's points get a
//! folder each.
//!
//! * `bake`: the field as voxels: opacity, mean colour, and how this changes with the direction
//!   (`view`). As in SNeRG (Hedman et al. 2021) the direction changes a ray's composited colour,
//!   once a ray. Voxels that no training camera sees are left out (`visibility`).
//! * `bricks`, `atlas`: voxels in bricks of 8³, packed into deflated bytes.
//! * `page`: the HTML file; script, style and shader lie in `src/page/`.
//! * `overview`: where the view starts, and around what it turns.
//!
//! Places are those of the field's unit cube ([`scene::Space`]), and the shader maps its rays there
//! as the field does for a box. The other spaces are refused: their fields are too hazy to be baked
//! so.

mod atlas;
mod bake;
mod bricks;
mod overview;
mod page;
mod source;
mod view;
mod visibility;

use std::path::Path;

use anyhow::Context as _;
use artifact::{Failure, FailureExt as _, GivenInput, RunNode, RunRecord, folders_of};
use base64::Engine as _;
use contract::{Input, Output};
use pixels::{Filter, Rgba8, encode_png, resize_pillow};
use radiance::{Field, FieldFile, FieldModel};
use scene::{Bounds, Camera, Intrinsics, Space, Views, undistorted};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Stage};

use crate::atlas::Atlas;
use crate::bake::{Baker, Shape, Volume};
use crate::page::{ImageSize, PageCamera, PageScene};

/// Parameters of `viewer`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Voxels along each side of the field's unit cube; a multiple of 8. Memory and file grow with
    /// its square, the time to bake with its cube.
    #[schemars(range(min = 32, max = 512), extend("multipleOf" = 8))]
    pub resolution: u32,
    /// Number of LR photographs in the page at most, spread evenly over the training views.
    #[schemars(range(min = 0, max = 1000))]
    pub photographs: u32,
    /// Width of these photographs at most; wider ones are shrunk.
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
            Input::required(&["run"], "folder with run.json: the record of what trained the field"),
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
            let message = "run.json: nothing that it shows is a field; give `run: train-ss`";
            return Err(Failure::BadInput(message.to_owned()).into());
        }
        for (node, prefix) in fields.iter().zip(folders_of(&fields)) {
            show(context, params, &run, node, &prefix)
                .with_context(|| format!("{} {}", node.stage, node.point).trim_end().to_owned())?;
        }
        Ok(())
    }
}

/// Writes the page of one field.
fn show(
    context: &Context,
    params: &Params,
    run: &RunRecord,
    node: &RunNode,
    prefix: &str,
) -> anyhow::Result<()> {
    let (file, fields) = read_fields(&node.folder)?;
    check_space(&file.bounds)?;
    let scene = node.inputs.get("scene").map(|input| run.folder_of(input));
    let scene = scene.with_context(|| "the field's training has no input `scene`")?;
    let views = Views::of_folder(&scene)?;
    let cameras: Vec<&Camera> = views.views.iter().map(|view| &view.camera).collect();
    let resolution = params.resolution as usize;
    let looking = visibility::looking(&cameras, resolution);
    let baker = Baker { sources: &fields, bounds: &file.bounds, cameras: &looking, resolution };
    let volume = bake(context, &baker)?;
    let atlas = Atlas::pack(&volume, |bytes| context.progress("packing", bytes))?;
    let (centre, size) = overview::middle(&file.bounds, &volume);
    let up = overview::up(&cameras);
    let described = PageScene {
        resolution,
        bricks: atlas.bricks,
        components: atlas.components.for_shader(),
        background: file.background.shown(),
        // A box's faces alone limit rays: people come nearer than cameras did, and go farther away.
        bounds: Bounds { near: 0.0, far: 1e30, ..file.bounds },
        centre: centre.to_array(),
        size,
        up: up.to_array(),
        start: overview::start(&cameras, up),
        cameras: page_cameras(params, &scene, &views)?,
    };
    let html = page::page(&described, &atlas)?.into_string();
    let path = context.output_path(&format!("{prefix}index.html"))?;
    std::fs::write(&path, html).with_context(|| format!("cannot write {}", path.display()))
}

/// Bakes a field as far as memory suffices.
fn bake(context: &Context, baker: &Baker<'_, Field>) -> anyhow::Result<Volume> {
    let bricks = baker.bricks();
    context.check_memory("baking", Shape::memory_need(&bricks), REMEDY)?;
    let progress = context.progress("baking", baker.steps(&bricks));
    let shape = baker.shape(bricks, &progress);
    context.check_memory("baking", shape.volume_memory_need(), REMEDY)?;
    Ok(baker.volume(&shape, &progress))
}

/// Refuses the spaces of scenes without end. Their fields are hazy: a voxel's own view features say
/// too little of what a ray through haze composites, and pages look washed out.
fn check_space(bounds: &Bounds) -> Result<(), Failure> {
    let space = match bounds.space {
        Space::Box => return Ok(()),
        Space::Ndc(_) => "ndc",
        Space::Contraction => "contraction",
    };
    Err(Failure::BadInput(format!(
        "field.json: the field's space is {space}; the viewer shows only a box: give prep `space: \
        box` where the scene ends"
    )))
}

/// All fields of an artifact.
fn read_fields(folder: &Path) -> anyhow::Result<(FieldFile, Vec<Field>)> {
    let input = GivenInput::open("field", folder)?;
    let file = fields::read_file(&input)?;
    let FieldModel::Grid(architecture) = file.field else {
        let message = "the paper's field can't be baked; train with `field: grid` to view it";
        return Err(Failure::BadInput(message.to_owned()).into());
    };
    let fields = (0..file.members)
        .map(|i| Field::read(&input.path(&FieldFile::member(i)), architecture, file.bounds))
        .collect::<Result<_, _>>()
        .bad_input("field")?;
    Ok((file, fields))
}

/// The training cameras, some of them with their photograph.
fn page_cameras(params: &Params, folder: &Path, views: &Views) -> anyhow::Result<Vec<PageCamera>> {
    let (count, most) = (views.views.len(), params.photographs as usize);
    let mut cameras = Vec::with_capacity(count);
    for (i, view) in views.views.iter().enumerate() {
        // One in so many: where the share so far passes a whole number.
        let is_shown = (i + 1) * most / count > i * most / count;
        let taken_with = view.camera.intrinsics;
        let drawn = drawn_with(&taken_with);
        let photograph = match &view.image {
            Some(file) if is_shown => {
                let image = views.read_over(&folder.join(file))?.to_rgba8();
                let image = match drawn {
                    Some(pinhole) => undistorted(&image, &taken_with, &pinhole),
                    None => image,
                };
                Some(shrunk(image, params.photograph_width as usize))
            }
            _ => None,
        };
        cameras.push(PageCamera {
            name: view.camera.name.clone(),
            camera_to_world: view.camera.camera_to_world,
            intrinsics: drawn.unwrap_or(taken_with),
            photograph: photograph.as_ref().map(data_uri),
            photograph_size: photograph.map(|p| ImageSize { width: p.width, height: p.height }),
        });
    }
    Ok(cameras)
}

/// Returns the pinhole camera that the page draws in place of a fisheye camera. Other distortion is
/// small enough to be left out.
fn drawn_with(taken_with: &Intrinsics) -> Option<Intrinsics> {
    if taken_with.distortion.is_fisheye() { taken_with.pinhole() } else { None }
}

/// An image of at most a width, a whole number of times smaller.
fn shrunk(image: Rgba8, most: usize) -> Rgba8 {
    let times = image.width.div_ceil(most);
    if times < 2 {
        return image;
    }
    let less = |size: usize| size.div_ceil(times).max(1);
    resize_pillow(&image, less(image.width), less(image.height), Filter::Box)
}

fn data_uri(image: &Rgba8) -> String {
    let text = base64::engine::general_purpose::STANDARD.encode(encode_png(image));
    format!("data:image/png;base64,{text}")
}

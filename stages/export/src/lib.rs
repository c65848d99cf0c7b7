//! `export`: a trained field in files that other programs open.
//!
//! The field is rendered from the training cameras; all files are made of what these views see.
//!
//! * `points.ply`: coloured points with normals.
//! * `splats.ply`: 3D Gaussians in the layout of 3DGS viewers.
//! * `mesh.glb`: triangles with vertex colours, by fusing the views' depth.
//! * `transforms.json`, `colmap/sparse/0/`: the cameras for instant-ngp, nerfstudio and COLMAP.
//! * [`EXPORT_FILE`]: counts, and the coordinates in words.
//! * [`OFFSET_FILE`]: for scenes far from the origin, what points, splats and mesh lack.
//!
//! Coordinates, scale and orientation are those of the cameras given, which `prep` leaves as the
//! data set has them. Points, splats and mesh have single precision. Where that can't hold the
//! coordinates, these files are counted from an offset ([`coordinates`]). Camera axes are OpenGL's (x right, y up, looking along -z) in
//! `transforms.json`, and COLMAP's (x right, y down, looking along z) in its model.

mod cameras;
mod colour;
mod consensus;
mod coordinates;
mod fusion;
mod glb;
mod lattice;
mod mesh;
mod ply;
mod points;
mod seen;
mod splats;
mod surface_nets;
mod surfel;
#[cfg(test)]
mod tests;
mod unseen;

use std::fs::File;
use std::io::{self, BufWriter, Write as _};

use anyhow::Context as _;
use artifact::{Failure, amount, counted};
use contract::{Input, Output};
use fields::Members;
use glam::DVec3;
use scene::{Bounds, Camera, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Stage};

use cameras::CameraFormat;
use coordinates::Coordinates;
pub use coordinates::{ExportOffset, OFFSET_FILE};
use lattice::Lattice;
use mesh::Mesh;
use seen::SeenView;
use surfel::Surfel;

/// Name of the summary in the artifact.
pub const EXPORT_FILE: &str = "export.json";

/// Pixels of all rendered views together, unless `size` is given.
const MOST_PIXELS: f64 = 16e6;
/// Size of the rendered views over the cameras': a supersampled field has more than these show.
const MOST_SCALE: f64 = 2.0;

/// Bytes per place of the lattice: a distance.
const BYTES_PER_PLACE: u64 = size_of::<f32>() as u64;
/// Remedy for short memory, as a sentence fragment.
const REMEDY: &str = "choose a smaller resolution or size, or end other programs";

/// Parameters of `export`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Writes points with normals and colours, `points.ply`.
    pub points: bool,
    /// Writes 3D Gaussians, `splats.ply`.
    pub splats: bool,
    /// Writes a mesh with vertex colours, `mesh.glb`.
    pub mesh: bool,
    /// Writes the cameras as `transforms.json` and as COLMAP's text files.
    pub cameras: bool,
    /// Width at which the field is rendered from each camera. Default: twice the cameras' own, or
    /// less where all views together would have more than 16 million pixels.
    #[schemars(range(min = 1, max = 65536), extend("x-default" = "by cameras"))]
    pub size: Option<u32>,
    /// Maximum number of points and of splats.
    #[schemars(range(min = 1, max = 20_000_000))]
    pub max_points: u32,
    /// Cells of the mesh's grid along the longest side of the field's box, or in NDC of its
    /// frustum.
    #[schemars(range(min = 8, max = 1024))]
    pub resolution: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            points: true,
            splats: true,
            mesh: true,
            cameras: true,
            size: None,
            max_points: 500_000,
            resolution: 256,
        }
    }
}

/// `export.json`: what was written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ExportSummary {
    /// What coordinates in all files are.
    pub coordinates: String,
    /// Number of cameras.
    pub cameras: usize,
    /// Number of points in `points.ply`; 0 without this file.
    pub points: usize,
    /// Number of Gaussians in `splats.ply`; 0 without this file.
    pub splats: usize,
    /// Number of vertices in `mesh.glb`; 0 without this file.
    pub vertices: usize,
    /// Number of triangles in `mesh.glb`; 0 without this file.
    pub triangles: usize,
}

/// The stage.
pub struct Export;

impl Stage for Export {
    type Params = Params;
    const NAME: &'static str = "export";
    const SUMMARY: &'static str =
        "Writes a field as points, Gaussian splats, mesh and cameras that other programs open.";
    const ENVIRONMENT: &'static [&'static str] = fields::ENVIRONMENT;

    fn inputs() -> Vec<(&'static str, Input)> {
        let cameras = ["scene/cameras", "scene/truth", "scene/train", "cameras", "views"];
        vec![
            ("field", Input::required(&["field"], "a trained field")),
            ("cameras", Input::required(&cameras, "folder with views.json: the training cameras")),
        ]
    }

    fn output() -> Output {
        Output::kind("export")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        if !(params.points || params.splats || params.mesh || params.cameras) {
            let message = "nothing is to be written; set points, splats, mesh or cameras to true";
            return Err(Failure::Usage(message.to_owned()).into());
        }
        let field = Members::read(context.input("field")?, &context.device)?;
        let given = Views::read(context.input("cameras")?)?;
        let cameras: Vec<Camera> = given.views.into_iter().map(|view| view.camera).collect();
        for note in lens_notes(&cameras, params) {
            context.say(note);
        }
        let coordinates = Coordinates::of(&field.file.bounds);
        let bounds = field.file.bounds.moved(-coordinates.offset);
        let resized = resized(&cameras, params.size);
        let lattice = params.mesh.then(|| Lattice::new(&bounds, params.resolution));
        context.check_memory("the export", memory_need(&resized, lattice.as_ref()), REMEDY)?;
        let mut views = render(context, &field, &resized, coordinates.offset)?;
        let progress = context.progress("comparing", views.len() as u64);
        consensus::agree(&mut views, &progress);
        let job = ExportJob { context, params, field, cameras, views, coordinates, bounds };
        let mut summary = ExportSummary {
            coordinates: coordinates.to_string(),
            cameras: job.cameras.len(),
            points: 0,
            splats: 0,
            vertices: 0,
            triangles: 0,
        };
        job.write_surfels(&mut summary)?;
        if let Some(lattice) = &lattice {
            context.check_interrupt()?;
            job.write_mesh(lattice, &mut summary)?;
        }
        job.write_offset()?;
        context.write_json(EXPORT_FILE, &summary)?;
        context.write_summary(&in_words(&summary))
    }
}

/// Describes what files won't hold of the cameras' lenses, a line each.
fn lens_notes(cameras: &[Camera], params: &Params) -> Vec<&'static str> {
    let mut notes = Vec::new();
    let is_fisheye = |camera: &Camera| camera.intrinsics.distortion.is_fisheye();
    if (params.points || params.splats || params.mesh) && cameras.iter().any(is_fisheye) {
        notes.push(
            "fisheye lenses: points, splats and mesh hold what pinhole cameras in their place see, \
            at most 100° across",
        );
    }
    if params.cameras {
        let formats = [CameraFormat::Transforms, CameraFormat::Colmap];
        notes.extend(formats.into_iter().filter_map(|format| format.problem(cameras)));
    }
    notes
}

fn in_words(summary: &ExportSummary) -> String {
    let counts =
        [(summary.points, "points"), (summary.splats, "splats"), (summary.triangles, "triangles")];
    let counts = counts.into_iter().filter(|(count, _)| *count > 0);
    let mut words: Vec<String> =
        counts.map(|(count, what)| format!("{} {what}", amount(count as u64))).collect();
    words.push(counted(summary.cameras, "camera"));
    words.join(", ")
}

/// Cameras at the size at which the field is rendered.
fn resized(cameras: &[Camera], width: Option<u32>) -> Vec<Camera> {
    let pixels = |c: &Camera| f64::from(c.intrinsics.width) * f64::from(c.intrinsics.height);
    let most = (MOST_PIXELS / cameras.iter().map(pixels).sum::<f64>()).sqrt().min(MOST_SCALE);
    let mut resized = Vec::with_capacity(cameras.len());
    for camera in cameras {
        let k = &camera.intrinsics;
        let scale = width.map_or(most, |width| f64::from(width) / f64::from(k.width));
        let side = |pixels: u32| (scale * f64::from(pixels)).round().max(1.0) as u32;
        resized.push(camera.resized(side(k.width), side(k.height)));
    }
    resized
}

fn pixel_count(camera: &Camera) -> u64 {
    u64::from(camera.intrinsics.width) * u64::from(camera.intrinsics.height)
}

/// Renders the field from every camera, in the frame whose origin in the world is `offset`.
fn render(
    context: &Context,
    field: &Members,
    cameras: &[Camera],
    offset: DVec3,
) -> anyhow::Result<Vec<SeenView>> {
    let progress = context.progress("rendering", cameras.iter().map(pixel_count).sum());
    let mut views = Vec::with_capacity(cameras.len());
    for camera in cameras {
        context.check_interrupt()?;
        let background = field.file.background;
        views.push(SeenView::render(field, camera, background, offset, &progress)?);
    }
    Ok(views)
}

/// Maximum bytes that an export needs: all pixels, together with either the samples that are merged
/// or the mesh's lattice.
fn memory_need(cameras: &[Camera], lattice: Option<&Lattice>) -> u64 {
    let pixels: u64 = cameras.iter().map(pixel_count).sum();
    let values = lattice.map_or(0, |lattice| BYTES_PER_PLACE * lattice.len() as u64);
    SeenView::BYTES_PER_PIXEL * pixels + values.max(surfel::BYTES_PER_PIXEL * pixels)
}

struct ExportJob<'a> {
    context: &'a Context,
    params: &'a Params,
    field: Members,
    cameras: Vec<Camera>,
    views: Vec<SeenView>,
    coordinates: Coordinates,
    /// Bounds of the field, in the frame of the exported files.
    bounds: Bounds,
}

impl ExportJob<'_> {
    /// Points, splats and cameras.
    fn write_surfels(&self, summary: &mut ExportSummary) -> anyhow::Result<()> {
        let most = self.params.max_points as usize;
        let surfels = surfel::merge(&self.views, &self.bounds, most);
        if surfels.is_empty() {
            return Err(no_surface());
        }
        let chosen = points::chosen(&surfels);
        if self.params.points {
            self.write("points.ply", |file| points::write(file, &chosen, &self.coordinates))?;
            summary.points = chosen.len();
        }
        if self.params.splats {
            self.write("splats.ply", |file| splats::write(file, &surfels, &self.coordinates))?;
            summary.splats = surfels.len();
        }
        if self.params.cameras {
            self.write_cameras(&chosen)?;
        }
        Ok(())
    }

    /// Writes the cameras in each format that can hold them.
    fn write_cameras(&self, points: &[Surfel]) -> anyhow::Result<()> {
        if CameraFormat::Transforms.problem(&self.cameras).is_none() {
            // Programs take the cameras and this file to have one frame.
            let is_same_frame = self.params.points && !self.coordinates.is_moved();
            let points = is_same_frame.then_some("points.ply");
            let file = cameras::transforms(&self.cameras, points);
            self.context.write_json("transforms.json", &file)?;
        }
        if CameraFormat::Colmap.problem(&self.cameras).is_none() {
            for (name, text) in cameras::colmap(&self.cameras, points, self.coordinates.offset) {
                self.write(&format!("colmap/sparse/0/{name}"), |file| {
                    file.write_all(text.as_bytes())
                })?;
            }
        }
        Ok(())
    }

    fn write_mesh(&self, lattice: &Lattice, summary: &mut ExportSummary) -> anyhow::Result<()> {
        let mut mesh = self.surface(lattice);
        mesh.find_normals();
        unseen::drop_unseen(&self.views, lattice, &mut mesh);
        mesh.drop_small_pieces();
        mesh.find_normals();
        if mesh.triangles.is_empty() {
            return Err(no_surface());
        }
        let offset = self.coordinates.offset;
        let colours = colour::colours(&self.field, &self.views, &mesh, lattice, offset)?;
        self.write("mesh.glb", |file| glb::write(file, &mesh, &colours, &self.coordinates))?;
        (summary.vertices, summary.triangles) = (mesh.positions.len(), mesh.triangles.len());
        Ok(())
    }

    /// Extracts the surface that the views see, through a lattice of distances from it.
    fn surface(&self, lattice: &Lattice) -> Mesh {
        let [_, ny, nz] = lattice.counts;
        let progress = self.context.progress("fusing", (ny * nz) as u64);
        let values = fusion::fuse(&self.views, lattice, &progress);
        let progress = self.context.progress("meshing", nz as u64 - 1);
        surface_nets::extract(lattice, &values, &progress)
    }

    /// Writes the offset that files with single precision lack, if they lack one, and says so.
    fn write_offset(&self) -> anyhow::Result<()> {
        let Params { points, splats, mesh, .. } = *self.params;
        let offset = self.coordinates.file([points, splats, mesh]);
        if !self.coordinates.is_moved() || offset.files.is_empty() {
            return Ok(());
        }
        let ([x, y, z], files) = (offset.offset, offset.files.join(", "));
        self.context.say(format!(
            "the scene is far from the origin: coordinates of {files} lack the offset ({x}, {y}, \
            {z}), which is in {OFFSET_FILE}"
        ));
        self.context.write_json(OFFSET_FILE, &offset)
    }

    /// Writes a file of the output.
    fn write(
        &self,
        file: &str,
        write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
    ) -> anyhow::Result<()> {
        let path = self.context.output_path(file)?;
        File::create(&path)
            .map(BufWriter::new)
            .and_then(|mut out| {
                write(&mut out)?;
                out.flush()
            })
            .with_context(|| format!("cannot write {}", path.display()))
    }
}

fn no_surface() -> anyhow::Error {
    let message = "input field: no camera sees a surface inside its bounds; train it longer";
    Failure::BadInput(message.to_owned()).into()
}

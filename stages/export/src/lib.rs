//! `export`: a trained field in files that other programs open.
//!
//! The field is rendered from the training cameras; all files are derived from the surfaces in
//! these views (design note 043).
//!
//! * `points.ply`: coloured points with normals.
//! * `splats.ply`: 3D Gaussians in the layout of 3DGS viewers.
//! * `mesh.glb`, `mesh.ply`: triangles with vertex colours, by fusing the views' depth.
//! * `transforms.json`, `colmap/sparse/0/`: the cameras for instant-ngp, nerfstudio and COLMAP.
//! * [`EXPORT_FILE`]: counts, and a description of the coordinates.
//! * [`OFFSET_FILE`]: for scenes far from the origin, the offset of points, splats and mesh.
//!
//! Coordinates, scale and orientation are those of the input cameras, which `prep` copies from the
//! data set. Points, splats and mesh have single precision; if that is too coarse, their
//! coordinates are relative to an offset ([`coordinates`]). Camera axes are OpenGL's (x right, y
//! up, looking along -z) in `transforms.json`, and COLMAP's (x right, y down, looking along z) in
//! its model.
//!
//! A second program, [`CopyFiles`], copies artifacts such as these to the folder of pages.

mod cameras;
mod colour;
mod consensus;
mod coordinates;
mod copy;
mod fusion;
mod glb;
mod lattice;
mod mesh;
mod ply;
mod surface_nets;
mod surface_view;
mod surfel;
#[cfg(test)]
mod tests;

use std::fs::File;
use std::io::{self, BufWriter, Write as _};

use anyhow::Context as _;
use artifact::{Failure, format_amount, format_count};
use fields::FieldArtifact;
use glam::DVec3;
use scene::{Bounds, Camera, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Stage};
use workload::{export_bytes, export_scale};

use cameras::CameraFormat;
use coordinates::Coordinates;
pub use coordinates::{ExportOffset, OFFSET_FILE};
pub use copy::CopyFiles;
use lattice::Lattice;
use mesh::Mesh;
use surface_view::SurfaceView;
use surfel::Surfel;

/// Name of the summary in the artifact.
pub const EXPORT_FILE: &str = "export.json";

/// Remedy for short memory, as a sentence fragment.
const REMEDY: &str = "choose a smaller resolution or size, or end other programs";

/// Parameters of `export`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Writes a mesh with vertex colours: `mesh.glb`, with an unlit material, and `mesh.ply`.
    pub mesh: bool,
    /// Width in pixels at which the field is rendered from each camera. Default: twice the cameras'
    /// width, or less if all views together would have more than 16 million pixels.
    #[schemars(range(min = 1, max = 65536), extend("x-default" = "by cameras"))]
    pub size: Option<u32>,
    /// Maximum number of points and of splats.
    #[schemars(range(min = 1, max = 20_000_000))]
    pub max_points: u32,
    /// Number of cells of the mesh's grid along the longest side of the field's box or NDC frustum.
    #[schemars(range(min = 8, max = 1024))]
    pub resolution: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self { mesh: true, size: None, max_points: 500_000, resolution: 256 }
    }
}

/// Content of `export.json`: summary of the written files.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ExportSummary {
    /// Description of the coordinates in all files.
    pub coordinates: String,
    /// Number of cameras.
    pub cameras: usize,
    /// Number of points in `points.ply`.
    pub points: usize,
    /// Number of Gaussians in `splats.ply`.
    pub splats: usize,
    /// Number of vertices in `mesh.glb` and `mesh.ply`; 0 without these files.
    pub vertices: usize,
    /// Number of triangles in `mesh.glb` and `mesh.ply`; 0 without these files.
    pub triangles: usize,
}

/// The stage.
pub struct Export;

impl Stage for Export {
    type Params = Params;
    const NAME: &'static str = "export";
    const SUMMARY: &'static str =
        "Writes a field as points, Gaussian splats, mesh and cameras that other programs open.";
    const LIBTORCH: bool = cfg!(feature = "torch");
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
        let field = FieldArtifact::read(context.input("field")?, &context.device)?;
        let views = Views::read(context.input("cameras")?)?;
        let cameras: Vec<Camera> = views.views.into_iter().map(|view| view.camera).collect();
        for note in lens_notes(&cameras) {
            context.log_line(note);
        }
        let coordinates = Coordinates::new(&field.file.bounds);
        let bounds = field.file.bounds.moved(-coordinates.offset);
        let resized = resize_cameras(&cameras, params.size);
        let lattice = params.mesh.then(|| Lattice::new(&bounds, params.resolution));
        context.check_memory("the export", memory_need(&resized, lattice.as_ref()), REMEDY)?;
        let mut views = render_views(context, &field, &resized, coordinates.offset)?;
        let progress = context.progress("comparing", views.len() as u64);
        consensus::apply_consensus(&mut views, &progress);
        let job = ExportJob { context, params, field, cameras, views, coordinates, bounds };
        let mut summary = ExportSummary {
            coordinates: coordinates.to_string(),
            cameras: job.cameras.len(),
            ..ExportSummary::default()
        };
        job.write_points_splats_and_cameras(&mut summary)?;
        if let Some(lattice) = &lattice {
            context.check_interrupt()?;
            job.write_mesh(lattice, &mut summary)?;
        }
        job.write_offset()?;
        context.write_json(EXPORT_FILE, &summary)?;
        context.write_summary(&summary_text(&summary))
    }
}

/// Returns notes on lenses that files can't describe, a line each.
fn lens_notes(cameras: &[Camera]) -> Vec<&'static str> {
    let mut notes = Vec::new();
    let is_fisheye = |camera: &Camera| camera.intrinsics.distortion.is_fisheye();
    if cameras.iter().any(is_fisheye) {
        notes.push(
            "fisheye lenses: points, splats and mesh cover only the field of view of pinhole \
            cameras, at most 100°",
        );
    }
    let formats = [CameraFormat::Transforms, CameraFormat::Colmap];
    notes.extend(formats.into_iter().filter_map(|format| format.lens_problem(cameras)));
    notes
}

/// Formats the summary as one line.
fn summary_text(summary: &ExportSummary) -> String {
    let ExportSummary { points, splats, triangles, .. } = *summary;
    let mut parts = Vec::new();
    for (count, noun) in [(points, "points"), (splats, "splats"), (triangles, "triangles")] {
        if count > 0 {
            parts.push(format!("{} {noun}", format_amount(count as u64)));
        }
    }
    parts.push(format_count(summary.cameras, "camera"));
    parts.join(", ")
}

/// Resizes cameras to `width`, or to the default size at which the field is rendered.
fn resize_cameras(cameras: &[Camera], width: Option<u32>) -> Vec<Camera> {
    let default_scale = export_scale(cameras.iter().map(pixel_count).sum());
    let mut resized = Vec::with_capacity(cameras.len());
    for camera in cameras {
        let k = &camera.intrinsics;
        let scale = width.map_or(default_scale, |width| f64::from(width) / f64::from(k.width));
        let [width, height] =
            [k.width, k.height].map(|side| (scale * f64::from(side)).round().max(1.0) as u32);
        resized.push(camera.resized(width, height));
    }
    resized
}

/// Returns the number of a camera's pixels.
fn pixel_count(camera: &Camera) -> u64 {
    u64::from(camera.intrinsics.width) * u64::from(camera.intrinsics.height)
}

/// Renders the field from every camera, in the frame whose origin in the world is `offset`.
fn render_views(
    context: &Context,
    field: &FieldArtifact,
    cameras: &[Camera],
    offset: DVec3,
) -> anyhow::Result<Vec<SurfaceView>> {
    let progress = context.progress("rendering", cameras.iter().map(pixel_count).sum());
    let mut views = Vec::with_capacity(cameras.len());
    for camera in cameras {
        context.check_interrupt()?;
        let background = field.file.background;
        views.push(SurfaceView::render(field, camera, background, offset, &progress)?);
    }
    Ok(views)
}

/// Returns the peak memory of an export in bytes.
fn memory_need(cameras: &[Camera], lattice: Option<&Lattice>) -> u64 {
    let pixels = cameras.iter().map(pixel_count).sum();
    export_bytes(pixels, lattice.map_or(0, |lattice| lattice.len() as u64))
}

/// Inputs and rendered views of an export.
struct ExportJob<'a> {
    context: &'a Context,
    params: &'a Params,
    field: FieldArtifact,
    cameras: Vec<Camera>,
    views: Vec<SurfaceView>,
    coordinates: Coordinates,
    /// Bounds of the field, in the frame of the exported files.
    bounds: Bounds,
}

impl ExportJob<'_> {
    /// Writes points, splats and cameras.
    fn write_points_splats_and_cameras(&self, summary: &mut ExportSummary) -> anyhow::Result<()> {
        let max_surfels = self.params.max_points as usize;
        let surfels = surfel::merge(&self.views, &self.bounds, max_surfels);
        if surfels.is_empty() {
            return Err(no_surface());
        }
        let points = ply::select_points(&surfels);
        self.write("points.ply", |file| ply::write_points(file, &points, &self.coordinates))?;
        summary.points = points.len();
        self.write("splats.ply", |file| ply::write_splats(file, &surfels, &self.coordinates))?;
        summary.splats = surfels.len();
        self.write_cameras(&points)
    }

    /// Writes the cameras in each format that supports their lenses.
    fn write_cameras(&self, points: &[Surfel]) -> anyhow::Result<()> {
        if CameraFormat::Transforms.lens_problem(&self.cameras).is_none() {
            // Programs assume that the cameras and this file have the same frame.
            let points_file = (!self.coordinates.is_moved()).then_some("points.ply");
            let file = cameras::transforms_json(&self.cameras, points_file);
            self.context.write_json("transforms.json", &file)?;
        }
        if CameraFormat::Colmap.lens_problem(&self.cameras).is_none() {
            let files = cameras::colmap_files(&self.cameras, points, self.coordinates.offset);
            for (name, text) in files {
                self.write(&format!("colmap/sparse/0/{name}"), |file| {
                    file.write_all(text.as_bytes())
                })?;
            }
        }
        Ok(())
    }

    /// Writes the mesh.
    fn write_mesh(&self, lattice: &Lattice, summary: &mut ExportSummary) -> anyhow::Result<()> {
        let mut mesh = self.fused_mesh(lattice);
        mesh.compute_normals();
        fusion::remove_unseen(&self.views, lattice, &mut mesh);
        mesh.remove_small_components();
        mesh.compute_normals();
        if mesh.triangles.is_empty() {
            return Err(no_surface());
        }
        let offset = self.coordinates.offset;
        let colours = colour::vertex_colours(&self.field, &self.views, &mesh, lattice, offset)?;
        self.write("mesh.glb", |file| glb::write(file, &mesh, &colours, &self.coordinates))?;
        self.write("mesh.ply", |file| ply::write_mesh(file, &mesh, &colours, &self.coordinates))?;
        summary.vertices = mesh.positions.len();
        summary.triangles = mesh.triangles.len();
        Ok(())
    }

    /// Fuses the views' depth and extracts the surface.
    fn fused_mesh(&self, lattice: &Lattice) -> Mesh {
        let [_, ny, nz] = lattice.counts;
        let progress = self.context.progress("fusing", (ny * nz) as u64);
        let values = fusion::fuse(&self.views, lattice, &progress);
        let progress = self.context.progress("meshing", nz as u64 - 1);
        surface_nets::extract(lattice, &values, &progress)
    }

    /// Writes and logs the offset of files with single precision, if there is one.
    fn write_offset(&self) -> anyhow::Result<()> {
        if !self.coordinates.is_moved() {
            return Ok(());
        }
        let offset = self.coordinates.offset_file(self.params.mesh);
        let ([x, y, z], files) = (offset.offset, offset.files.join(", "));
        self.context.log_line(format!(
            "the scene is far from the origin: coordinates of {files} lack the offset ({x}, {y}, \
            {z}); add the offset, also in {OFFSET_FILE}, to get the input's coordinates"
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

/// Returns the failure of a field without a visible surface.
fn no_surface() -> anyhow::Error {
    let message =
        "input field: no surface inside the bounds is visible from any camera; train longer";
    Failure::BadInput(message.to_owned()).into()
}

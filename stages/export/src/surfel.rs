use glam::DVec3;
use rayon::prelude::*;
use scene::Bounds;

use crate::surface_view::SurfaceView;

/// Small piece of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Surfel {
    /// Centre in scene units, in the frame of the exported files.
    pub(crate) position: DVec3,
    /// Unit normal, towards the cameras that observe the surfel.
    pub(crate) normal: DVec3,
    /// Distance to the nearest silhouette in pixels: the maximum over views.
    pub(crate) margin: u8,
    /// Display-encoded sRGB: the mean over views.
    pub(crate) colour: [f32; 3],
    /// Opacity: the mean over the pixels of the surfel.
    pub(crate) opacity: f32,
    /// Approximate distance to the neighbours in scene units.
    pub(crate) spacing: f64,
}

/// Surface pixel: cell of its point, then indices of view and pixel, which make the order unique.
type Sample = ([u32; 3], u32, u32);
// Estimates before a run rely on this size.
const _: () = assert!(size_of::<Sample>() as u64 == workload::SURFEL_SAMPLE_BYTES);

/// Merges the surface pixels of all views into one surfel per cell of a grid over the field's unit
/// cube. Cells are half the median width of surface pixels, or wider to limit the number of
/// surfels to `max_surfels` (design note 043). Surfels are sorted by cell.
pub(crate) fn merge(views: &[SurfaceView], bounds: &Bounds, max_surfels: usize) -> Vec<Surfel> {
    let mut edge = finest_edge(views, bounds);
    loop {
        let samples = collect_samples(views, bounds, edge);
        let groups: Vec<&[Sample]> = samples.chunk_by(|a, b| a.0 == b.0).collect();
        if groups.len() <= max_surfels {
            return groups
                .par_iter()
                .filter_map(|group| mean_surfel(views, bounds, edge, group))
                .collect();
        }
        // A surface's number of cells falls with the square of their edge. The margin of 1 % is
        // chosen by hand.
        edge *= (groups.len() as f64 / max_surfels as f64).sqrt() * 1.01;
    }
}

/// Returns half of the median width of all surface pixels, relative to the cube's side; at least
/// 1e-6, chosen by hand.
fn finest_edge(views: &[SurfaceView], bounds: &Bounds) -> f64 {
    let mut widths: Vec<f64> = views
        .par_iter()
        .flat_map_iter(|view| {
            view.surface_pixels()
                .map(|(index, _)| view.pixel_width(index) * cube_scale(view, bounds, index))
        })
        .filter(|width| width.is_finite() && *width > 0.0)
        .collect();
    widths.par_sort_unstable_by(f64::total_cmp);
    widths.get(widths.len() / 2).map_or(1.0, |width| 0.5 * width).max(1e-6)
}

/// Returns the scale from scene units to the unit cube at a pixel's point.
fn cube_scale(view: &SurfaceView, bounds: &Bounds, index: usize) -> f64 {
    let (point, width) = (view.world_point(index), view.pixel_width(index));
    (bounds.to_cube(point + width * view.axes.x_axis) - bounds.to_cube(point)).length() / width
}

/// Collects all surface pixels inside the cube, sorted.
fn collect_samples(views: &[SurfaceView], bounds: &Bounds, edge: f64) -> Vec<Sample> {
    let mut samples: Vec<Sample> = views
        .par_iter()
        .enumerate()
        .flat_map_iter(|(view_index, view)| {
            view.surface_pixels().filter_map(move |(index, _)| {
                let point = bounds.to_cube(view.world_point(index));
                let is_inside = point.cmpge(DVec3::ZERO).all() && point.cmple(DVec3::ONE).all();
                let cell = (point / edge).to_array().map(|x| x as u32);
                is_inside.then_some((cell, view_index as u32, index as u32))
            })
        })
        .collect();
    samples.par_sort_unstable();
    samples
}

/// Returns a cell's surfel: the mean of the cell's pixels, weighted by pixel density on the surface
/// and viewing angle, whose cosine counts as at least 0.05, chosen by hand. `None` if all pixels
/// are at silhouettes, or if the normals cancel.
fn mean_surfel(
    views: &[SurfaceView],
    bounds: &Bounds,
    edge: f64,
    group: &[Sample],
) -> Option<Surfel> {
    // Silhouettes are accurate only to a pixel, so a cell with silhouette pixels alone is dropped.
    let margins = group.iter().map(|&(_, view, i)| views[view as usize].pixels[i as usize].margin);
    let margin = margins.max().filter(|margin| *margin > 0)?;
    let (mut position, mut normal, mut colour) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
    let (mut opacity, mut width_sum, mut cell_width_sum, mut weights) = (0.0, 0.0, 0.0, 0.0);
    for &(_, view_index, index) in group {
        let (view, index) = (&views[view_index as usize], index as usize);
        let pixel = &view.pixels[index];
        let width = view.pixel_width(index);
        let weight = f64::from(view.cosine(index)).max(0.05).powi(2) / (width * width);
        position += weight * view.world_point(index);
        normal += weight * view.world_normal(index);
        colour += weight * DVec3::from(pixel.colour.map(f64::from));
        opacity += weight * f64::from(pixel.opacity);
        width_sum += weight * width;
        cell_width_sum += weight * edge / cube_scale(view, bounds, index);
        weights += weight;
    }
    // The normals of both sides of a thin object in one cell may cancel.
    let normal = normal.try_normalize()?;
    let scale = 1.0 / (255.0 * weights);
    Some(Surfel {
        position: position / weights,
        normal,
        margin,
        colour: (colour * scale).as_vec3().to_array(),
        opacity: (opacity * scale) as f32,
        spacing: (cell_width_sum / weights).max(width_sum / weights / (group.len() as f64).sqrt()),
    })
}

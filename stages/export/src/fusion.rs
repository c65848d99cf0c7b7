use glam::DVec3;
use rayon::prelude::*;
use stage::Progress;

use crate::lattice::Lattice;
use crate::mesh::Mesh;
use crate::surface_view::{PointState, SurfaceView};

/// Truncation distance of signed distances in lattice spacings: more than noise, less than thin
/// objects (design note 043).
const TRUNCATION_SPACINGS: f64 = 2.5;
/// Maximum distance along the surface between a vertex and a pixel's point, in pixel widths: about
/// half of a pixel's diagonal. The limit is at least a cell's width, the accuracy of a mesh.
const MAX_PIXEL_DISTANCE: f64 = 0.75;
/// Minimum cosine between a vertex's normal and a view's normal at which the view observes the
/// vertex's side of the surface; chosen by hand.
const MIN_OBSERVED_SIDE_COSINE: f64 = 0.3;
/// Number of rows of triangles that are removed next to unseen parts (design note 043).
const UNCERTAIN_ROWS: usize = 3;

/// Fuses the views' signed distances from the surface at a lattice's nodes (Curless and Levoy
/// 1996), as fractions of the truncation distance: below 0 inside, 1 in empty space, NaN if no view
/// observes the node.
pub(crate) fn fuse(views: &[SurfaceView], lattice: &Lattice, progress: &Progress) -> Vec<f32> {
    let [nx, ny, _] = lattice.counts;
    let bounds = surface_bounds(views);
    let mut values = vec![f32::NAN; lattice.len()];
    values.par_chunks_mut(nx).enumerate().for_each(|(row, values)| {
        for (i, value) in values.iter_mut().enumerate() {
            *value = fused_distance(views, bounds, lattice, [i, row % ny, row / ny]);
        }
        progress.add(1);
    });
    values
}

/// Returns the truncation distance at lattice coordinates, in scene units.
pub(crate) fn truncation_distance(lattice: &Lattice, lattice_position: [f64; 3]) -> f32 {
    (TRUNCATION_SPACINGS * lattice.spacing_at(lattice_position)) as f32
}

/// Returns the bounding box of all observed surfaces: min, max.
fn surface_bounds(views: &[SurfaceView]) -> [DVec3; 2] {
    let points =
        views.iter().flat_map(|v| v.surface_pixels().map(|(index, _)| v.world_point(index)));
    let empty = [DVec3::INFINITY, DVec3::NEG_INFINITY];
    points.fold(empty, |[min, max], point| [min.min(point), max.max(point)])
}

/// Returns the fused signed distance at a node.
fn fused_distance(
    views: &[SurfaceView],
    [min, max]: [DVec3; 2],
    lattice: &Lattice,
    node: [usize; 3],
) -> f32 {
    let lattice_position = node.map(|i| i as f64);
    let point = lattice.to_world(lattice_position);
    let truncation = truncation_distance(lattice, lattice_position);
    // Chosen by hand. Surfaces farther away are ignored, also slanted ones, near which
    // `point_state` accepts larger differences in depth.
    let margin = DVec3::splat(2.0 * f64::from(truncation));
    if point.cmplt(min - margin).any() || point.cmpgt(max + margin).any() {
        // No surface is near, so one view suffices.
        let is_empty =
            views.iter().any(|view| view.point_state(point, truncation) == PointState::Empty);
        return if is_empty { 1.0 } else { f32::NAN };
    }
    let (mut sum, mut weights) = (0.0, 0.0);
    for view in views {
        let (value, weight) = match view.point_state(point, truncation) {
            PointState::Hidden => continue,
            PointState::Empty => (1.0, 1.0),
            // The weight falls to 0 behind a surface, since thin objects have another side there.
            PointState::Surface { distance, cosine, .. } => {
                let value = distance / truncation;
                (value, cosine.max(0.0) * (1.0 + value).min(1.0))
            }
        };
        sum += value * weight;
        weights += weight;
    }
    if weights > 0.0 { sum / weights } else { f32::NAN }
}

/// Removes triangles with a vertex that no view observes, and a few rows of triangles next to them.
/// A fused surface extends a little beyond its edges, where only pixels at grazing angles support
/// it.
pub(crate) fn remove_unseen(views: &[SurfaceView], lattice: &Lattice, mesh: &mut Mesh) {
    let is_seen: Vec<bool> = (0..mesh.positions.len())
        .into_par_iter()
        .map(|vertex| {
            let position = mesh.positions[vertex].as_dvec3();
            let normal = mesh.normals[vertex].as_dvec3();
            let lattice_position = lattice.to_lattice(position);
            let truncation = truncation_distance(lattice, lattice_position);
            let cell = lattice.spacing_at(lattice_position);
            views.iter().any(|view| is_observed(view, (position, normal), truncation, cell))
        })
        .collect();
    mesh.triangles.retain(|triangle| triangle.iter().all(|&vertex| is_seen[vertex as usize]));
    for _ in 0..UNCERTAIN_ROWS {
        remove_boundary(mesh);
    }
}

/// Removes the triangles at a mesh's boundary: those with a vertex on an edge of a single triangle.
fn remove_boundary(mesh: &mut Mesh) {
    let mut is_boundary = vec![false; mesh.positions.len()];
    for vertex in mesh.boundary_edges().into_iter().flatten() {
        is_boundary[vertex as usize] = true;
    }
    mesh.triangles.retain(|triangle| triangle.iter().all(|&vertex| !is_boundary[vertex as usize]));
}

/// Returns whether a view observes a vertex, given by position and normal.
fn is_observed(
    view: &SurfaceView,
    (position, normal): (DVec3, DVec3),
    truncation: f32,
    cell: f64,
) -> bool {
    let PointState::Surface { index, .. } = view.point_state(position, truncation) else {
        return false;
    };
    let observed_normal = view.world_normal(index);
    let offset = position - view.world_point(index);
    let tangential = offset - offset.dot(observed_normal) * observed_normal;
    observed_normal.dot(normal) > MIN_OBSERVED_SIDE_COSINE
        && tangential.length() <= cell.max(MAX_PIXEL_DISTANCE * view.pixel_width(index))
}

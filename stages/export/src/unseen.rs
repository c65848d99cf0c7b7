use glam::DVec3;
use rayon::prelude::*;

use crate::fusion;
use crate::lattice::Lattice;
use crate::mesh::Mesh;
use crate::seen::{SeenView, Sight};

/// A pixel shows what is at most so many pixel widths from its middle on the surface: about half a
/// pixel's diagonal, seen straight. A mesh isn't known better than to a cell's width.
const NEAR_PIXELS: f64 = 0.75;
/// A view shows a vertex's side of a surface where the cosine between the vertex's normal and the
/// one that the view sees is larger.
const SHOWN_SIDE_COSINE: f64 = 0.3;

/// Where a surface ends at what no view shows, so many rows of triangles aren't known well.
const UNSURE_ROWS: usize = 3;

/// Drops triangles with a vertex that no view shows, and the last rows before them. A fused surface
/// extends a little beyond its edges, where only pixels seen at a grazing angle support it.
pub(crate) fn drop_unseen(views: &[SeenView], lattice: &Lattice, mesh: &mut Mesh) {
    let vertices = mesh.positions.par_iter().zip(&mesh.normals);
    let is_shown: Vec<bool> = vertices
        .map(|(position, normal)| {
            let (position, normal) = (position.as_dvec3(), normal.as_dvec3());
            let place = lattice.place(position);
            let (reach, cell) = (fusion::reach(lattice, place), lattice.spacing_at(place));
            views.iter().any(|view| shows(view, (position, normal), reach, cell))
        })
        .collect();
    mesh.triangles.retain(|triangle| triangle.iter().all(|&vertex| is_shown[vertex as usize]));
    (0..UNSURE_ROWS).for_each(|_| drop_border(mesh));
}

/// Drops the triangles at a mesh's border: those with a vertex on an edge of one triangle alone.
fn drop_border(mesh: &mut Mesh) {
    let mut is_border = vec![false; mesh.positions.len()];
    mesh.open_edges().iter().flatten().for_each(|&vertex| is_border[vertex as usize] = true);
    mesh.triangles.retain(|triangle| triangle.iter().all(|&vertex| !is_border[vertex as usize]));
}

fn shows(view: &SeenView, (position, normal): (DVec3, DVec3), reach: f32, cell: f64) -> bool {
    let Sight::Surface { index, .. } = view.look(position, reach) else { return false };
    let seen = view.world_normal(index);
    let off = position - view.world_point(index);
    let along = off - off.dot(seen) * seen;
    seen.dot(normal) > SHOWN_SIDE_COSINE
        && along.length() <= cell.max(NEAR_PIXELS * view.footprint(index))
}

use fields::{Members, rendering_failure};
use glam::{DVec3, Vec3};
use radiance::{Ray, RayField};
use rayon::prelude::*;

use crate::fusion;
use crate::lattice::Lattice;
use crate::mesh::Mesh;
use crate::seen::{SeenView, Sight};

/// Colours of a mesh's vertices, display-encoded sRGB. Each is the mean over the views that see a
/// vertex, more from those that see it not aslant. Where none does, the field's own colour along
/// the normal. `offset` is the world point that is the mesh's origin.
pub(crate) fn colours(
    field: &Members,
    views: &[SeenView],
    mesh: &Mesh,
    lattice: &Lattice,
    offset: DVec3,
) -> anyhow::Result<Vec<[f32; 3]>> {
    let seen: Vec<Option<[f32; 3]>> = (0..mesh.positions.len())
        .into_par_iter()
        .map(|vertex| mean_colour(views, mesh, vertex, reach(lattice, mesh.positions[vertex])))
        .collect();
    let unseen: Vec<usize> = (0..seen.len()).filter(|&vertex| seen[vertex].is_none()).collect();
    let background = [field.file.background.shown(); 3];
    let rays: Vec<Ray> = unseen
        .iter()
        .map(|&vertex| {
            let (position, normal) = (mesh.positions[vertex], mesh.normals[vertex]);
            let near = field.file.bounds.near + f64::from(reach(lattice, position));
            let normal = normal.as_dvec3();
            let origin = (offset + position.as_dvec3() + near * normal).to_array();
            Ray { origin, direction: (-normal).to_array(), background }
        })
        .collect();
    let rendered = field.render(&rays).map_err(rendering_failure)?;
    let mut colours: Vec<[f32; 3]> = seen.into_iter().map(Option::unwrap_or_default).collect();
    for (vertex, pixel) in unseen.into_iter().zip(rendered) {
        colours[vertex] = pixel.colour;
    }
    Ok(colours)
}

/// Distance within which a view sees a vertex.
fn reach(lattice: &Lattice, position: Vec3) -> f32 {
    fusion::reach(lattice, lattice.place(position.as_dvec3()))
}

fn mean_colour(views: &[SeenView], mesh: &Mesh, vertex: usize, reach: f32) -> Option<[f32; 3]> {
    let (position, normal) = (mesh.positions[vertex].as_dvec3(), mesh.normals[vertex].as_dvec3());
    let (mut sum, mut weights) = ([0.0; 3], 0.0);
    for view in views {
        let Sight::Surface { index, .. } = view.look(position, reach) else { continue };
        let towards = (view.centre() - position).normalize().dot(normal).max(0.0);
        let weight = (towards * towards) as f32;
        let colour = view.pixel(index).colour;
        sum = [0, 1, 2].map(|c| weight.mul_add(f32::from(colour[c]) / 255.0, sum[c]));
        weights += weight;
    }
    (weights > 1e-3).then(|| sum.map(|v| v / weights))
}

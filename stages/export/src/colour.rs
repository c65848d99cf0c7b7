use fields::{FieldArtifact, rendering_failure};
use glam::{DVec3, Vec3};
use radiance::{Ray, RayField};
use rayon::prelude::*;

use crate::fusion::truncation_distance;
use crate::lattice::Lattice;
use crate::mesh::Mesh;
use crate::surface_view::{PointState, SurfaceView};

/// Minimum total weight of the views that observe a vertex: a single view at 88.2° from the normal,
/// or more, has less. Chosen by hand.
const MIN_TOTAL_WEIGHT: f32 = 1e-3;

/// Returns the colours of a mesh's vertices, display-encoded sRGB: the mean over the views that
/// observe the vertex, weighted by the squared cosine between the vertex normal and the direction
/// to the camera. Other vertices, and those seen only at grazing angles, get the colour that the
/// field renders for a ray opposite to the normal. `offset` is the origin of the mesh's frame, in
/// the world.
pub(crate) fn vertex_colours(
    field: &FieldArtifact,
    views: &[SurfaceView],
    mesh: &Mesh,
    lattice: &Lattice,
    offset: DVec3,
) -> anyhow::Result<Vec<[f32; 3]>> {
    let observed: Vec<Option<[f32; 3]>> = (0..mesh.positions.len())
        .into_par_iter()
        .map(|vertex| mean_colour(views, mesh, lattice, vertex))
        .collect();
    let unseen: Vec<usize> = (0..observed.len()).filter(|&v| observed[v].is_none()).collect();
    let background = [field.file.background.grey_level(); 3];
    let rays: Vec<Ray> = unseen
        .iter()
        .map(|&vertex| {
            let (position, normal) = (mesh.positions[vertex], mesh.normals[vertex].as_dvec3());
            // Fields render beyond the distance `near`; the field's surface may be in front of the
            // vertex by the truncation distance.
            let distance = field.file.bounds.near + f64::from(truncation_at(lattice, position));
            let origin = (offset + position.as_dvec3() + distance * normal).to_array();
            Ray { origin, direction: (-normal).to_array(), background }
        })
        .collect();
    let rendered = field.render(&rays).map_err(rendering_failure)?;
    let mut colours: Vec<[f32; 3]> = observed.into_iter().map(Option::unwrap_or_default).collect();
    for (vertex, pixel) in unseen.into_iter().zip(rendered) {
        colours[vertex] = pixel.colour;
    }
    Ok(colours)
}

/// Returns the truncation distance at a point in the mesh's frame.
fn truncation_at(lattice: &Lattice, position: Vec3) -> f32 {
    truncation_distance(lattice, lattice.to_lattice(position.as_dvec3()))
}

/// Returns the mean colour over the views that observe a vertex, if their weights suffice.
fn mean_colour(
    views: &[SurfaceView],
    mesh: &Mesh,
    lattice: &Lattice,
    vertex: usize,
) -> Option<[f32; 3]> {
    let truncation = truncation_at(lattice, mesh.positions[vertex]);
    let (position, normal) = (mesh.positions[vertex].as_dvec3(), mesh.normals[vertex].as_dvec3());
    let (mut sum, mut weights) = ([0.0; 3], 0.0);
    for view in views {
        let PointState::Surface { index, .. } = view.point_state(position, truncation) else {
            continue;
        };
        let cosine = (view.centre - position).normalize().dot(normal).max(0.0);
        let weight = (cosine * cosine) as f32;
        let colour = view.pixels[index].colour;
        sum = [0, 1, 2].map(|c| weight.mul_add(f32::from(colour[c]) / 255.0, sum[c]));
        weights += weight;
    }
    (weights > MIN_TOTAL_WEIGHT).then(|| sum.map(|v| v / weights))
}

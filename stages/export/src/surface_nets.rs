use glam::{DVec3, Vec3};
use stage::Progress;

use crate::lattice::Lattice;
use crate::mesh::Mesh;

/// Extracts the surface that separates nodes with negative values (inside) from the others (naive
/// surface nets, Gibson 1998). Each cell that the surface crosses gets a vertex, at the mean of the
/// crossings with the cell's edges; each crossed edge gets a quad around it. NaN is unknown: the
/// surface has a hole there.
pub(crate) fn extract(lattice: &Lattice, values: &[f32], progress: &Progress) -> Mesh {
    let cells = Cells { lattice, values, strides: lattice.strides() };
    let mut mesh = Mesh::default();
    let [nx, ny, nz] = lattice.counts;
    // A quad connects cells of two neighbouring layers, so only two layers' vertices are stored.
    let mut vertices = vec![u32::MAX; 2 * nx * ny];
    let stored = vertices.len();
    for k in 0..nz - 1 {
        for j in 0..ny - 1 {
            for i in 0..nx - 1 {
                if let Some(position) = cells.vertex([i, j, k]) {
                    vertices[cells.index([i, j, k]) % stored] = mesh.positions.len() as u32;
                    mesh.positions.push(position);
                }
            }
        }
        for j in 0..ny {
            for i in 0..nx {
                for axis in 0..3 {
                    cells.add_quad([i, j, k], axis, &vertices, &mut mesh.triangles);
                }
            }
        }
        progress.add(1);
    }
    mesh
}

/// Cells of a lattice with values at its nodes.
struct Cells<'a> {
    lattice: &'a Lattice,
    values: &'a [f32],
    strides: [usize; 3],
}

impl Cells<'_> {
    /// Returns the linear index of a node, or of the cell whose lowest node it is.
    fn index(&self, cell: [usize; 3]) -> usize {
        (0..3).map(|axis| cell[axis] * self.strides[axis]).sum()
    }

    /// Returns the surface's position between two nodes, 0 to 1, if the surface crosses their edge.
    fn crossing(&self, from: usize, to: usize) -> Option<f64> {
        let (a, b) = (self.values[from], self.values[to]);
        let is_crossed = (a < 0.0 && b >= 0.0) || (a >= 0.0 && b < 0.0);
        is_crossed.then(|| f64::from(a) / (f64::from(a) - f64::from(b)))
    }

    /// Returns the vertex of a cell, which is given by its lowest node.
    fn vertex(&self, cell: [usize; 3]) -> Option<Vec3> {
        let base = self.index(cell);
        let (mut sum, mut count) = (DVec3::ZERO, 0);
        for axis in 0..3 {
            let [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
            for corner in 0..4 {
                let (along_u, along_v) = (corner & 1, corner >> 1);
                let from = base + along_u * self.strides[u] + along_v * self.strides[v];
                if let Some(position) = self.crossing(from, from + self.strides[axis]) {
                    sum[axis] += position;
                    sum[u] += along_u as f64;
                    sum[v] += along_v as f64;
                    count += 1;
                }
            }
        }
        if count == 0 {
            return None;
        }
        let position = sum / f64::from(count) + DVec3::from(cell.map(|i| i as f64));
        Some(self.lattice.to_world(position.to_array()).as_vec3())
    }

    /// Adds two triangles between the four cells around the edge from a node along an axis, if the
    /// surface crosses the edge.
    fn add_quad(
        &self,
        from: [usize; 3],
        axis: usize,
        vertices: &[u32],
        triangles: &mut Vec<[u32; 3]>,
    ) {
        let [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
        let counts = self.lattice.counts;
        let is_inner = |axis: usize| from[axis] > 0 && from[axis] + 1 < counts[axis];
        if from[axis] + 1 >= counts[axis] || !is_inner(u) || !is_inner(v) {
            return;
        }
        let node = self.index(from);
        if self.crossing(node, node + self.strides[axis]).is_none() {
            return;
        }
        // Counter-clockwise as viewed from the positive end of the axis.
        let around = [
            node - self.strides[u] - self.strides[v],
            node - self.strides[v],
            node,
            node - self.strides[u],
        ];
        let [a, b, c, d] = around.map(|cell| vertices[cell % vertices.len()]);
        // Normals point outwards, away from negative values; a mirrored lattice reverses them.
        let faces_along_axis = (self.values[node] < 0.0) != self.lattice.is_mirrored();
        triangles.extend(if faces_along_axis {
            [[a, b, c], [a, c, d]]
        } else {
            [[a, c, b], [a, d, c]]
        });
    }
}

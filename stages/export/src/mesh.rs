use glam::{DVec3, Vec3};

/// Triangle mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Mesh {
    /// Positions of the vertices in scene units, in the frame of the exported files.
    pub(crate) positions: Vec<Vec3>,
    /// Unit normals of the vertices, outwards.
    pub(crate) normals: Vec<Vec3>,
    /// Vertices of each triangle, counter-clockwise from outside.
    pub(crate) triangles: Vec<[u32; 3]>,
}

/// Minimum size of a connected component as a fraction of all triangles; smaller ones are floaters.
/// Chosen by hand.
const MIN_COMPONENT_FRACTION: f64 = 1e-3;

impl Mesh {
    /// Computes each vertex's normal as the mean of its triangles' normals, weighted by area.
    pub(crate) fn compute_normals(&mut self) {
        let mut sums = vec![DVec3::ZERO; self.positions.len()];
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|v| self.positions[v as usize].as_dvec3());
            let weighted_normal = (b - a).cross(c - a);
            for &vertex in triangle {
                sums[vertex as usize] += weighted_normal;
            }
        }
        self.normals = sums.iter().map(|sum| sum.normalize_or(DVec3::Z).as_vec3()).collect();
    }

    /// Returns the edges that belong to exactly one triangle, sorted, each with its vertices in
    /// ascending order.
    pub(crate) fn boundary_edges(&self) -> Vec<[u32; 2]> {
        let mut edges: Vec<[u32; 2]> = self
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .map(|[a, b]| [a.min(b), a.max(b)])
            .collect();
        edges.sort_unstable();
        let single = edges.chunk_by(|a, b| a == b).filter(|edges| edges.len() == 1);
        single.map(|edges| edges[0]).collect()
    }

    /// Removes small connected components, and vertices without triangles. Normals must be computed
    /// afterwards.
    pub(crate) fn remove_small_components(&mut self) {
        let components = self.components();
        let mut sizes = vec![0usize; self.positions.len()];
        for triangle in &self.triangles {
            sizes[components[triangle[0] as usize] as usize] += 1;
        }
        let min_size = MIN_COMPONENT_FRACTION * self.triangles.len() as f64;
        self.triangles.retain(|t| sizes[components[t[0] as usize] as usize] as f64 >= min_size);
        let mut is_used = vec![false; self.positions.len()];
        for &vertex in self.triangles.iter().flatten() {
            is_used[vertex as usize] = true;
        }
        let mut new_indices = vec![0u32; self.positions.len()];
        let mut positions = Vec::new();
        for (i, &position) in self.positions.iter().enumerate() {
            if is_used[i] {
                new_indices[i] = positions.len() as u32;
                positions.push(position);
            }
        }
        self.positions = positions;
        for vertex in self.triangles.iter_mut().flatten() {
            *vertex = new_indices[*vertex as usize];
        }
    }

    /// Returns the first vertex of each vertex's connected component (union-find).
    fn components(&self) -> Vec<u32> {
        let mut parents: Vec<u32> = (0..self.positions.len() as u32).collect();
        for &[a, b, c] in &self.triangles {
            for (v, w) in [(a, b), (b, c)] {
                let (v, w) = (find_root(&mut parents, v), find_root(&mut parents, w));
                parents[v.max(w) as usize] = v.min(w);
            }
        }
        (0..parents.len() as u32).map(|v| find_root(&mut parents, v)).collect()
    }
}

/// Finds the root of a vertex's component, and shortens the path to it.
fn find_root(parents: &mut [u32], mut v: u32) -> u32 {
    while parents[v as usize] != v {
        parents[v as usize] = parents[parents[v as usize] as usize];
        v = parents[v as usize];
    }
    v
}

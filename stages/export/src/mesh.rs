use glam::{DVec3, Vec3};

/// Triangles.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Mesh {
    /// Vertices in scene units, in the frame of the exported files.
    pub(crate) positions: Vec<Vec3>,
    /// Unit normals of the vertices, outwards.
    pub(crate) normals: Vec<Vec3>,
    /// Vertices of each triangle, counter-clockwise seen from outside.
    pub(crate) triangles: Vec<[u32; 3]>,
}

/// Pieces with fewer triangles than this share of all are dropped: floaters.
const LEAST_PIECE_SHARE: f64 = 1e-3;

impl Mesh {
    /// Makes each vertex's normal the mean of its triangles', weighted by area.
    pub(crate) fn find_normals(&mut self) {
        let mut sums = vec![DVec3::ZERO; self.positions.len()];
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|v| self.positions[v as usize].as_dvec3());
            let area = (b - a).cross(c - a);
            triangle.iter().for_each(|&v| sums[v as usize] += area);
        }
        self.normals = sums.iter().map(|sum| sum.normalize_or(DVec3::Z).as_vec3()).collect();
    }

    /// Edges with one triangle alone, by their vertices in ascending order, sorted.
    pub(crate) fn open_edges(&self) -> Vec<[u32; 2]> {
        let mut edges: Vec<[u32; 2]> = self
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .map(|[a, b]| [a.min(b), a.max(b)])
            .collect();
        edges.sort_unstable();
        let alone = edges.chunk_by(|a, b| a == b).filter(|edges| edges.len() == 1);
        alone.map(|edges| edges[0]).collect()
    }

    /// Drops small pieces, and vertices of no triangle.
    pub(crate) fn drop_small_pieces(&mut self) {
        let pieces = self.pieces();
        let mut sizes = vec![0usize; self.positions.len()];
        self.triangles.iter().for_each(|t| sizes[pieces[t[0] as usize] as usize] += 1);
        let least = LEAST_PIECE_SHARE * self.triangles.len() as f64;
        self.triangles.retain(|t| sizes[pieces[t[0] as usize] as usize] as f64 >= least);
        let mut is_used = vec![false; self.positions.len()];
        self.triangles.iter().flatten().for_each(|&v| is_used[v as usize] = true);
        let mut renumbered = vec![0u32; self.positions.len()];
        let mut kept = Vec::new();
        for (i, &position) in self.positions.iter().enumerate().filter(|(i, _)| is_used[*i]) {
            renumbered[i] = kept.len() as u32;
            kept.push(position);
        }
        self.positions = kept;
        self.triangles.iter_mut().for_each(|t| *t = t.map(|v| renumbered[v as usize]));
    }

    /// For each vertex the first one of its piece (union-find).
    fn pieces(&self) -> Vec<u32> {
        let mut parents: Vec<u32> = (0..self.positions.len() as u32).collect();
        for &[a, b, c] in &self.triangles {
            for (v, w) in [(a, b), (b, c)] {
                let (v, w) = (root(&mut parents, v), root(&mut parents, w));
                parents[v.max(w) as usize] = v.min(w);
            }
        }
        (0..parents.len() as u32).map(|v| root(&mut parents, v)).collect()
    }
}

fn root(parents: &mut [u32], mut v: u32) -> u32 {
    while parents[v as usize] != v {
        parents[v as usize] = parents[parents[v as usize] as usize];
        v = parents[v as usize];
    }
    v
}

//! Comparison of an exported surface with the demo scene's exact surface.

use std::collections::BTreeMap;
use std::path::Path;

use demo_scene::World;
use glam::DVec3;
use scene::Camera;
use serde_json::Value;

/// Content of a binary glTF file with one mesh.
pub struct Glb {
    /// JSON chunk.
    pub description: Value,
    /// Vertex positions.
    pub positions: Vec<DVec3>,
    /// Vertex normals.
    pub normals: Vec<DVec3>,
    /// Vertex colours, linear RGB.
    pub colours: Vec<DVec3>,
    /// Vertex indices of each triangle.
    pub triangles: Vec<[usize; 3]>,
}

/// Returns the 32-bit words of an accessor.
fn accessor_words(description: &Value, binary: &[u8], accessor: &Value) -> Vec<[u8; 4]> {
    let accessor = &description["accessors"][accessor.as_u64().unwrap() as usize];
    let view = &description["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
    let [offset, length] =
        ["byteOffset", "byteLength"].map(|name| view[name].as_u64().unwrap() as usize);
    let bytes = &binary[offset..offset + length];
    bytes.as_chunks::<4>().0.to_vec()
}

fn vectors(description: &Value, binary: &[u8], accessor: &Value) -> Vec<DVec3> {
    let words = accessor_words(description, binary, accessor);
    let float = |word: [u8; 4]| f64::from(f32::from_le_bytes(word));
    words.as_chunks::<3>().0.iter().map(|v| DVec3::from(v.map(float))).collect()
}

impl Glb {
    /// Reads a binary glTF file.
    pub fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap();
        let word = |i: usize| u32::from_le_bytes(bytes[i..i + 4].try_into().unwrap()) as usize;
        assert!(&bytes[..4] == b"glTF" && word(4) == 2 && word(8) == bytes.len());
        let json_length = word(12);
        assert!(&bytes[16..20] == b"JSON" && json_length % 4 == 0);
        let description: Value = serde_json::from_slice(&bytes[20..20 + json_length]).unwrap();
        let start = 28 + json_length;
        assert!(&bytes[start - 4..start] == b"BIN\0" && word(start - 8) == bytes.len() - start);
        let primitive = &description["meshes"][0]["primitives"][0];
        let (attributes, binary) = (&primitive["attributes"], &bytes[start..]);
        let indices = accessor_words(&description, binary, &primitive["indices"]);
        let index = |word: [u8; 4]| u32::from_le_bytes(word) as usize;
        Self {
            positions: vectors(&description, binary, &attributes["POSITION"]),
            normals: vectors(&description, binary, &attributes["NORMAL"]),
            colours: vectors(&description, binary, &attributes["COLOR_0"]),
            triangles: indices.as_chunks::<3>().0.iter().map(|t| t.map(index)).collect(),
            description,
        }
    }
}

/// Returns points of the true surface that are visible from the cameras, with normals: one point
/// per grid cell of side `cell`.
pub fn true_surface(world: &World, cameras: &[Camera], cell: f64) -> Vec<(DVec3, DVec3)> {
    let mut points = BTreeMap::new();
    for camera in cameras {
        let k = camera.intrinsics;
        for i in 0..k.width * k.height {
            let ray = camera.ray(f64::from(i % k.width) + 0.5, f64::from(i / k.width) + 0.5);
            if let Some((point, normal)) = world.surface(ray.origin, ray.direction) {
                points.entry(cell_index(point, cell)).or_insert((point, normal));
            }
        }
    }
    points.into_values().collect()
}

fn cell_index(point: DVec3, cell: f64) -> [i32; 3] {
    (point / cell).to_array().map(|x| x.floor() as i32)
}

/// Returns the longest side of the points' bounding box.
pub fn size(points: &[(DVec3, DVec3)]) -> f64 {
    let all = || points.iter().map(|(point, _)| *point);
    let (min, max) = (all().reduce(DVec3::min).unwrap(), all().reduce(DVec3::max).unwrap());
    (max - min).max_element()
}

/// Errors of an exported surface; distances are divided by the scene's size.
#[derive(Clone, Copy, Debug)]
pub struct Compared {
    /// Mean distance from exported vertices or points to the true surface.
    pub to_truth: f64,
    /// Mean distance from the true surface to the nearest exported vertex.
    pub from_truth: f64,
    /// Share of the normals along which the signed distance from the true surface grows.
    pub outward: f64,
}

/// Compares vertices and normals with the true surface and its sample points `truth`.
pub fn compare(
    world: &World,
    truth: &[(DVec3, DVec3)],
    positions: &[DVec3],
    normals: &[DVec3],
) -> Compared {
    let size = size(truth);
    let mean = |sum: f64, count: usize| sum / count as f64 / size;
    let error_sum: f64 = positions.iter().map(|p| world.distance(*p).abs()).sum();
    let step = 1e-4;
    let is_outward =
        |p: DVec3, n: DVec3| world.distance(p + step * n) > world.distance(p - step * n);
    let outward = positions.iter().zip(normals).filter(|(p, n)| is_outward(**p, **n)).count();
    let nearest = Nearest::new(positions, 0.02 * size);
    let gap_sum: f64 = truth.iter().map(|(point, _)| nearest.distance(*point)).sum();
    Compared {
        to_truth: mean(error_sum, positions.len()),
        from_truth: mean(gap_sum, truth.len()),
        outward: outward as f64 / positions.len() as f64,
    }
}

/// Index of points for nearest-neighbour distances.
struct Nearest {
    cell: f64,
    points: BTreeMap<[i32; 3], Vec<DVec3>>,
}

impl Nearest {
    fn new(points: &[DVec3], cell: f64) -> Self {
        let mut cells: BTreeMap<[i32; 3], Vec<DVec3>> = BTreeMap::new();
        points.iter().for_each(|p| cells.entry(cell_index(*p, cell)).or_default().push(*p));
        Self { cell, points: cells }
    }

    /// Returns the distance from a point to the nearest indexed point.
    fn distance(&self, from: DVec3) -> f64 {
        let centre = cell_index(from, self.cell);
        let mut best = f64::INFINITY;
        for ring in 0..64 {
            // Points in this ring and farther ones can't be nearer than `ring - 1` cells.
            if best <= f64::from(ring - 1) * self.cell {
                break;
            }
            for cell in cells_of_ring(centre, ring) {
                for point in self.points.get(&cell).into_iter().flatten() {
                    best = best.min((*point - from).length());
                }
            }
        }
        best
    }
}

/// Returns the cells at Chebyshev distance `ring` from a cell.
fn cells_of_ring(centre: [i32; 3], ring: i32) -> impl Iterator<Item = [i32; 3]> {
    let side = 2 * ring + 1;
    (0..side.pow(3)).filter_map(move |i| {
        let offset = [i % side - ring, i / side % side - ring, i / (side * side) - ring];
        let is_on_ring = offset.iter().any(|o| o.abs() == ring);
        is_on_ring.then(|| [0, 1, 2].map(|axis| centre[axis] + offset[axis]))
    })
}

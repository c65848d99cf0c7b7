//! Points and splats as binary PLY files.

use std::io::{self, Write};

use glam::{DQuat, DVec3, Vec3};
use pixels::to_u8;

use crate::coordinates::Coordinates;
use crate::mesh::Mesh;
use crate::surfel::Surfel;

/// Properties of a point that are floats.
const POINT_FLOATS: &str = "x y z nx ny nz";
/// Properties of a point that are bytes.
const POINT_BYTES: &str = "red green blue";

/// Maximum distance in pixels from a silhouette at which normals are uncertain (design note 043).
const MAX_UNCERTAIN_MARGIN_PIXELS: u8 = 2;

/// Spherical harmonic of degree 0.
const HARMONIC: f32 = 0.282_094_79;
/// Standard deviation of a splat along its surface, as a fraction of the distance to its
/// neighbours: splats close the surface at any viewing distance (design note 043).
const SPLAT_DEVIATION: f64 = 0.5;
/// Standard deviation of a splat along its normal, as a fraction of that along the surface; chosen
/// by hand.
const SPLAT_FLATNESS: f64 = 0.1;
/// Opacity of a splat on an opaque surface, which several splats cover. Larger values widen edges,
/// since viewers blur splats (design note 043).
const SPLAT_OPACITY: f64 = 0.6;
/// Minimum and maximum opacity of a splat: the logit of 0 or 1 is infinite.
const SPLAT_OPACITY_BOUNDS: [f64; 2] = [0.02, 0.99];

/// Selects the surfels that become points: all but those with uncertain normals, or all surfels if
/// every normal is uncertain.
pub(crate) fn select_points(surfels: &[Surfel]) -> Vec<Surfel> {
    let is_certain = |surfel: &&Surfel| surfel.margin > MAX_UNCERTAIN_MARGIN_PIXELS;
    let certain: Vec<Surfel> = surfels.iter().filter(is_certain).copied().collect();
    if certain.is_empty() { surfels.to_vec() } else { certain }
}

/// Writes points with normals and 8-bit colours, display-encoded sRGB.
pub(crate) fn write_points(
    file: &mut impl Write,
    surfels: &[Surfel],
    coordinates: &Coordinates,
) -> io::Result<()> {
    write_header(file, coordinates, surfels.len(), POINT_FLOATS, POINT_BYTES)?;
    writeln!(file, "end_header")?;
    for surfel in surfels {
        write_point(file, surfel.position.as_vec3(), surfel.normal.as_vec3(), surfel.colour)?;
    }
    Ok(())
}

/// Writes a mesh with normals and 8-bit vertex colours, display-encoded sRGB, for programs that
/// ignore the vertex colours of a mesh with a material, such as `mesh.glb`.
pub(crate) fn write_mesh(
    file: &mut impl Write,
    mesh: &Mesh,
    colours: &[[f32; 3]],
    coordinates: &Coordinates,
) -> io::Result<()> {
    write_header(file, coordinates, mesh.positions.len(), POINT_FLOATS, POINT_BYTES)?;
    writeln!(file, "element face {}", mesh.triangles.len())?;
    writeln!(file, "property list uchar int vertex_indices\nend_header")?;
    for (i, &colour) in colours.iter().enumerate() {
        write_point(file, mesh.positions[i], mesh.normals[i], colour)?;
    }
    for triangle in &mesh.triangles {
        file.write_all(&[3])?;
        file.write_all(triangle.map(u32::to_le_bytes).as_flattened())?;
    }
    Ok(())
}

/// Writes surfels as 3D Gaussians, in the PLY layout of Kerbl et al. 2023: position, normal, colour
/// as coefficient of the constant spherical harmonic, opacity as logit, standard deviations as
/// logarithms, rotation as quaternion with the real part first.
pub(crate) fn write_splats(
    file: &mut impl Write,
    surfels: &[Surfel],
    coordinates: &Coordinates,
) -> io::Result<()> {
    let names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 \
        rot_2 rot_3";
    write_header(file, coordinates, surfels.len(), names, "")?;
    writeln!(file, "end_header")?;
    for surfel in surfels {
        file.write_all(splat_properties(surfel).map(f32::to_le_bytes).as_flattened())?;
    }
    Ok(())
}

/// Returns the properties of a splat: a disc whose third axis is the normal.
fn splat_properties(surfel: &Surfel) -> [f32; 17] {
    let [x, y, z] = surfel.position.as_vec3().to_array();
    let [nx, ny, nz] = surfel.normal.as_vec3().to_array();
    let [r, g, b] = surfel.colour.map(|v| (v - 0.5) / HARMONIC);
    let [min, max] = SPLAT_OPACITY_BOUNDS;
    let opacity = (SPLAT_OPACITY * f64::from(surfel.opacity)).clamp(min, max);
    let logit = (opacity / (1.0 - opacity)).ln() as f32;
    let deviation = SPLAT_DEVIATION * surfel.spacing;
    let along = deviation.ln() as f32;
    let across = (SPLAT_FLATNESS * deviation).ln() as f32;
    let q = DQuat::from_rotation_arc(DVec3::Z, surfel.normal).as_quat();
    [x, y, z, nx, ny, nz, r, g, b, logit, along, along, across, q.w, q.x, q.y, q.z]
}

/// Writes the header of a binary little-endian PLY file up to the properties of its `count`
/// vertices: names of floats, then of bytes.
fn write_header(
    file: &mut impl Write,
    coordinates: &Coordinates,
    count: usize,
    floats: &str,
    bytes: &str,
) -> io::Result<()> {
    writeln!(file, "ply\nformat binary_little_endian 1.0")?;
    writeln!(file, "comment {coordinates}\nelement vertex {count}")?;
    for (kind, names) in [("float", floats), ("uchar", bytes)] {
        for name in names.split_whitespace() {
            writeln!(file, "property {kind} {name}")?;
        }
    }
    Ok(())
}

/// Writes a point with its normal and colour.
fn write_point(
    file: &mut impl Write,
    position: Vec3,
    normal: Vec3,
    colour: [f32; 3],
) -> io::Result<()> {
    write_vector(file, position)?;
    write_vector(file, normal)?;
    file.write_all(&colour.map(to_u8))
}

/// Writes a vector as three little-endian floats.
pub(crate) fn write_vector(file: &mut impl Write, vector: Vec3) -> io::Result<()> {
    file.write_all(vector.to_array().map(f32::to_le_bytes).as_flattened())
}

//! Points and splats as binary PLY files.

use std::io::{self, Write};

use glam::{DQuat, DVec3};

use crate::coordinates::Coordinates;
use crate::mesh::Mesh;
use crate::surfel::Surfel;

/// PLY's name of the type `f32`.
const FLOAT: &str = "float";
/// PLY's name of the type `u8`.
const BYTE: &str = "uchar";

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

/// Selects the surfels that become points: those with certain normals, or all if there are none.
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
    let floats = ["x", "y", "z", "nx", "ny", "nz"].map(|name| (name, FLOAT));
    let bytes = ["red", "green", "blue"].map(|name| (name, BYTE));
    write_header(file, coordinates, surfels.len(), &[&floats[..], &bytes].concat())?;
    for surfel in surfels {
        write_floats(file, &surfel.position.as_vec3().to_array())?;
        write_floats(file, &surfel.normal.as_vec3().to_array())?;
        file.write_all(&colour_bytes(surfel.colour))?;
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
    writeln!(file, "ply\nformat binary_little_endian 1.0")?;
    writeln!(file, "comment {coordinates}")?;
    writeln!(file, "element vertex {}", mesh.positions.len())?;
    for name in ["x", "y", "z", "nx", "ny", "nz"] {
        writeln!(file, "property {FLOAT} {name}")?;
    }
    for name in ["red", "green", "blue"] {
        writeln!(file, "property {BYTE} {name}")?;
    }
    writeln!(file, "element face {}", mesh.triangles.len())?;
    writeln!(file, "property list {BYTE} int vertex_indices\nend_header")?;
    for (i, colour) in colours.iter().enumerate() {
        write_floats(file, &mesh.positions[i].to_array())?;
        write_floats(file, &mesh.normals[i].to_array())?;
        file.write_all(&colour_bytes(*colour))?;
    }
    for triangle in &mesh.triangles {
        file.write_all(&[3])?;
        for vertex in triangle {
            file.write_all(&vertex.to_le_bytes())?;
        }
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
    let properties: Vec<_> = names.split_whitespace().map(|name| (name, FLOAT)).collect();
    write_header(file, coordinates, surfels.len(), &properties)?;
    for surfel in surfels {
        write_floats(file, &splat_properties(surfel))?;
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

/// Writes the header of a binary little-endian PLY file with one list of elements.
fn write_header(
    file: &mut impl Write,
    coordinates: &Coordinates,
    count: usize,
    properties: &[(&str, &str)],
) -> io::Result<()> {
    writeln!(file, "ply\nformat binary_little_endian 1.0")?;
    writeln!(file, "comment {coordinates}")?;
    writeln!(file, "element vertex {count}")?;
    for (name, property_type) in properties {
        writeln!(file, "property {property_type} {name}")?;
    }
    writeln!(file, "end_header")
}

/// Writes little-endian floats.
pub(crate) fn write_floats(file: &mut impl Write, values: &[f32]) -> io::Result<()> {
    for value in values {
        file.write_all(&value.to_le_bytes())?;
    }
    Ok(())
}

/// Converts a colour to 8 bits.
pub(crate) fn colour_bytes(colour: [f32; 3]) -> [u8; 3] {
    colour.map(|v| (255.0 * v.clamp(0.0, 1.0) + 0.5) as u8)
}

use std::io::{self, Write};

use glam::Vec3;
use pixels::linear_from_srgb;
use serde_json::{Value, json};

use crate::coordinates::Coordinates;
use crate::mesh::Mesh;

/// glTF's code of the component type `f32`.
const FLOAT: u32 = 5126;
/// glTF's code of the component type `u32`.
const UNSIGNED: u32 = 5125;
/// glTF's code of the buffer target for vertices (`ARRAY_BUFFER`).
const VERTICES: u32 = 34962;
/// glTF's code of the buffer target for indices (`ELEMENT_ARRAY_BUFFER`).
const INDICES: u32 = 34963;

/// Version of the file's header.
const VERSION: u32 = 2;
/// Number of bytes of the file's header (12) and of its two chunks' headers (8 each).
const HEADER_BYTES: usize = 28;

/// Writes a mesh as binary glTF 2.0, unlit, since the colours include the scene's light. The
/// vertices' `colours`, display-encoded sRGB, are converted to glTF's linear colours.
pub(crate) fn write(
    file: &mut impl Write,
    mesh: &Mesh,
    colours: &[[f32; 3]],
    coordinates: &Coordinates,
) -> io::Result<()> {
    let colours: Vec<Vec3> = colours
        .iter()
        .map(|c| Vec3::from(c.map(|v| linear_from_srgb(f64::from(v)) as f32)))
        .collect();
    let mut text = serde_json::to_string(&gltf_json(mesh, coordinates))?;
    // A chunk's length is a multiple of four bytes.
    while !text.len().is_multiple_of(4) {
        text.push(' ');
    }
    let length = buffer_length(mesh);
    file.write_all(b"glTF")?;
    write_words(file, [VERSION, (HEADER_BYTES + text.len() + length) as u32, text.len() as u32])?;
    file.write_all(b"JSON")?;
    file.write_all(text.as_bytes())?;
    write_words(file, [length as u32])?;
    file.write_all(b"BIN\0")?;
    for vector in mesh.positions.iter().chain(&mesh.normals).chain(&colours) {
        crate::ply::write_vector(file, *vector)?;
    }
    for triangle in &mesh.triangles {
        write_words(file, *triangle)?;
    }
    Ok(())
}

/// Writes little-endian 32-bit integers.
fn write_words<const N: usize>(file: &mut impl Write, words: [u32; N]) -> io::Result<()> {
    file.write_all(words.map(u32::to_le_bytes).as_flattened())
}

/// Returns the number of bytes of all vertices and triangles.
pub(crate) fn buffer_length(mesh: &Mesh) -> usize {
    3 * 12 * mesh.positions.len() + 12 * mesh.triangles.len()
}

/// Returns the JSON chunk.
fn gltf_json(mesh: &Mesh, coordinates: &Coordinates) -> Value {
    let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len());
    let bound = |fold: fn(Vec3, Vec3) -> Vec3| {
        mesh.positions.iter().copied().reduce(fold).unwrap_or_default().to_array()
    };
    let mut positions = vector_accessor(0, vertices);
    positions["min"] = json!(bound(Vec3::min));
    positions["max"] = json!(bound(Vec3::max));
    let indices = json!({"bufferView": 3, "componentType": UNSIGNED, "count": 3 * triangles,
        "type": "SCALAR"});
    let length = 12 * vertices;
    json!({
        "asset": {"version": "2.0", "generator": "nerf-sr export",
            "extras": {"coordinates": coordinates.to_string()}},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "field"}],
        "meshes": [{"primitives": [{
            "attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2},
            "indices": 3,
            "material": 0,
        }]}],
        "materials": [{
            "doubleSided": true,
            "extensions": {"KHR_materials_unlit": {}},
            "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
        }],
        "accessors": [
            positions,
            vector_accessor(1, vertices),
            vector_accessor(2, vertices),
            indices,
        ],
        "bufferViews": [
            buffer_view(0, length, VERTICES),
            buffer_view(length, length, VERTICES),
            buffer_view(2 * length, length, VERTICES),
            buffer_view(3 * length, 12 * triangles, INDICES),
        ],
        "buffers": [{"byteLength": buffer_length(mesh)}],
    })
}

/// Returns the accessor of one vector per vertex.
fn vector_accessor(buffer_view: u32, count: usize) -> Value {
    json!({"bufferView": buffer_view, "componentType": FLOAT, "count": count, "type": "VEC3"})
}

/// Returns the buffer view of `length` bytes from byte `first`; `target` is [`VERTICES`] or
/// [`INDICES`].
fn buffer_view(first: usize, length: usize, target: u32) -> Value {
    json!({"buffer": 0, "byteOffset": first, "byteLength": length, "target": target})
}

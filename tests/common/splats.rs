//! Independent reader of binary PLY files, and a reference renderer of 3D Gaussians.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use pixels::Image;
use scene::Camera;

/// Returns the columns of the first element of a binary little-endian PLY file, by name.
pub fn read_ply(path: &Path) -> BTreeMap<String, Vec<f64>> {
    let bytes = std::fs::read(path).unwrap();
    let end = b"end_header\n";
    let header_length = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let text = std::str::from_utf8(&bytes[..header_length]).unwrap();
    assert!(text.starts_with("ply\nformat binary_little_endian 1.0\n"), "{text}");
    let lines: Vec<Vec<&str>> = text.lines().map(|l| l.split_whitespace().collect()).collect();
    // Vertices come first; a mesh has faces after them.
    let element = lines.iter().find(|line| line.first() == Some(&"element")).unwrap();
    let count: usize = element[2].parse().unwrap();
    let properties: Vec<(&str, &str)> = lines
        .iter()
        .skip_while(|line| line.first() != Some(&"property"))
        .take_while(|line| line.first() == Some(&"property"))
        .map(|line| (line[1], line[2]))
        .collect();
    let mut columns: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    let mut rest = &bytes[header_length..];
    for _ in 0..count {
        for (kind, name) in &properties {
            let (value, length) = match *kind {
                "float" => (f64::from(f32::from_le_bytes(rest[..4].try_into().unwrap())), 4),
                "uchar" => (f64::from(rest[0]), 1),
                other => panic!("unexpected property type {other}"),
            };
            rest = &rest[length..];
            columns.entry((*name).to_owned()).or_default().push(value);
        }
    }
    columns
}

/// Returns three columns as vectors.
pub fn vectors(columns: &BTreeMap<String, Vec<f64>>, names: [&str; 3]) -> Vec<DVec3> {
    (0..columns[names[0]].len()).map(|i| vector(columns, names, i)).collect()
}

fn vector(columns: &BTreeMap<String, Vec<f64>>, names: [&str; 3], i: usize) -> DVec3 {
    DVec3::from_array(names.map(|name| columns[name][i]))
}

/// 3D Gaussian.
pub struct Splat {
    position: DVec3,
    covariance: DMat3,
    colour: DVec3,
    opacity: f64,
}

fn rotation(columns: &BTreeMap<String, Vec<f64>>, i: usize) -> DMat3 {
    let [w, x, y, z] = ["rot_0", "rot_1", "rot_2", "rot_3"].map(|name| columns[name][i]);
    DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
}

/// Reads a splat file by the published layout of its columns.
pub fn read_splats(path: &Path) -> Vec<Splat> {
    let columns = read_ply(path);
    (0..columns["x"].len()).map(|i| splat(&columns, i)).collect()
}

fn splat(columns: &BTreeMap<String, Vec<f64>>, i: usize) -> Splat {
    let scale = vector(columns, ["scale_0", "scale_1", "scale_2"], i);
    let axes = rotation(columns, i) * DMat3::from_diagonal(scale.exp());
    Splat {
        position: vector(columns, ["x", "y", "z"], i),
        covariance: axes * axes.transpose(),
        colour: 0.5 + 0.282_094_791_773_878_14 * vector(columns, ["f_dc_0", "f_dc_1", "f_dc_2"], i),
        opacity: 1.0 / (1.0 + (-columns["opacity"][i]).exp()),
    }
}

/// Splat projected into an image.
struct ProjectedSplat<'a> {
    splat: &'a Splat,
    depth: f64,
    centre: DVec2,
    inverse_covariance: DMat2,
    radius: f64,
}

fn covered_pixels(radius: f64, centre: f64, size: usize) -> std::ops::Range<usize> {
    let clamp = |x: f64| x.clamp(0.0, size as f64) as usize;
    clamp(centre - radius)..clamp(centre + radius + 1.0)
}

/// Renders splats over a grey background by the method of Kerbl et al. 2023: linearised projection,
/// 0.3 square pixels added to the variance, compositing from front to back.
pub fn render_splats(splats: &[Splat], camera: &Camera, background: f64) -> Image {
    let k = camera.intrinsics;
    let mut projections: Vec<ProjectedSplat<'_>> =
        splats.iter().filter_map(|s| project_splat(s, camera)).collect();
    projections.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let (width, height) = (k.width as usize, k.height as usize);
    let (mut colours, mut transmittance) =
        (vec![DVec3::ZERO; width * height], vec![1.0f64; width * height]);
    for projection in &projections {
        for y in covered_pixels(projection.radius, projection.centre.y, height) {
            for x in covered_pixels(projection.radius, projection.centre.x, width) {
                let offset = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - projection.centre;
                let falloff = (-0.5 * offset.dot(projection.inverse_covariance * offset)).exp();
                let alpha = (projection.splat.opacity * falloff).min(0.99);
                let index = y * width + x;
                if alpha >= 1.0 / 255.0 && transmittance[index] > 1e-4 {
                    colours[index] += transmittance[index] * alpha * projection.splat.colour;
                    transmittance[index] *= 1.0 - alpha;
                }
            }
        }
    }
    let data = colours.iter().zip(&transmittance).flat_map(|(colour, transmittance)| {
        (*colour + background * *transmittance).clamp(DVec3::ZERO, DVec3::ONE).as_vec3().to_array()
    });
    Image::new(width, height, 3, data.collect())
}

fn project_splat<'a>(splat: &'a Splat, camera: &Camera) -> Option<ProjectedSplat<'a>> {
    let k = camera.intrinsics;
    let (x, y, depth) = camera.project(splat.position)?;
    if depth < 0.2 {
        return None;
    }
    // Camera axes: right, down, forward.
    let axes = camera.rotation();
    let world_to_camera = DMat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis).transpose();
    let position = world_to_camera * (splat.position - camera.centre());
    let jacobian = DMat3::from_cols(
        DVec3::new(k.fx / depth, 0.0, 0.0),
        DVec3::new(0.0, k.fy / depth, 0.0),
        DVec3::new(-k.fx * position.x, -k.fy * position.y, 0.0) / (depth * depth),
    );
    let covariance =
        jacobian * world_to_camera * splat.covariance * (jacobian * world_to_camera).transpose();
    let covariance = DMat2::from_cols(
        DVec2::new(covariance.x_axis.x + 0.3, covariance.x_axis.y),
        DVec2::new(covariance.y_axis.x, covariance.y_axis.y + 0.3),
    );
    let max_variance = covariance.x_axis.x.max(covariance.y_axis.y);
    let projected = ProjectedSplat {
        splat,
        depth,
        centre: DVec2::new(x, y),
        inverse_covariance: covariance.inverse(),
        radius: 3.0 * max_variance.sqrt(),
    };
    Some(projected)
}

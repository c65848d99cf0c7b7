//! Independent reader of binary PLY files, and a reference renderer of 3D Gaussians.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use pixels::Image;
use scene::Camera;

/// Reads the columns of the first element of a binary little-endian PLY file, by name.
pub fn read_ply(path: &Path) -> BTreeMap<String, Vec<f64>> {
    let bytes = std::fs::read(path).unwrap();
    let end = b"end_header\n";
    let header = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let text = std::str::from_utf8(&bytes[..header]).unwrap();
    assert!(text.starts_with("ply\nformat binary_little_endian 1.0\n"), "{text}");
    let words: Vec<Vec<&str>> = text.lines().map(|l| l.split_whitespace().collect()).collect();
    // Vertices come first; a mesh has faces after them.
    let element = words.iter().find(|line| line.first() == Some(&"element")).unwrap();
    let count: usize = element[2].parse().unwrap();
    let properties: Vec<(&str, &str)> = words
        .iter()
        .skip_while(|line| line.first() != Some(&"property"))
        .take_while(|line| line.first() == Some(&"property"))
        .map(|line| (line[1], line[2]))
        .collect();
    let mut columns: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    let mut rest = &bytes[header..];
    for _ in 0..count {
        for (kind, name) in &properties {
            let (value, length) = match *kind {
                "float" => (f64::from(f32::from_le_bytes(rest[..4].try_into().unwrap())), 4),
                "uchar" => (f64::from(rest[0]), 1),
                other => panic!("a property is {other}"),
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
struct Drawn<'a> {
    splat: &'a Splat,
    depth: f64,
    middle: DVec2,
    inverse: DMat2,
    radius: f64,
}

fn covered(radius: f64, middle: f64, size: usize) -> std::ops::Range<usize> {
    let end = |x: f64| x.clamp(0.0, size as f64) as usize;
    end(middle - radius)..end(middle + radius + 1.0)
}

/// Renders splats over a grey background by the method of Kerbl et al. 2023: linearised projection,
/// 0.3 square pixels added to the variance, compositing from front to back.
pub fn render_splats(splats: &[Splat], camera: &Camera, background: f64) -> Image {
    let k = camera.intrinsics;
    let mut drawn: Vec<Drawn<'_>> = splats.iter().filter_map(|s| projected(s, camera)).collect();
    drawn.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let (width, height) = (k.width as usize, k.height as usize);
    let (mut colours, mut left) = (vec![DVec3::ZERO; width * height], vec![1.0f64; width * height]);
    for item in &drawn {
        for y in covered(item.radius, item.middle.y, height) {
            for x in covered(item.radius, item.middle.x, width) {
                let off = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - item.middle;
                let density = (-0.5 * off.dot(item.inverse * off)).exp();
                let alpha = (item.splat.opacity * density).min(0.99);
                let at = y * width + x;
                if alpha >= 1.0 / 255.0 && left[at] > 1e-4 {
                    colours[at] += left[at] * alpha * item.splat.colour;
                    left[at] *= 1.0 - alpha;
                }
            }
        }
    }
    let data = colours.iter().zip(&left).flat_map(|(colour, left)| {
        (*colour + background * *left).clamp(DVec3::ZERO, DVec3::ONE).as_vec3().to_array()
    });
    Image::new(width, height, 3, data.collect())
}

fn projected<'a>(splat: &'a Splat, camera: &Camera) -> Option<Drawn<'a>> {
    let k = camera.intrinsics;
    let (x, y, depth) = camera.project(splat.position)?;
    if depth < 0.2 {
        return None;
    }
    // Camera axes: right, down, forward.
    let axes = camera.rotation();
    let turn = DMat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis).transpose();
    let place = turn * (splat.position - camera.centre());
    let slopes = DMat3::from_cols(
        DVec3::new(k.fx / depth, 0.0, 0.0),
        DVec3::new(0.0, k.fy / depth, 0.0),
        DVec3::new(-k.fx * place.x, -k.fy * place.y, 0.0) / (depth * depth),
    );
    let spread = slopes * turn * splat.covariance * (slopes * turn).transpose();
    let spread = DMat2::from_cols(
        DVec2::new(spread.x_axis.x + 0.3, spread.x_axis.y),
        DVec2::new(spread.y_axis.x, spread.y_axis.y + 0.3),
    );
    let widest = spread.x_axis.x.max(spread.y_axis.y);
    let drawn = Drawn {
        splat,
        depth,
        middle: DVec2::new(x, y),
        inverse: spread.inverse(),
        radius: 3.0 * widest.sqrt(),
    };
    Some(drawn)
}

use glam::DVec3;

/// How a surface looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Material {
    /// Radial tiles that get finer towards the middle.
    Tiles,
    /// A printed crate: cells set or not by a hash, framed.
    Crate,
    /// Glossy red ball with pale veins.
    Ball,
    /// Matt ball with stripes, for behind the cage.
    Stripes,
    /// Dark metal rods.
    Rod,
    /// Copper wire.
    Copper,
    /// A sign with rows of fine marks.
    Sign,
}

/// Albedo and gloss of a point, in linear light.
pub(crate) struct Reflectance {
    pub(crate) albedo: DVec3,
    /// Strength of the highlight.
    pub(crate) specular: f64,
    /// Sharpness of the highlight.
    pub(crate) exponent: i32,
    /// Share of mirrored light.
    pub(crate) mirror: f64,
}

/// A fixed scramble of a lattice cell to [0, 1).
fn hash(x: i64, y: i64, z: i64, seed: u32) -> f64 {
    let mut h = (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ (z as u64).wrapping_mul(0x1656_67B1_9E37_79F9)
        ^ u64::from(seed).wrapping_mul(0xD6E8_FEB8_6659_FD93);
    h ^= h >> 32;
    h = h.wrapping_mul(0xD6E8_FEB8_6659_FD93);
    h ^= h >> 32;
    h = h.wrapping_mul(0xD6E8_FEB8_6659_FD93);
    h ^= h >> 32;
    (h >> 11) as f64 / (1u64 << 53) as f64
}

fn cell(x: f64) -> i64 {
    x.floor() as i64
}

/// The surface of a material at a point in the shape's own space (centred, about 1 in size), with
/// its normal there.
pub(crate) fn surface(material: Material, p: DVec3, normal: DVec3, seed: u32) -> Reflectance {
    match material {
        Material::Tiles => matt(tiles(p, normal, seed)),
        Material::Crate => matt(printed_crate(p, normal, seed)),
        Material::Ball => {
            let albedo = veins(p, seed);
            Reflectance { albedo, specular: 0.9, exponent: 120, mirror: 0.12 }
        }
        Material::Stripes => matt(stripes(p)),
        Material::Rod => {
            Reflectance { albedo: DVec3::splat(0.12), specular: 0.35, exponent: 30, mirror: 0.0 }
        }
        Material::Copper => Reflectance {
            albedo: DVec3::new(0.55, 0.24, 0.10),
            specular: 0.7,
            exponent: 50,
            mirror: 0.05,
        },
        Material::Sign => matt(marks(p, seed)),
    }
}

/// A surface that mirrors nothing and has a faint highlight.
fn matt(albedo: DVec3) -> Reflectance {
    Reflectance { albedo, specular: 0.05, exponent: 12, mirror: 0.0 }
}

/// Albedo of rings of tiles around the z axis, with dark joints; of planks below and at the side.
fn tiles(p: DVec3, normal: DVec3, seed: u32) -> DVec3 {
    let radius = (p.x * p.x + p.y * p.y).sqrt();
    if normal.z < 0.5 {
        let plank = hash(cell(libm::atan2(p.y, p.x) * 12.0), 0, 1, seed);
        return DVec3::new(0.30, 0.17, 0.08) * (0.6 + 0.8 * plank);
    }
    let ring = cell(radius * 14.0);
    let around = (2 * ring + 7) as f64;
    let angle = libm::atan2(p.y, p.x) / std::f64::consts::TAU + 0.5;
    let tile = cell(angle * around);
    let joint = (radius * 14.0).fract().min((angle * around).fract()) < 0.08;
    let tone = hash(ring, tile, 2, seed);
    let light = if (ring + tile) % 2 == 0 { 0.62 } else { 0.16 };
    let tint =
        DVec3::new(0.95, 0.93, 0.85).lerp(DVec3::new(0.35, 0.55, 0.75), hash(ring, tile, 3, seed));
    if joint { DVec3::splat(0.05) } else { tint * (light * (0.75 + 0.5 * tone)) }
}

/// Albedo of a crate's faces: a frame around cells that are printed or not.
fn printed_crate(p: DVec3, normal: DVec3, seed: u32) -> DVec3 {
    // The face's own two coordinates.
    let (u, v) = if normal.x.abs() > 0.5 {
        (p.y, p.z)
    } else if normal.y.abs() > 0.5 {
        (p.x, p.z)
    } else {
        (p.x, p.y)
    };
    let face = cell(normal.x * 1.5) * 9 + cell(normal.y * 1.5) * 3 + cell(normal.z * 1.5);
    if u.abs().max(v.abs()) > 0.88 {
        return DVec3::new(0.45, 0.30, 0.10);
    }
    let set = hash(cell(u * 11.0), cell(v * 11.0), face, seed) < 0.45;
    let ground =
        DVec3::new(0.75, 0.62, 0.30).lerp(DVec3::new(0.25, 0.60, 0.35), hash(face, 7, 7, seed));
    if set { DVec3::new(0.04, 0.05, 0.10) } else { ground }
}

/// Albedo of red with pale, wavy veins.
fn veins(p: DVec3, seed: u32) -> DVec3 {
    let wave = libm::sin(9.0 * p.x + 3.0 * libm::sin(5.0 * p.y + 2.0 * p.z) + f64::from(seed));
    let vein = (1.0 - wave.abs()).powi(6);
    DVec3::new(0.62, 0.05, 0.05).lerp(DVec3::new(0.85, 0.70, 0.55), 0.8 * vein)
}

/// Albedo of wavy stripes across the z axis.
fn stripes(p: DVec3) -> DVec3 {
    let stripe = (p.z * 7.0 + 0.3 * libm::sin(6.0 * p.x)).floor().rem_euclid(2.0) < 1.0;
    if stripe { DVec3::new(0.85, 0.70, 0.10) } else { DVec3::new(0.08, 0.20, 0.50) }
}

/// Albedo of a sign: rows of ink marks.
fn marks(p: DVec3, seed: u32) -> DVec3 {
    let line = cell(p.z * 6.0);
    let gap = (p.z * 6.0).rem_euclid(1.0);
    let mark = hash(cell(p.x * 16.0), line, 11, seed) < 0.6;
    let ink = (0.25..0.8).contains(&gap) && mark && p.x.abs() < 0.92 && p.z.abs() < 0.95;
    if ink { DVec3::new(0.55, 0.05, 0.10) } else { DVec3::new(0.80, 0.80, 0.74) }
}

use glam::DVec3;

/// Material of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Material {
    /// Rings of tiles around the middle.
    Tiles,
    /// Printed crate: framed cells, filled at random by a hash.
    Crate,
    /// Glossy red with pale veins.
    RedVeined,
    /// Matt stripes.
    Stripes,
    /// Dark metal.
    DarkMetal,
    /// Copper.
    Copper,
    /// Rows of fine marks.
    Sign,
}

/// Albedo and gloss at a surface point, in linear light.
pub(crate) struct Reflectance {
    /// Diffuse albedo.
    pub(crate) albedo: DVec3,
    /// Strength of the highlight.
    pub(crate) specular: f64,
    /// Sharpness of the highlight.
    pub(crate) exponent: i32,
    /// Fraction of light that is mirrored at normal incidence.
    pub(crate) mirror: f64,
}

/// Hashes a lattice cell to [0, 1). In two dimensions, `z` numbers a pattern or a face. The
/// multipliers are 2⁶⁴ over the golden ratio, two primes of xxHash, and degski64's multiplier.
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

/// Returns the index of a unit cell along an axis.
fn cell(x: f64) -> i64 {
    x.floor() as i64
}

/// Returns a material's reflectance at a point with a normal, both in the shape's own space
/// (centred; about -1 to 1, except on rods).
pub(crate) fn reflectance(material: Material, p: DVec3, normal: DVec3, seed: u32) -> Reflectance {
    match material {
        Material::Tiles => matt(tiles(p, normal, seed)),
        Material::Crate => matt(printed_crate(p, normal, seed)),
        Material::RedVeined => {
            Reflectance { albedo: veins(p, seed), specular: 0.9, exponent: 120, mirror: 0.12 }
        }
        Material::Stripes => matt(stripes(p)),
        Material::DarkMetal => {
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

/// Returns the reflectance of a matt surface: a faint highlight and no mirror image.
fn matt(albedo: DVec3) -> Reflectance {
    Reflectance { albedo, specular: 0.05, exponent: 12, mirror: 0.0 }
}

/// Returns the albedo of rings of tiles around the z axis, with dark joints, and of planks on faces
/// that don't point upwards.
fn tiles(p: DVec3, normal: DVec3, seed: u32) -> DVec3 {
    let radius = (p.x * p.x + p.y * p.y).sqrt();
    if normal.z < 0.5 {
        let plank = hash(cell(libm::atan2(p.y, p.x) * 12.0), 0, 1, seed);
        return DVec3::new(0.30, 0.17, 0.08) * (0.6 + 0.8 * plank);
    }
    let ring = cell(radius * 14.0);
    let tile_count = (2 * ring + 7) as f64;
    let turn = libm::atan2(p.y, p.x) / std::f64::consts::TAU + 0.5;
    let tile = cell(turn * tile_count);
    let is_joint = (radius * 14.0).fract().min((turn * tile_count).fract()) < 0.08;
    let tone = hash(ring, tile, 2, seed);
    let light = if (ring + tile) % 2 == 0 { 0.62 } else { 0.16 };
    let tint =
        DVec3::new(0.95, 0.93, 0.85).lerp(DVec3::new(0.35, 0.55, 0.75), hash(ring, tile, 3, seed));
    if is_joint { DVec3::splat(0.05) } else { tint * (light * (0.75 + 0.5 * tone)) }
}

/// Returns the albedo of a crate's faces: a frame around cells that are printed or not.
fn printed_crate(p: DVec3, normal: DVec3, seed: u32) -> DVec3 {
    // Coordinates in the plane of the face.
    let (u, v) = if normal.x.abs() > 0.5 {
        (p.y, p.z)
    } else if normal.y.abs() > 0.5 {
        (p.x, p.z)
    } else {
        (p.x, p.y)
    };
    // Number of the face, with a digit of -2, 0 or 1 for each coordinate of the normal.
    let face = cell(normal.x * 1.5) * 9 + cell(normal.y * 1.5) * 3 + cell(normal.z * 1.5);
    if u.abs().max(v.abs()) > 0.88 {
        return DVec3::new(0.45, 0.30, 0.10);
    }
    let is_printed = hash(cell(u * 11.0), cell(v * 11.0), face, seed) < 0.45;
    let ground =
        DVec3::new(0.75, 0.62, 0.30).lerp(DVec3::new(0.25, 0.60, 0.35), hash(face, 7, 7, seed));
    if is_printed { DVec3::new(0.04, 0.05, 0.10) } else { ground }
}

/// Returns the albedo of red with pale, wavy veins.
fn veins(p: DVec3, seed: u32) -> DVec3 {
    let wave = libm::sin(9.0 * p.x + 3.0 * libm::sin(5.0 * p.y + 2.0 * p.z) + f64::from(seed));
    let vein = (1.0 - wave.abs()).powi(6);
    DVec3::new(0.62, 0.05, 0.05).lerp(DVec3::new(0.85, 0.70, 0.55), 0.8 * vein)
}

/// Returns the albedo of wavy stripes across the z axis.
fn stripes(p: DVec3) -> DVec3 {
    let is_yellow = (p.z * 7.0 + 0.3 * libm::sin(6.0 * p.x)).floor().rem_euclid(2.0) < 1.0;
    if is_yellow { DVec3::new(0.85, 0.70, 0.10) } else { DVec3::new(0.08, 0.20, 0.50) }
}

/// Returns the albedo of a sign: rows of ink marks.
fn marks(p: DVec3, seed: u32) -> DVec3 {
    let line = cell(p.z * 6.0);
    let height = (p.z * 6.0).rem_euclid(1.0);
    let is_mark = hash(cell(p.x * 16.0), line, 11, seed) < 0.6;
    let is_ink = (0.25..0.8).contains(&height) && is_mark && p.x.abs() < 0.92 && p.z.abs() < 0.95;
    if is_ink { DVec3::new(0.55, 0.05, 0.10) } else { DVec3::new(0.80, 0.80, 0.74) }
}

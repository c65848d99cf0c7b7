use std::io::{self, Write};

use crate::coordinates::Coordinates;
use crate::ply::{Kind, write_floats, write_header};
use crate::surfel::Surfel;

/// Normals so many pixels from a silhouette may be wrong.
const UNSURE_PIXELS: u8 = 2;

/// The surfels that become points: all but those near silhouettes. Where there are no others, all.
pub(crate) fn chosen(surfels: &[Surfel]) -> Vec<Surfel> {
    let sure: Vec<Surfel> =
        surfels.iter().filter(|surfel| surfel.margin > UNSURE_PIXELS).copied().collect();
    if sure.is_empty() { surfels.to_vec() } else { sure }
}

/// Writes points with normals and 8-bit colours, display-encoded sRGB.
pub(crate) fn write(
    file: &mut impl Write,
    surfels: &[Surfel],
    coordinates: &Coordinates,
) -> io::Result<()> {
    let named = |names: [&str; 3], kind| names.map(|name| (name.to_owned(), kind));
    let properties = [
        named(["x", "y", "z"], Kind::Float),
        named(["nx", "ny", "nz"], Kind::Float),
        named(["red", "green", "blue"], Kind::Byte),
    ]
    .concat();
    write_header(file, &[coordinates.to_string()], surfels.len(), &properties)?;
    for surfel in surfels {
        write_floats(file, &surfel.position.as_vec3().to_array())?;
        write_floats(file, &surfel.normal.as_vec3().to_array())?;
        file.write_all(&level(surfel.colour))?;
    }
    Ok(())
}

/// A colour in 8 bits.
pub(crate) fn level(colour: [f32; 3]) -> [u8; 3] {
    colour.map(|v| (255.0 * v.clamp(0.0, 1.0) + 0.5) as u8)
}

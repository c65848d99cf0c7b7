use std::io::{self, Write};

use glam::{DQuat, DVec3};

use crate::coordinates::Coordinates;
use crate::ply::{Kind, write_floats, write_header};
use crate::surfel::Surfel;

/// The constant spherical harmonic.
const HARMONIC: f32 = 0.282_094_79;

/// Standard deviation of a disc along its surface, over the distance of neighbours: discs close the
/// surface, seen from however near.
const DISC_DEVIATION: f64 = 0.5;
/// Standard deviation along the normal, over that.
const FLATNESS: f64 = 0.1;
/// Opacity of a disc on an opaque surface. There are several in each square of the distance; more
/// of it widens edges, since viewers blur splats.
const DISC_OPACITY: f64 = 0.6;
/// Opacities written: a logit of 1 is infinite.
const OPACITY_BOUNDS: [f64; 2] = [0.02, 0.99];

/// Writes surfels as 3D Gaussians, in the PLY layout of Kerbl et al. 2023: position, normal, colour
/// as coefficient of the constant spherical harmonic, opacity as logit, standard deviations as
/// logarithms, rotation as quaternion with the real part first.
pub(crate) fn write(
    file: &mut impl Write,
    surfels: &[Surfel],
    coordinates: &Coordinates,
) -> io::Result<()> {
    let names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 \
        rot_2 rot_3";
    let properties: Vec<_> =
        names.split_whitespace().map(|name| (name.to_owned(), Kind::Float)).collect();
    write_header(file, &[coordinates.to_string()], surfels.len(), &properties)?;
    surfels.iter().try_for_each(|surfel| write_floats(file, &splat(surfel)))
}

/// The numbers of a splat: a disc whose third axis is the normal.
fn splat(surfel: &Surfel) -> [f32; 17] {
    let [x, y, z] = surfel.position.as_vec3().to_array();
    let [nx, ny, nz] = surfel.normal.as_vec3().to_array();
    let [r, g, b] = surfel.colour.map(|v| (v - 0.5) / HARMONIC);
    let opacity =
        (DISC_OPACITY * f64::from(surfel.opacity)).clamp(OPACITY_BOUNDS[0], OPACITY_BOUNDS[1]);
    let along = DISC_DEVIATION * surfel.spacing;
    let [along, across] = [along, FLATNESS * along].map(|deviation| deviation.ln() as f32);
    let turn = DQuat::from_rotation_arc(DVec3::Z, surfel.normal).as_quat();
    let logit = (opacity / (1.0 - opacity)).ln() as f32;
    [x, y, z, nx, ny, nz, r, g, b, logit, along, along, across, turn.w, turn.x, turn.y, turn.z]
}

use glam::DVec3;
use pixels::Image;
use radiance::{RayField, RenderError};
use scene::Camera;

use crate::cast::cast;
use crate::huber::huber;
use crate::pyramid::PyramidLevel;

/// A photograph, and the camera that took it.
#[derive(Clone, Copy, Debug)]
pub struct Shot<'a> {
    /// Its pixels are the photograph's.
    pub camera: &'a Camera,
    /// RGB over its background; NaN where nothing is known.
    pub photograph: &'a Image,
    /// What the photograph's channels are multiplied by to have the field's exposure.
    pub exposure: [f32; 3],
}

/// Photographs that are looked at, at most, spread over all.
const MOST_VIEWS: usize = 64;
/// Pixels of each that are looked at, at most, spread over all that tell something.
const MOST_PIXELS_PER_VIEW: usize = 1024;
/// Others that each is compared with: those that were taken from nearest by.
const NEIGHBOURS: usize = 2;
/// Of less than this opacity no surface is known.
const LEAST_SURFACE_OPACITY: f32 = 0.5;
/// Two distances of one surface differ by at most this share of them.
const SAME_DISTANCE_SHARE: f64 = 0.02;

/// Photometric error between photographs of the same surfaces: mean robust error (Huber's, of
/// colours) between what one shows and what its neighbours show there, where the field says that
/// they see it, too. None where it says so nowhere.
///
/// The field only says where surfaces are. So this tells good poses from bad ones even by fields
/// that learnt both photograph by photograph: such a field renders every photograph well, but its
/// surfaces lie where no two of them see the same.
pub fn photometric_error(
    field: &dyn RayField,
    shots: &[Shot<'_>],
    background: f32,
) -> Result<Option<f64>, RenderError> {
    let (mut sum, mut count) = (0.0, 0usize);
    for i in (0..shots.len()).step_by(shots.len().div_ceil(MOST_VIEWS).max(1)) {
        let places = surfaces(field, &shots[i], background)?;
        for other in neighbours(shots, i) {
            for error in errors(field, &places, other, background)? {
                (sum, count) = (sum + error, count + 1);
            }
        }
    }
    Ok((count > 0).then(|| sum / count as f64))
}

/// A place on a surface, and its colour in the photograph that it was seen in.
struct Place {
    at: DVec3,
    colour: [f32; 3],
}

/// Where a photograph's telling pixels show surfaces.
fn surfaces(
    field: &dyn RayField,
    shot: &Shot<'_>,
    background: f32,
) -> Result<Vec<Place>, RenderError> {
    let telling = PyramidLevel::new(shot.photograph).telling;
    let every = telling.len().div_ceil(MOST_PIXELS_PER_VIEW).max(1);
    let pixels: Vec<_> = telling.into_iter().step_by(every).collect();
    let places = pixels.iter().map(|pixel| [pixel.x as f64 + 0.5, pixel.y as f64 + 0.5]);
    let (lines, rays): (Vec<_>, Vec<_>) =
        places.map(|place| cast(shot.camera, place, background)).unzip();
    let seen = pixels.iter().zip(lines).zip(field.render(&rays)?);
    Ok(seen
        .filter(|(_, seen)| seen.opacity > LEAST_SURFACE_OPACITY && seen.median_depth.is_finite())
        .map(|((pixel, line), seen)| {
            let colour = [0, 1, 2].map(|c| pixel.colour[c] * shot.exposure[c]);
            Place { at: line.at(f64::from(seen.median_depth)), colour }
        })
        .collect())
}

/// The photographs that were taken from nearest by.
fn neighbours<'s, 'a>(shots: &'s [Shot<'a>], of: usize) -> impl Iterator<Item = &'s Shot<'a>> {
    let away = |i: usize| shots[i].camera.centre().distance_squared(shots[of].camera.centre());
    let mut others: Vec<usize> = (0..shots.len()).filter(|&i| i != of).collect();
    others.sort_by(|&a, &b| away(a).total_cmp(&away(b)));
    others.into_iter().take(NEIGHBOURS).map(|i| &shots[i])
}

/// Errors of each channel at the places that another photograph shows.
fn errors(
    field: &dyn RayField,
    places: &[Place],
    shot: &Shot<'_>,
    background: f32,
) -> Result<Vec<f64>, RenderError> {
    let (camera, k) = (shot.camera, &shot.camera.intrinsics);
    let (width, height) = (f64::from(k.width), f64::from(k.height));
    let is_inside = |[x, y]: &[f64; 2]| (0.0..width).contains(x) && (0.0..height).contains(y);
    let place_in = |at: DVec3| camera.project(at).map(|(x, y, _)| [x, y]).filter(is_inside);
    let (inside, at): (Vec<&Place>, Vec<[f64; 2]>) =
        places.iter().filter_map(|place| Some((place, place_in(place.at)?))).unzip();
    let rays: Vec<_> = at.iter().map(|&at| cast(camera, at, background).1).collect();
    let mut found = Vec::with_capacity(3 * rays.len());
    for ((place, [x, y]), seen) in inside.into_iter().zip(at).zip(field.render(&rays)?) {
        let distance = camera.centre().distance(place.at);
        let is_same =
            (f64::from(seen.median_depth) - distance).abs() <= SAME_DISTANCE_SHARE * distance;
        let colour = shot.photograph.colour_at([x as f32, y as f32]);
        if seen.opacity > LEAST_SURFACE_OPACITY && is_same && colour.iter().all(|v| v.is_finite()) {
            let error = |c: usize| huber(f64::from(colour[c] * shot.exposure[c] - place.colour[c]));
            found.extend([0, 1, 2].map(error));
        }
    }
    Ok(found)
}

use glam::DVec3;
use pixels::Image;
use radiance::{Pixel, Ray, RayField, RenderError};
use scene::Camera;

use crate::normal_matrix::huber;
use crate::pyramid::{PyramidLevel, pixel_rays};

/// Photograph with the camera that took it.
#[derive(Clone, Copy, Debug)]
pub struct PosedPhotograph<'a> {
    /// Camera with the photograph's size.
    pub camera: &'a Camera,
    /// RGB over the background; NaN in pixels that don't count.
    pub image: &'a Image,
    /// Factor per channel from the photograph's exposure to the field's.
    pub exposure: [f32; 3],
}

/// Maximum number of photographs compared, spread evenly over all; chosen by hand.
const MAX_VIEWS: usize = 64;
/// Maximum number of pixels compared per photograph, spread evenly over the informative ones;
/// chosen by hand.
const MAX_PIXELS_PER_VIEW: usize = 1024;
/// Number of nearest photographs that each one is compared with; chosen by hand.
const NEIGHBOURS: usize = 2;
/// Minimum opacity at which a pixel's depth is trusted.
const MIN_SURFACE_OPACITY: f32 = 0.5;
/// Maximum relative difference between a point's distance from a camera and the distance rendered
/// in its direction for the point to count as visible; chosen by hand.
const MAX_DISTANCE_DIFFERENCE: f64 = 0.02;

/// Returns the photometric error between photographs of the same surfaces: the mean Huber error of
/// colours between each photograph and its neighbours at surface points visible in both. `None` if
/// there are no such points.
///
/// The field gives only the surfaces. So the error tells good poses from bad ones even with a field
/// that over-fits each photograph: such a field's renders are good, but the photographs have
/// different colours at its surface points.
pub fn photometric_error(
    field: &dyn RayField,
    photographs: &[PosedPhotograph<'_>],
    background: f32,
) -> Result<Option<f64>, RenderError> {
    let mut sum = 0.0;
    let mut count = 0usize;
    for i in (0..photographs.len()).step_by(photographs.len().div_ceil(MAX_VIEWS).max(1)) {
        let points = surface_points(field, &photographs[i], background)?;
        for neighbour in neighbours(photographs, i) {
            for error in colour_errors(field, &points, neighbour, background)? {
                sum += error;
                count += 1;
            }
        }
    }
    Ok((count > 0).then(|| sum / count as f64))
}

/// Point of a surface, with its colour in the photograph that it was found in.
struct SurfacePoint {
    position: DVec3,
    colour: [f32; 3],
}

/// Finds the surface points in a photograph's informative pixels.
fn surface_points(
    field: &dyn RayField,
    photograph: &PosedPhotograph<'_>,
    background: f32,
) -> Result<Vec<SurfacePoint>, RenderError> {
    let pixels = PyramidLevel::new(photograph.image).pixels;
    let stride = pixels.len().div_ceil(MAX_PIXELS_PER_VIEW).max(1);
    let pixels: Vec<_> = pixels.into_iter().step_by(stride).collect();
    let (lines, rays) = pixel_rays(photograph.camera, &pixels, background);
    let mut points = Vec::new();
    for (i, render) in field.render(&rays)?.into_iter().enumerate() {
        if has_surface(&render) && render.median_depth.is_finite() {
            let position = lines[i].at(f64::from(render.median_depth));
            let colour = [0, 1, 2].map(|c| pixels[i].colour[c] * photograph.exposure[c]);
            points.push(SurfacePoint { position, colour });
        }
    }
    Ok(points)
}

/// Returns the photographs whose cameras are nearest to that of photograph `i`.
fn neighbours<'s, 'a>(
    photographs: &'s [PosedPhotograph<'a>],
    i: usize,
) -> impl Iterator<Item = &'s PosedPhotograph<'a>> {
    let mut others: Vec<(f64, usize)> = (0..photographs.len())
        .filter(|&k| k != i)
        .map(|k| {
            let centre = photographs[k].camera.centre();
            (centre.distance_squared(photographs[i].camera.centre()), k)
        })
        .collect();
    others.sort_by(|a, b| a.0.total_cmp(&b.0));
    others.into_iter().take(NEIGHBOURS).map(|(_, k)| &photographs[k])
}

/// Returns the errors of each channel at the surface points that are visible in `photograph`.
fn colour_errors(
    field: &dyn RayField,
    points: &[SurfacePoint],
    photograph: &PosedPhotograph<'_>,
    background: f32,
) -> Result<Vec<f64>, RenderError> {
    let camera = photograph.camera;
    let [width, height] = [camera.intrinsics.width, camera.intrinsics.height].map(f64::from);
    let mut inside_image = Vec::new();
    let mut rays = Vec::new();
    for point in points {
        if let Some((x, y, _)) = camera.project(point.position)
            && (0.0..width).contains(&x)
            && (0.0..height).contains(&y)
        {
            inside_image.push((point, [x as f32, y as f32]));
            rays.push(Ray::new(&camera.ray(x, y), [background; 3]));
        }
    }
    let mut errors = Vec::with_capacity(3 * rays.len());
    for (i, render) in field.render(&rays)?.into_iter().enumerate() {
        let (point, pixel) = inside_image[i];
        let distance = camera.centre().distance(point.position);
        let is_visible =
            (f64::from(render.median_depth) - distance).abs() <= MAX_DISTANCE_DIFFERENCE * distance;
        let colour = photograph.image.colour_at(pixel);
        if has_surface(&render) && is_visible && colour.iter().all(|v| v.is_finite()) {
            let difference = |c: usize| colour[c] * photograph.exposure[c] - point.colour[c];
            errors.extend([0, 1, 2].map(|c| huber(f64::from(difference(c)))));
        }
    }
    Ok(errors)
}

fn has_surface(render: &Pixel) -> bool {
    render.opacity > MIN_SURFACE_OPACITY
}

use glam::DVec3;
use pixels::{Rgba8, srgb_from_linear};
use stage::Progress;

use crate::camera::ViewCamera;
use crate::material::surface;
use crate::world::World;

/// A rendered view.
pub struct RenderedImage {
    /// Display-encoded sRGB with straight alpha.
    pub colour: Rgba8,
    /// z-depth of the first surface at each pixel's centre.
    pub depth: Vec<Option<f32>>,
}

/// Where the sun stands.
const SUN: DVec3 = DVec3::new(0.48, 0.36, 0.8);

/// Renders one view with `samples`² rays a pixel, averaged in linear light over the pixel's square.
/// Where the lens has no ray, the image is opaque and black.
pub(crate) fn render(
    world: &World,
    pose: &[[f64; 4]; 4],
    camera: &ViewCamera,
    samples: u32,
    progress: &Progress,
) -> RenderedImage {
    let [width, height] = camera.sides;
    let column = |c: usize| DVec3::new(pose[0][c], pose[1][c], pose[2][c]);
    let (axes, centre) = ([0, 1, 2].map(column), column(3));
    let back = axes[2];
    let mut colour = Vec::with_capacity((width * height * 4) as usize);
    let mut depth = Vec::with_capacity((width * height) as usize);
    for j in 0..height {
        for i in 0..width {
            let mut light = DVec3::ZERO;
            let mut hits = 0u32;
            for b in 0..samples {
                for a in 0..samples {
                    let offset = |k: u32| (f64::from(k) + 0.5) / f64::from(samples);
                    let place = [f64::from(i) + offset(a), f64::from(j) + offset(b)];
                    let radiance = match camera.direction(place, axes) {
                        Some(direction) => shade(world, centre, direction, 1),
                        None => Some(DVec3::ZERO),
                    };
                    if let Some(radiance) = radiance {
                        light += radiance;
                        hits += 1;
                    }
                }
            }
            let mean = if hits == 0 { DVec3::ZERO } else { light / f64::from(hits) };
            let level = |v: f64| (srgb_from_linear(v) * 255.0 + 0.5) as u8;
            let alpha = f64::from(hits) / f64::from(samples * samples);
            colour.extend([
                level(mean.x),
                level(mean.y),
                level(mean.z),
                (alpha * 255.0 + 0.5) as u8,
            ]);
            let middle = camera.direction([f64::from(i) + 0.5, f64::from(j) + 0.5], axes);
            depth.push(
                middle.and_then(|d| {
                    world.first_hit(centre, d).map(|hit| (hit.t * -d.dot(back)) as f32)
                }),
            );
        }
        progress.add(1);
    }
    RenderedImage { colour: Rgba8::new(width as usize, height as usize, colour), depth }
}

/// Light from the first surface along a ray, or from the sky; `None` where there is neither.
fn shade(world: &World, origin: DVec3, direction: DVec3, bounces: u32) -> Option<DVec3> {
    let Some(hit) = world.first_hit(origin, direction) else {
        return world.sky.then(|| sky_light(direction) * clouds(direction));
    };
    let point = origin + hit.t * direction;
    let normal = if hit.normal.dot(direction) > 0.0 { -hit.normal } else { hit.normal };
    let look = surface(hit.material, hit.local, hit.local_normal, world.seed);
    let start = point + 1e-4 * normal;
    let sun = normal.dot(SUN).max(0.0);
    let lit = if sun > 0.0 && !world.is_met(start, SUN) { sun } else { 0.0 };
    let sky = 0.32 + 0.18 * normal.z;
    let mut light =
        look.albedo * (DVec3::new(0.80, 0.76, 0.68) * lit + DVec3::new(0.85, 0.95, 1.10) * sky);
    let mirrored = direction - 2.0 * direction.dot(normal) * normal;
    if lit > 0.0 {
        light += look.specular * mirrored.dot(SUN).max(0.0).powi(look.exponent) * DVec3::ONE;
    }
    if look.mirror > 0.0 && bounces > 0 {
        let grazing = (1.0 + direction.dot(normal)).clamp(0.0, 1.0).powi(5);
        let share = look.mirror + (1.0 - look.mirror) * grazing * 0.5;
        let seen =
            shade(world, start, mirrored, bounces - 1).unwrap_or_else(|| sky_light(mirrored));
        light = light * (1.0 - share) + seen * share;
    }
    Some(light)
}

/// Bands of cloud, so that the sky has something to be seen by.
fn clouds(direction: DVec3) -> f64 {
    let azimuth = libm::atan2(direction.y, direction.x);
    1.0 + 0.25
        * libm::sin(7.0 * azimuth + 3.0 * libm::sin(9.0 * direction.z))
        * (1.0 - direction.z.abs())
}

/// What a mirror sees where nothing stands.
fn sky_light(direction: DVec3) -> DVec3 {
    DVec3::new(0.55, 0.52, 0.48)
        .lerp(DVec3::new(0.45, 0.65, 0.95), (0.5 + 0.5 * direction.z).clamp(0.0, 1.0))
}

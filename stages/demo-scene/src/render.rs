use glam::DVec3;
use pixels::{Rgba8, srgb_from_linear};
use stage::Progress;

use crate::camera::ViewCamera;
use crate::material::reflectance;
use crate::world::World;

/// Rendered view.
pub struct RenderedImage {
    /// Display-encoded sRGB with straight alpha.
    pub colour: Rgba8,
    /// Camera-space z-depth of the first surface at each pixel's centre, in scene units.
    pub depth: Vec<Option<f32>>,
}

/// Direction of the sun, of unit length.
const SUN: DVec3 = DVec3::new(0.48, 0.36, 0.8);

/// Renders a view with `samples`² rays per pixel, averaged in linear light over the pixel's area.
/// Outside the lens's field of view the image is opaque and black.
pub(crate) fn render(
    world: &World,
    pose: &[[f64; 4]; 4],
    camera: &ViewCamera,
    samples: u32,
    progress: &Progress,
) -> RenderedImage {
    let [width, height] = camera.sides;
    let [right, up, back, centre] =
        [0, 1, 2, 3].map(|column| DVec3::new(pose[0][column], pose[1][column], pose[2][column]));
    let view = PosedView { world, camera, axes: [right, up, back], centre };
    let mut colour = Vec::with_capacity((width * height * 4) as usize);
    let mut depth = Vec::with_capacity((width * height) as usize);
    for row in 0..height {
        for column in 0..width {
            colour.extend(view.pixel_colour(column, row, samples));
            depth.push(view.pixel_depth(column, row));
        }
        progress.add(1);
    }
    RenderedImage { colour: Rgba8::new(width as usize, height as usize, colour), depth }
}

/// World with a posed camera.
struct PosedView<'a> {
    world: &'a World,
    camera: &'a ViewCamera,
    /// Camera axes in the world: right, up, back.
    axes: [DVec3; 3],
    centre: DVec3,
}

impl PosedView<'_> {
    /// Returns a pixel's display-encoded colour and its alpha.
    fn pixel_colour(&self, column: u32, row: u32, samples: u32) -> [u8; 4] {
        let mut light = DVec3::ZERO;
        let mut opaque_rays = 0u32;
        for b in 0..samples {
            for a in 0..samples {
                let position = [
                    f64::from(column) + (f64::from(a) + 0.5) / f64::from(samples),
                    f64::from(row) + (f64::from(b) + 0.5) / f64::from(samples),
                ];
                let radiance = match self.camera.direction(position, self.axes) {
                    Some(direction) => radiance(self.world, self.centre, direction, 1),
                    None => Some(DVec3::ZERO),
                };
                if let Some(radiance) = radiance {
                    light += radiance;
                    opaque_rays += 1;
                }
            }
        }
        let mean = if opaque_rays == 0 { DVec3::ZERO } else { light / f64::from(opaque_rays) };
        let [r, g, b] = mean.to_array().map(|v| (srgb_from_linear(v) * 255.0 + 0.5) as u8);
        let alpha = f64::from(opaque_rays) / f64::from(samples * samples);
        [r, g, b, (alpha * 255.0 + 0.5) as u8]
    }

    /// Returns the z-depth at a pixel's centre.
    fn pixel_depth(&self, column: u32, row: u32) -> Option<f32> {
        let position = [f64::from(column) + 0.5, f64::from(row) + 0.5];
        let direction = self.camera.direction(position, self.axes)?;
        let hit = self.world.first_hit(self.centre, direction)?;
        Some((hit.t * -direction.dot(self.axes[2])) as f32)
    }
}

/// Returns the light from the first surface along a ray, or from the sky; `None` if the ray hits
/// nothing and there is no sky.
fn radiance(world: &World, origin: DVec3, direction: DVec3, bounces: u32) -> Option<DVec3> {
    let Some(hit) = world.first_hit(origin, direction) else {
        return world.has_sky.then(|| sky_light(direction) * cloud_brightness(direction));
    };
    let point = origin + hit.t * direction;
    let normal = if hit.normal.dot(direction) > 0.0 { -hit.normal } else { hit.normal };
    let surface = reflectance(hit.material, hit.local, hit.local_normal, world.seed);
    let start = point + 1e-4 * normal;
    let facing_sun = normal.dot(SUN).max(0.0);
    let is_lit = facing_sun > 0.0 && !world.is_hit(start, SUN);
    let sun = if is_lit { facing_sun } else { 0.0 };
    let sky = 0.32 + 0.18 * normal.z;
    let mut light =
        surface.albedo * (DVec3::new(0.80, 0.76, 0.68) * sun + DVec3::new(0.85, 0.95, 1.10) * sky);
    let mirrored = direction - 2.0 * direction.dot(normal) * normal;
    if is_lit {
        let highlight = mirrored.dot(SUN).max(0.0).powi(surface.exponent);
        light += surface.specular * highlight * DVec3::ONE;
    }
    if surface.mirror > 0.0 && bounces > 0 {
        let grazing = (1.0 + direction.dot(normal)).clamp(0.0, 1.0).powi(5);
        let weight = surface.mirror + (1.0 - surface.mirror) * grazing * 0.5;
        let reflection =
            radiance(world, start, mirrored, bounces - 1).unwrap_or_else(|| sky_light(mirrored));
        light = light * (1.0 - weight) + reflection * weight;
    }
    Some(light)
}

/// Returns the brightness of bands of cloud, which give the sky texture.
fn cloud_brightness(direction: DVec3) -> f64 {
    let azimuth = libm::atan2(direction.y, direction.x);
    1.0 + 0.25
        * libm::sin(7.0 * azimuth + 3.0 * libm::sin(9.0 * direction.z))
        * (1.0 - direction.z.abs())
}

/// Returns the sky's light without clouds; mirrors reflect it even in a scene without a sky.
fn sky_light(direction: DVec3) -> DVec3 {
    DVec3::new(0.55, 0.52, 0.48)
        .lerp(DVec3::new(0.45, 0.65, 0.95), (0.5 + 0.5 * direction.z).clamp(0.0, 1.0))
}

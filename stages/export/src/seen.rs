use std::ops::Range;

use glam::{DMat3, DVec3, Mat3, Vec3};
use radiance::{Pixel, Ray, RayField};
use scene::{Background, Camera, Intrinsics};
use stage::Progress;

/// Rays that are cast at once.
const RAYS_AT_ONCE: usize = 1 << 16;
/// A pixel shows a surface where so much of its ray is stopped.
const LEAST_OPACITY: f32 = 0.5;
/// Neighbouring pixels show one surface where their depths differ by at most so many pixel widths:
/// slants of up to 80°.
const MOST_DEPTH_STEP: f32 = 6.0;
/// A normal is known by so many pixels to each side: more than noise, less than what is thin.
const BASELINE_PIXELS: usize = 4;

/// A view's surface, seen by a pinhole camera.
pub(crate) struct SeenView {
    intrinsics: Intrinsics,
    /// Camera axes (x right, y up, looking along -z) as columns, in the world.
    axes: DMat3,
    /// Centre, in the frame of the exported files.
    centre: DVec3,
    /// World to camera axes, and focal lengths and principal point, for quick looks.
    to_camera: Mat3,
    lens: [f32; 4],
    pixels: Vec<SeenPixel>,
}

/// What a pixel shows.
#[derive(Clone, Copy)]
pub(crate) struct SeenPixel {
    /// Camera-space z-depth of the surface; 0 where there is none.
    pub(crate) depth: f32,
    /// The surface's normal in camera space, towards the camera; zero where depth jumps.
    pub(crate) normal: Vec3,
    /// Colour of the surface alone.
    pub(crate) colour: [u8; 3],
    /// Share of the ray that is stopped, in parts of 255.
    pub(crate) opacity: u8,
    /// Whether something nearer ends beside it: up to where isn't known to a pixel's width.
    pub(crate) is_edge: bool,
    /// For how many pixels its surface goes on to each side in its row and its column, up to
    /// [`BASELINE_PIXELS`].
    pub(crate) margin: u8,
}

/// What a view says of a world point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Sight {
    /// Nothing: it lies outside of the image, behind something, or at the edge of something.
    Hidden,
    /// The line of sight goes on behind it: nothing is there.
    Empty,
    /// A surface is near.
    Surface {
        /// Distance from the surface's tangent plane; above 0 on the camera's side.
        distance: f32,
        /// Cosine of the angle between normal and line of sight.
        cosine: f32,
        /// The pixel.
        index: usize,
    },
}

impl SeenView {
    /// Bytes of a pixel.
    pub(crate) const BYTES_PER_PIXEL: u64 = size_of::<SeenPixel>() as u64;

    /// Casts a ray through each pixel's centre of a camera without its lens's distortion. The view
    /// is in the frame of the exported files, whose origin in the world is `offset`.
    pub(crate) fn render(
        field: &dyn RayField,
        camera: &Camera,
        background: Background,
        offset: DVec3,
        progress: &Progress,
    ) -> anyhow::Result<Self> {
        let intrinsics = camera.intrinsics.pinhole().unwrap_or(camera.intrinsics);
        let camera = Camera { intrinsics, ..camera.clone() };
        let count = intrinsics.width as usize * intrinsics.height as usize;
        let mut seen = Self {
            intrinsics,
            axes: camera.rotation(),
            centre: camera.centre() - offset,
            to_camera: camera.rotation().transpose().as_mat3(),
            lens: [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy].map(|v| v as f32),
            pixels: Vec::with_capacity(count),
        };
        for first in (0..count).step_by(RAYS_AT_ONCE) {
            let pixels = first..(first + RAYS_AT_ONCE).min(count);
            progress.add(pixels.len() as u64);
            seen.cast(field, &camera, background, pixels)?;
        }
        seen.find_normals();
        Ok(seen)
    }

    fn cast(
        &mut self,
        field: &dyn RayField,
        camera: &Camera,
        background: Background,
        pixels: Range<usize>,
    ) -> anyhow::Result<()> {
        let width = self.intrinsics.width as usize;
        let (camera_rays, background) = (camera.rays(), [background.shown(); 3]);
        let (rays, to_z): (Vec<Ray>, Vec<f32>) = pixels
            .map(|i| {
                let ray = camera_rays.ray((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
                (Ray::new(&ray, background), camera.depth_per_distance(&ray) as f32)
            })
            .unzip();
        let rendered = field.render(&rays).map_err(fields::rendering_failure)?;
        self.pixels.extend(rendered.iter().zip(to_z).map(|(pixel, to_z)| seen(pixel, to_z)));
        Ok(())
    }

    /// Normals by the differences of neighbouring points, and edges.
    fn find_normals(&mut self) {
        let (width, height) = (self.intrinsics.width as usize, self.intrinsics.height as usize);
        for y in 0..height {
            for x in 0..width {
                let at = y * width + x;
                let beside = [(x > 0).then(|| at - 1), (x + 1 < width).then_some(at + 1)];
                let above = [at.checked_sub(width), (y + 1 < height).then_some(at + width)];
                let is_nearer = |other: usize| self.is_nearer(other, at);
                self.pixels[at].is_edge = beside.into_iter().chain(above).flatten().any(is_nearer);
                let along = self.tangent(at, (x, width), 1);
                let down = self.tangent(at, (y, height), width);
                let (Some((along, in_row)), Some((down, in_column))) = (along, down) else {
                    continue;
                };
                self.pixels[at].margin = in_row.min(in_column);
                // Lengths may be so small or large that their squares leave single precision.
                let normal = along.as_dvec3().cross(down.as_dvec3()).normalize_or_zero().as_vec3();
                let towards = if normal.dot(self.point(at)) > 0.0 { -normal } else { normal };
                self.pixels[at].normal = towards;
            }
        }
    }

    /// The way along the surface from before a pixel to behind it, in a row or a column. Also
    /// returns for how many pixels the surface goes on to both sides. `None` where it ends on both.
    /// `place` is the pixel's place in its line and the line's length, `stride` the distance of the
    /// line's pixels.
    fn tangent(
        &self,
        at: usize,
        (place, length): (usize, usize),
        stride: usize,
    ) -> Option<(Vec3, u8)> {
        let step = stride.cast_signed();
        let before = self.last_of_surface(at, place, -step);
        let after = self.last_of_surface(at, length - 1 - place, step);
        let way = self.point(after) - self.point(before);
        let margin = (at - before).min(after - at) / stride;
        (before != after).then_some((way, margin as u8))
    }

    /// The farthest pixel within [`BASELINE_PIXELS`] that still shows a pixel's surface, `room`
    /// pixels before the image ends.
    fn last_of_surface(&self, at: usize, room: usize, stride: isize) -> usize {
        let mut last = at;
        for _ in 0..room.min(BASELINE_PIXELS) {
            let next = last.wrapping_add_signed(stride);
            if !self.goes_on(last, next) {
                break;
            }
            last = next;
        }
        last
    }

    /// Whether two neighbours show one surface.
    fn goes_on(&self, at: usize, other: usize) -> bool {
        let [depth, there] = [at, other].map(|i| self.pixels[i].depth);
        depth > 0.0 && there > 0.0 && (there - depth).abs() <= self.jump(depth)
    }

    /// Whether a pixel shows a surface well before another's, or where that has none.
    fn is_nearer(&self, other: usize, than: usize) -> bool {
        let [there, depth] = [other, than].map(|i| self.pixels[i].depth);
        there > 0.0 && (depth == 0.0 || there < depth - self.jump(depth))
    }

    /// Difference of two neighbours' depths up to which they show one surface.
    fn jump(&self, depth: f32) -> f32 {
        MOST_DEPTH_STEP * depth / self.intrinsics.fx.min(self.intrinsics.fy) as f32
    }

    /// A pixel's surface point in camera space.
    fn point(&self, at: usize) -> Vec3 {
        let k = &self.intrinsics;
        let (x, y) = ((at % k.width as usize) as f64 + 0.5, (at / k.width as usize) as f64 + 0.5);
        let depth = f64::from(self.pixels[at].depth);
        DVec3::new((x - k.cx) / k.fx, -(y - k.cy) / k.fy, -1.0).as_vec3() * depth as f32
    }

    /// The pixels that show a surface with a normal: index, pixel.
    pub(crate) fn surface(&self) -> impl Iterator<Item = (usize, &SeenPixel)> {
        self.pixels.iter().enumerate().filter(|(_, pixel)| pixel.normal != Vec3::ZERO)
    }

    pub(crate) fn pixel(&self, at: usize) -> &SeenPixel {
        &self.pixels[at]
    }

    /// A pixel's surface point in the frame of the exported files.
    pub(crate) fn world_point(&self, at: usize) -> DVec3 {
        self.centre + self.axes * self.point(at).as_dvec3()
    }

    /// A pixel's normal in the world.
    pub(crate) fn world_normal(&self, at: usize) -> DVec3 {
        self.axes * self.pixels[at].normal.as_dvec3()
    }

    /// Cosine between a pixel's normal and its line of sight.
    pub(crate) fn cosine(&self, at: usize) -> f32 {
        -self.pixels[at].normal.dot(self.point(at).normalize_or_zero())
    }

    /// Moves a pixel's point along its line of sight, so that it comes to lie on a plane that is so
    /// far away along its normal.
    pub(crate) fn move_along_normal(&mut self, at: usize, distance: f32) {
        let along = -self.pixels[at].normal.dot(self.point(at)) / self.pixels[at].depth;
        // Aslant, that is far; the surface may end before.
        self.pixels[at].depth -= distance / along.max(0.5);
    }

    /// Makes a pixel one that says nothing of a surface.
    pub(crate) fn forget(&mut self, at: usize) {
        self.pixels[at].normal = Vec3::ZERO;
    }

    /// The camera's centre in the frame of the exported files.
    pub(crate) fn centre(&self) -> DVec3 {
        self.centre
    }

    /// The camera's right, unit length, in the world.
    pub(crate) fn right(&self) -> DVec3 {
        self.axes.x_axis
    }

    /// Width of a pixel at its surface's depth, in scene units.
    pub(crate) fn footprint(&self, at: usize) -> f64 {
        f64::from(self.pixels[at].depth) / self.intrinsics.fx
    }

    /// What this view says of a point in the frame of the exported files, where surfaces count up to a distance `reach`.
    pub(crate) fn look(&self, point: DVec3, reach: f32) -> Sight {
        let place = self.to_camera * (point - self.centre).as_vec3();
        let depth = -place.z;
        if depth <= 0.0 {
            return Sight::Hidden;
        }
        let [fx, fy, cx, cy] = self.lens;
        let (x, y) = (cx + fx * place.x / depth, cy - fy * place.y / depth);
        let (width, height) = (self.intrinsics.width, self.intrinsics.height);
        if !(x >= 0.0 && y >= 0.0 && x < width as f32 && y < height as f32) {
            return Sight::Hidden;
        }
        let index = y as usize * width as usize + x as usize;
        let pixel = &self.pixels[index];
        if pixel.depth == 0.0 || pixel.depth - depth > 4.0 * reach {
            return if pixel.is_edge { Sight::Hidden } else { Sight::Empty };
        }
        if pixel.normal == Vec3::ZERO || pixel.depth - depth < -4.0 * reach {
            return Sight::Hidden;
        }
        let middle = [(x.floor() + 0.5 - cx) / fx, -(y.floor() + 0.5 - cy) / fy];
        let surface = Vec3::new(middle[0], middle[1], -1.0) * pixel.depth;
        let distance = pixel.normal.dot(place - surface);
        if distance.abs() > reach {
            return if distance > 0.0 { Sight::Empty } else { Sight::Hidden };
        }
        let cosine = -pixel.normal.dot(place) / place.length();
        Sight::Surface { distance, cosine, index }
    }
}

fn seen(pixel: &Pixel, to_z: f32) -> SeenPixel {
    let shows = pixel.opacity >= LEAST_OPACITY;
    let level = |v: f32| (255.0 * v.clamp(0.0, 1.0) + 0.5) as u8;
    SeenPixel {
        depth: if shows { pixel.median_depth * to_z } else { 0.0 },
        normal: Vec3::ZERO,
        colour: pixel.premultiplied.map(|v| level(v / pixel.opacity.max(LEAST_OPACITY))),
        opacity: level(pixel.opacity),
        is_edge: false,
        margin: 0,
    }
}

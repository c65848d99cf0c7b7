use std::ops::Range;

use fields::{pixel_rays, rendering_failure};
use glam::{DMat3, DVec3, Mat3, Vec3};
use pixels::to_u8;
use radiance::{Pixel, RayField};
use scene::{Background, Camera, Intrinsics};
use stage::Progress;

/// Number of rays that are rendered together; chosen by hand.
const RAYS_PER_BATCH: usize = 1 << 16;
/// Minimum opacity of a pixel with a surface: half of its light is stopped, so median depth exists.
const MIN_OPACITY: f32 = 0.5;
/// Maximum depth difference, in pixel widths, of neighbouring pixels of one surface: slants of up
/// to 80°.
const MAX_DEPTH_STEP_PIXELS: f32 = 6.0;
/// Maximum number of pixels to each side from which a normal is computed: enough to average out
/// noise, but fewer than thin objects are wide (design note 043).
const MAX_BASELINE_PIXELS: usize = 4;

/// Surface points and normals of a view, rendered by a pinhole camera.
pub(crate) struct SurfaceView {
    intrinsics: Intrinsics,
    /// Camera axes (x right, y up, looking along -z) as columns, in the world.
    pub(crate) axes: DMat3,
    /// Centre, in the frame of the exported files.
    pub(crate) centre: DVec3,
    /// Rotation from world to camera axes in single precision, for [`SurfaceView::point_state`].
    to_camera: Mat3,
    /// Focal lengths and principal point in single precision: fx, fy, cx, cy.
    lens: [f32; 4],
    pub(crate) pixels: Vec<SurfacePixel>,
}

/// Pixel of a [`SurfaceView`].
#[derive(Clone, Copy)]
pub(crate) struct SurfacePixel {
    /// Camera-space z-depth of the surface; 0 without a surface.
    pub(crate) depth: f32,
    /// Unit normal of the surface in camera space, towards the camera; zero at depth jumps.
    pub(crate) normal: Vec3,
    /// Colour of the surface, without the background.
    pub(crate) colour: [u8; 3],
    /// Opacity, from 0 to 255.
    pub(crate) opacity: u8,
    /// True if a neighbouring pixel has a nearer surface, whose silhouette is known only to a
    /// pixel.
    pub(crate) is_edge: bool,
    /// Number of pixels to the nearest end of the surface in the pixel's row and column, at most
    /// [`MAX_BASELINE_PIXELS`].
    pub(crate) margin: u8,
}

// Estimates before a run rely on this size.
const _: () = assert!(size_of::<SurfacePixel>() as u64 == workload::SURFACE_PIXEL_BYTES);

/// State of a world point in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum PointState {
    /// The point is outside the image, behind a surface, or at a silhouette.
    Hidden,
    /// The point is in front of the observed surface.
    Empty,
    /// The point is near the observed surface.
    Surface {
        /// Distance from the surface's tangent plane; above 0 on the camera's side.
        distance: f32,
        /// Cosine of the angle between normal and line of sight.
        cosine: f32,
        /// Index of the pixel.
        index: usize,
    },
}

impl SurfaceView {
    /// Renders one ray per pixel of a camera without its lens distortion. The view is in the frame
    /// of the exported files, whose origin in the world is `offset`.
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
        let mut view = Self {
            intrinsics,
            axes: camera.rotation(),
            centre: camera.centre() - offset,
            to_camera: camera.rotation().transpose().as_mat3(),
            lens: [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy].map(|v| v as f32),
            pixels: Vec::with_capacity(count),
        };
        for first in (0..count).step_by(RAYS_PER_BATCH) {
            let pixels = first..(first + RAYS_PER_BATCH).min(count);
            progress.add(pixels.len() as u64);
            view.render_pixels(field, &camera, background, pixels)?;
        }
        view.compute_normals();
        Ok(view)
    }

    /// Renders the next pixels.
    fn render_pixels(
        &mut self,
        field: &dyn RayField,
        camera: &Camera,
        background: Background,
        pixels: Range<usize>,
    ) -> anyhow::Result<()> {
        let width = self.intrinsics.width as usize;
        let positions: Vec<_> = pixels.map(|i| [i % width, i / width]).collect();
        let (rays, z_per_distance) = pixel_rays(camera, background, &positions, 1);
        let rendered = field.render(&rays).map_err(rendering_failure)?;
        for (pixel, z_per_distance) in rendered.iter().zip(z_per_distance) {
            self.pixels.push(surface_pixel(pixel, z_per_distance));
        }
        Ok(())
    }

    /// Computes normals from the differences of neighbouring points, and finds edges.
    fn compute_normals(&mut self) {
        let (width, height) = (self.intrinsics.width as usize, self.intrinsics.height as usize);
        for y in 0..height {
            for x in 0..width {
                let index = y * width + x;
                let neighbours = [
                    (x > 0).then(|| index - 1),
                    (x + 1 < width).then_some(index + 1),
                    index.checked_sub(width),
                    (y + 1 < height).then_some(index + width),
                ];
                self.pixels[index].is_edge =
                    neighbours.into_iter().flatten().any(|other| self.is_nearer(other, index));
                let across = self.tangent(index, (x, width), 1);
                let down = self.tangent(index, (y, height), width);
                let (Some((across, row_margin)), Some((down, column_margin))) = (across, down)
                else {
                    continue;
                };
                self.pixels[index].margin = row_margin.min(column_margin);
                // In f64, since squares of tiny or huge lengths leave the range of f32.
                let normal = across.as_dvec3().cross(down.as_dvec3()).normalize_or_zero().as_vec3();
                let faces_away = normal.dot(self.point(index)) > 0.0;
                self.pixels[index].normal = if faces_away { -normal } else { normal };
            }
        }
    }

    /// Returns the vector along the surface between the pixels before and after a pixel in its row
    /// or column, and the pixel's margin in that line; `None` if the surface is one pixel wide. The
    /// pixel is at `position` in a line of `length` pixels with indices `stride` apart.
    fn tangent(
        &self,
        index: usize,
        (position, length): (usize, usize),
        stride: usize,
    ) -> Option<(Vec3, u8)> {
        let step = stride.cast_signed();
        let before = self.last_of_surface(index, position, -step);
        let after = self.last_of_surface(index, length - 1 - position, step);
        let tangent = self.point(after) - self.point(before);
        let margin = (index - before).min(after - index) / stride;
        (before != after).then_some((tangent, margin as u8))
    }

    /// Returns the farthest pixel of the same surface in one direction: at most
    /// [`MAX_BASELINE_PIXELS`] away, and at most `available` pixels, the distance to the image's
    /// border.
    fn last_of_surface(&self, index: usize, available: usize, stride: isize) -> usize {
        let mut last = index;
        for _ in 0..available.min(MAX_BASELINE_PIXELS) {
            let next = last.wrapping_add_signed(stride);
            if !self.is_same_surface(last, next) {
                break;
            }
            last = next;
        }
        last
    }

    /// Returns whether two neighbours have the same surface.
    fn is_same_surface(&self, index: usize, other: usize) -> bool {
        let (depth, other) = (self.pixels[index].depth, self.pixels[other].depth);
        depth > 0.0 && other > 0.0 && (other - depth).abs() <= self.max_depth_step(depth)
    }

    /// Returns whether a pixel has a surface and its neighbour has none, or one that is farther
    /// away.
    fn is_nearer(&self, index: usize, neighbour: usize) -> bool {
        let (depth, other) = (self.pixels[index].depth, self.pixels[neighbour].depth);
        depth > 0.0 && (other == 0.0 || depth < other - self.max_depth_step(other))
    }

    /// Returns the maximum depth difference of neighbouring pixels of one surface.
    fn max_depth_step(&self, depth: f32) -> f32 {
        MAX_DEPTH_STEP_PIXELS * depth / self.intrinsics.fx.min(self.intrinsics.fy) as f32
    }

    /// Returns a pixel's surface point in camera space.
    fn point(&self, index: usize) -> Vec3 {
        let k = &self.intrinsics;
        let x = (index % k.width as usize) as f64 + 0.5;
        let y = (index / k.width as usize) as f64 + 0.5;
        let direction = DVec3::new((x - k.cx) / k.fx, -(y - k.cy) / k.fy, -1.0);
        direction.as_vec3() * self.pixels[index].depth
    }

    /// Returns the indices and pixels that have a surface with a normal.
    pub(crate) fn surface_pixels(&self) -> impl Iterator<Item = (usize, &SurfacePixel)> {
        self.pixels.iter().enumerate().filter(|(_, pixel)| pixel.normal != Vec3::ZERO)
    }

    /// Returns a pixel's surface point in the frame of the exported files.
    pub(crate) fn world_point(&self, index: usize) -> DVec3 {
        self.centre + self.axes * self.point(index).as_dvec3()
    }

    /// Returns a pixel's normal in the world.
    pub(crate) fn world_normal(&self, index: usize) -> DVec3 {
        self.axes * self.pixels[index].normal.as_dvec3()
    }

    /// Returns the cosine between a pixel's normal and its line of sight.
    pub(crate) fn cosine(&self, index: usize) -> f32 {
        -self.pixels[index].normal.dot(self.point(index).normalize_or_zero())
    }

    /// Moves a pixel's point along its line of sight to the tangent plane that is shifted by
    /// `distance` along the normal.
    pub(crate) fn move_along_normal(&mut self, index: usize, distance: f32) {
        let along = -self.pixels[index].normal.dot(self.point(index)) / self.pixels[index].depth;
        // At grazing angles the shift is limited, because the surface may end before the line of
        // sight hits the shifted plane.
        self.pixels[index].depth -= distance / along.max(0.5);
    }

    /// Excludes a pixel from the surfaces by a zero normal. Its depth stays and hides points
    /// behind it.
    pub(crate) fn remove_surface(&mut self, index: usize) {
        self.pixels[index].normal = Vec3::ZERO;
    }

    /// Returns the width of a pixel at its surface's depth, in scene units.
    pub(crate) fn pixel_width(&self, index: usize) -> f64 {
        f64::from(self.pixels[index].depth) / self.intrinsics.fx
    }

    /// Returns the state in this view of a point in the frame of the exported files. Points within
    /// `max_distance` of the surface are near the surface.
    pub(crate) fn point_state(&self, point: DVec3, max_distance: f32) -> PointState {
        let point = self.to_camera * (point - self.centre).as_vec3();
        let depth = -point.z;
        if depth <= 0.0 {
            return PointState::Hidden;
        }
        let [fx, fy, cx, cy] = self.lens;
        let (x, y) = (cx + fx * point.x / depth, cy - fy * point.y / depth);
        let (width, height) = (self.intrinsics.width, self.intrinsics.height);
        if !(x >= 0.0 && y >= 0.0 && x < width as f32 && y < height as f32) {
            return PointState::Hidden;
        }
        let index = y as usize * width as usize + x as usize;
        let pixel = &self.pixels[index];
        if pixel.depth == 0.0 || pixel.depth - depth > MAX_DEPTH_RATIO * max_distance {
            return if pixel.is_edge { PointState::Hidden } else { PointState::Empty };
        }
        if pixel.normal == Vec3::ZERO || pixel.depth - depth < -MAX_DEPTH_RATIO * max_distance {
            return PointState::Hidden;
        }
        let (u, v) = ((x.floor() + 0.5 - cx) / fx, -(y.floor() + 0.5 - cy) / fy);
        let surface = Vec3::new(u, v, -1.0) * pixel.depth;
        let distance = pixel.normal.dot(point - surface);
        if distance.abs() > max_distance {
            return if distance > 0.0 { PointState::Empty } else { PointState::Hidden };
        }
        let cosine = -pixel.normal.dot(point) / point.length();
        PointState::Surface { distance, cosine, index }
    }
}

/// Maximum ratio of the difference in depth between a point and the point's pixel to the maximum
/// distance from the surface: as on surfaces slanted by 76°; source not recorded.
const MAX_DEPTH_RATIO: f32 = 4.0;

/// Converts a rendered pixel; `z_per_distance` is z-depth per distance along the pixel's ray.
fn surface_pixel(pixel: &Pixel, z_per_distance: f32) -> SurfacePixel {
    let has_surface = pixel.opacity >= MIN_OPACITY;
    SurfacePixel {
        depth: if has_surface { pixel.median_depth * z_per_distance } else { 0.0 },
        normal: Vec3::ZERO,
        colour: pixel.premultiplied.map(|v| to_u8(v / pixel.opacity.max(MIN_OPACITY))),
        opacity: to_u8(pixel.opacity),
        is_edge: false,
        margin: 0,
    }
}

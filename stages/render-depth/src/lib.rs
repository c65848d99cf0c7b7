//! `render-depth`: colour, opacity and depth of a field, for any list of cameras at any size.
//!
//! A field may have several members, trained independently or fine-tuned from another member. Their
//! renders are averaged, since their errors are partly independent (design note 011).
//!
//! Adaptive sampling (Whitted 1980): a pixel in a smooth part of a view has one ray through its
//! centre, any other pixel several ([`Params::tolerance`]).
//!
//! Every view becomes an EXR (R, G, B, A in half precision, `Z` in single) and a PNG preview. Rows
//! are rendered and written in bands of sixteen, so memory doesn't grow with the image.

use std::ops::Range;

use anyhow::Context as _;
use artifact::{format_amount, format_count};
use fields::{FieldArtifact, lower_median, mean, pixel_rays};
use pixels::{PngRows, to_u8};
use radiance::RayField;
use rayon::prelude::*;
use scene::{
    Background, Camera, VIEW_CHANNELS, VIEWS_FILE, View, Views, image_file, preview_file,
    write_view_image,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Stage};

/// Parameters of `render-depth`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Width of the views; heights follow the cameras' aspect ratio. Default: the cameras' size.
    #[schemars(range(min = 1, max = 65536), extend("x-default" = "by camera"))]
    pub size: Option<u32>,
    /// Rays along each side of a pixel. 1 casts one ray through the pixel's centre; a larger n
    /// casts n × n further rays. The colour is then the mean of the centre's colour and the further
    /// rays' mean. The depth is the lower median of the further rays' depths.
    #[schemars(range(min = 1, max = 8))]
    pub samples_per_axis: u32,
    /// Maximum error of colour or opacity of a pixel with one ray; pixels with a larger error get
    /// all rays. The error is estimated from the pixel's neighbours; the estimate is an upper bound
    /// where the image is locally quadratic. 0 casts all rays everywhere.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub tolerance: f64,
}

impl Default for Params {
    fn default() -> Self {
        Self { size: None, samples_per_axis: 2, tolerance: 0.0025 }
    }
}

/// Stage `render-depth`.
pub struct RenderDepth;

impl Stage for RenderDepth {
    type Params = Params;
    const NAME: &'static str = "render-depth";
    const SUMMARY: &'static str =
        "Renders colour, opacity and depth of a field for a list of cameras.";
    const LIBTORCH: bool = cfg!(feature = "torch");
    const ENVIRONMENT: &'static [&'static str] = fields::ENVIRONMENT;

    fn inputs() -> Vec<(&'static str, Input)> {
        let cameras =
            ["scene/cameras", "scene/truth", "scene/train", "scene/references", "cameras", "views"];
        vec![
            ("field", Input::required(&["field"], "a trained field")),
            ("cameras", Input::required(&cameras, "cameras to render (views.json)")),
        ]
    }

    fn output() -> Output {
        Output::kind("views")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let FieldArtifact { file, fields } =
            FieldArtifact::read(context.input("field")?, &context.device)?;
        let cameras = Views::read(context.input("cameras")?)?;
        let resized: Vec<Camera> =
            cameras.views.iter().map(|v| resize(&v.camera, params.size)).collect();
        let (mut rows, mut pixels) = (0, 0);
        for camera in &resized {
            let k = camera.intrinsics;
            rows += u64::from(k.height);
            pixels += u64::from(k.width) * u64::from(k.height);
        }
        let progress = context.progress("rendering", rows);
        let (mut views, mut done) = (Vec::with_capacity(resized.len()), 0);
        for camera in resized {
            let [image, preview] = [image_file(&camera.name), preview_file(&camera.name)];
            let job = RenderJob {
                params,
                members: &fields,
                background: file.background,
                camera: &camera,
            };
            context.part(&camera.name, &[&image, &preview], || {
                job.render(context, &image, &preview, &progress)
            })?;
            done += u64::from(camera.intrinsics.height);
            progress.set(done, "");
            views.push(View {
                image: Some(image.clone()),
                depth: Some(image),
                ..View::camera_only(camera)
            });
        }
        let summary =
            format!("{}, {} pixels", format_count(views.len(), "view"), format_amount(pixels));
        context.write_json(VIEWS_FILE, &Views::new(file.background, cameras.bounds, views))?;
        context.write_summary(&summary)
    }
}

/// Resizes a camera to a width and keeps the aspect ratio.
fn resize(camera: &Camera, width: Option<u32>) -> Camera {
    let k = camera.intrinsics;
    let Some(width) = width else { return camera.clone() };
    let height = (f64::from(k.height) * f64::from(width) / f64::from(k.width)).round().max(1.0);
    camera.resized(width, height as u32)
}

/// Minimum number of pixels whose rays a task combines; chosen by hand.
const MIN_PIXELS_PER_TASK: usize = 64;

/// View to render.
struct RenderJob<'a> {
    params: &'a Params,
    members: &'a [Box<dyn RayField>],
    background: Background,
    camera: &'a Camera,
}

impl RenderJob<'_> {
    fn render(
        &self,
        context: &Context,
        image: &str,
        preview: &str,
        progress: &stage::Progress,
    ) -> anyhow::Result<()> {
        let k = self.camera.intrinsics;
        let (width, height) = (k.width as usize, k.height as usize);
        let exr = context.output_path(image)?;
        let mut png = PngRows::create(&context.output_path(preview)?, width, height)?;
        let mut centres = CentreRows::default();
        let mut preview = Vec::new();
        write_view_image(&exr, (width, height), &VIEW_CHANNELS, |first, rows, samples| {
            context.check_interrupt()?;
            // Another thread writes the preview's previous rows meanwhile.
            let mut written = Ok(());
            let pixels = rayon::in_place_scope(|scope| {
                scope.spawn(|_| written = png.write(&preview));
                self.render_rows(&mut centres, first..first + rows)
            })?;
            written?;
            for (i, sample) in samples.chunks_exact_mut(VIEW_CHANNELS.len()).enumerate() {
                sample.copy_from_slice(&pixels[i].channels);
            }
            preview.clear();
            preview.extend(pixels.iter().flat_map(|pixel| pixel.colour.map(to_u8)));
            progress.add(rows as u64);
            anyhow::Ok(())
        })?;
        png.write(&preview)?;
        png.finish().context("cannot write the preview")
    }

    /// Renders a band of rows. `centres` must be passed from each band to the next.
    fn render_rows(
        &self,
        centres: &mut CentreRows,
        rows: Range<usize>,
    ) -> anyhow::Result<Vec<ViewPixel>> {
        let k = self.camera.intrinsics;
        let (width, height) = (k.width as usize, k.height as usize);
        let n = self.params.samples_per_axis as usize;
        if n == 1 {
            return self.cast(&pixel_positions(rows, width), 1);
        }
        // Keep the row above the band, and add the rows up to the first one of the next band.
        let kept = rows.start.saturating_sub(1).max(centres.first);
        centres.pixels.drain(..(kept - centres.first) * width);
        centres.first = kept;
        let next = kept + centres.pixels.len() / width;
        let missing = pixel_positions(next..(rows.end + 1).min(height), width);
        centres.pixels.extend(self.cast(&missing, 1)?);

        let tolerance = self.params.tolerance as f32;
        let mut detailed = pixel_positions(rows.clone(), width);
        detailed.retain(|&at| tolerance == 0.0 || centres.error(at, width) > tolerance);
        let first = (rows.start - centres.first) * width;
        let mut pixels = centres.pixels[first..first + rows.len() * width].to_vec();
        for (i, pixel) in self.cast(&detailed, n)?.into_iter().enumerate() {
            let [x, y] = detailed[i];
            let index = (y - rows.start) * width + x;
            pixels[index] = ViewPixel::blend(&pixels[index], &pixel);
        }
        Ok(pixels)
    }

    /// Renders the pixels at `[x, y]` with n × n rays each.
    fn cast(&self, positions: &[[usize; 2]], n: usize) -> anyhow::Result<Vec<ViewPixel>> {
        let (rays, z_per_distance) = pixel_rays(self.camera, self.background, positions, n);
        let rendered: Result<Vec<_>, _> = self.members.iter().map(|m| m.render(&rays)).collect();
        let rendered = rendered.map_err(fields::rendering_failure)?;
        let pixels = (0..positions.len()).into_par_iter().with_min_len(MIN_PIXELS_PER_TASK);
        let combined = pixels.map_init(Vec::new, |samples, i| {
            let rays = i * n * n..(i + 1) * n * n;
            samples.clear();
            for member in &rendered {
                samples.extend(member[rays.clone()].iter().zip(&z_per_distance[rays.clone()]));
            }
            combine(samples)
        });
        Ok(combined.collect())
    }
}

/// Combines the samples of a pixel's rays, each with its z-depth per distance: means of colour and
/// opacity, lower median of the depth. A mean depth would lie between two surfaces.
fn combine(samples: &[(&radiance::Pixel, &f32)]) -> ViewPixel {
    let [r, g, b] = std::array::from_fn(|c| mean(samples, |(p, _)| p.premultiplied[c]));
    let mut distances: Vec<(f32, f32)> =
        samples.iter().map(|(pixel, to_z)| (pixel.median_depth, **to_z)).collect();
    let (distance, to_z) = lower_median(&mut distances, |d| d.0).copied().unwrap_or_default();
    ViewPixel {
        channels: [r, g, b, mean(samples, |(p, _)| p.opacity), distance * to_z],
        colour: std::array::from_fn(|c| mean(samples, |(p, _)| p.colour[c])),
    }
}

/// Returns the positions `[x, y]` of the pixels of some rows.
fn pixel_positions(rows: Range<usize>, width: usize) -> Vec<[usize; 2]> {
    rows.flat_map(|y| (0..width).map(move |x| [x, y])).collect()
}

/// Pixel of a rendered view.
#[derive(Clone, Copy)]
struct ViewPixel {
    /// Channels of the EXR: premultiplied colour, opacity and z-depth.
    channels: [f32; VIEW_CHANNELS.len()],
    /// Colour over the background, for the preview.
    colour: [f32; 3],
}

impl ViewPixel {
    /// Returns the mean of two pixels' colour and opacity, with the depth of `all`. The centre's
    /// ray alone is noisier, all rays alone are blurred
    /// (docs/design/003-degradation-like-pillow.md).
    fn blend(centre: &Self, all: &Self) -> Self {
        let mean = |a: f32, b: f32| 0.5 * (a + b);
        let [r, g, b, opacity] = [0, 1, 2, 3].map(|c| mean(centre.channels[c], all.channels[c]));
        Self {
            channels: [r, g, b, opacity, all.channels[4]],
            colour: std::array::from_fn(|c| mean(centre.colour[c], all.colour[c])),
        }
    }
}

/// Rows of pixels with one ray through the centre of each.
#[derive(Default)]
struct CentreRows {
    /// Index of the first row.
    first: usize,
    pixels: Vec<ViewPixel>,
}

impl CentreRows {
    /// Estimates the error of a pixel's centre ray against the pixel's colour and opacity: the
    /// view's second differences over 48, half of the difference between the mean of a quadratic
    /// over a unit square and the value at its centre. Infinite at the view's border.
    fn error(&self, [x, y]: [usize; 2], width: usize) -> f32 {
        let index = (y - self.first) * width + x;
        let is_inside =
            x > 0 && x + 1 < width && index >= width && index + width < self.pixels.len();
        if !is_inside {
            return f32::INFINITY;
        }
        let mut largest = 0.0f32;
        for channel in 0..4 {
            let across = self.second_difference(index, channel, 1);
            largest = largest.max(across + self.second_difference(index, channel, width));
        }
        largest / 48.0
    }

    /// Returns the absolute second difference of a channel at a pixel, along an index step.
    fn second_difference(&self, index: usize, channel: usize, step: usize) -> f32 {
        let [before, own, after] =
            [index - step, index, index + step].map(|i| self.pixels[i].channels[channel]);
        (before - 2.0 * own + after).abs()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use radiance::Ray;
    use scene::Intrinsics;

    use super::*;

    const SIZE: usize = 24;
    const CENTRE: f64 = SIZE as f64 / 2.0;

    /// Picture on the plane z = -1, in front of a camera with a focal length of 1 pixel.
    struct Picture {
        colour: fn(f64, f64) -> f64,
        rays: Arc<AtomicUsize>,
    }

    impl Picture {
        fn pixel(&self, ray: &Ray) -> radiance::Pixel {
            let [x, y, z] = ray.direction;
            let value = (self.colour)(CENTRE - x / z, CENTRE + y / z) as f32;
            radiance::Pixel {
                colour: [value; 3],
                premultiplied: [value; 3],
                opacity: 1.0,
                depth: 2.0,
                median_depth: 2.0,
            }
        }
    }

    impl RayField for Picture {
        fn render(&self, rays: &[Ray]) -> Result<Vec<radiance::Pixel>, radiance::RenderError> {
            self.rays.fetch_add(rays.len(), Ordering::Relaxed);
            Ok(rays.iter().map(|ray| self.pixel(ray)).collect())
        }
    }

    /// Camera at the origin with a focal length of 1 pixel.
    fn camera() -> Camera {
        let angle = 2.0 * CENTRE.atan();
        let intrinsics = Intrinsics::from_angle_x(SIZE as u32, SIZE as u32, angle);
        let camera_to_world = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        Camera { name: "a".to_owned(), intrinsics, camera_to_world }
    }

    /// Renders a picture in bands of `band` rows. Returns each pixel's red and the number of rays.
    fn render_red(colour: fn(f64, f64) -> f64, tolerance: f64, band: usize) -> (Vec<f32>, usize) {
        let (camera, params) = (&camera(), &Params { tolerance, ..Params::default() });
        let count = Arc::new(AtomicUsize::new(0));
        let members: &[Box<dyn RayField>] =
            &[Box::new(Picture { colour, rays: Arc::clone(&count) })];
        let job = RenderJob { params, members, background: Background::White, camera };
        let mut centres = CentreRows::default();
        let bands = (0..SIZE).step_by(band).map(|first| first..(first + band).min(SIZE));
        let pixels: Vec<ViewPixel> =
            bands.flat_map(|rows| job.render_rows(&mut centres, rows).unwrap()).collect();
        (pixels.iter().map(|pixel| pixel.channels[0]).collect(), count.load(Ordering::Relaxed))
    }

    /// Returns a colour whose curvature grows to the right.
    fn curved_colour(x: f64, y: f64) -> f64 {
        0.2 + 0.004 * x + 2e-5 * x.powi(3) - 0.001 * y * y + 0.002 * x * y
    }

    #[test]
    fn smooth_pixels_have_one_ray_within_the_tolerance() {
        let (reference, max_rays) = render_red(curved_colour, 0.0, SIZE);
        assert_eq!(max_rays, 5 * SIZE * SIZE);
        for tolerance in [1e-5, 5e-5, 7.5e-5, 1e-4, 1e-3] {
            let (adaptive, rays) = render_red(curved_colour, tolerance, SIZE);
            let error = reference
                .iter()
                .zip(&adaptive)
                .map(|(a, b)| f64::from((a - b).abs()))
                .fold(0.0, f64::max);
            println!("tolerance {tolerance}: error {error}, {rays} rays");
            assert!(error <= tolerance + 1e-6, "an error of {error} is above {tolerance}");
            assert!(rays <= max_rays);
        }
        let [few, several, many] =
            [1e-3, 7.5e-5, 1e-5].map(|tolerance| render_red(curved_colour, tolerance, SIZE).1);
        assert!(few < several && several < many, "{few}, {several}, {many} rays");
        // All rays are cast through the border's pixels.
        assert_eq!(few, SIZE * SIZE + 4 * (4 * SIZE - 4));
    }

    #[test]
    fn bands_do_not_change_the_image() {
        let expected = render_red(curved_colour, 7.5e-5, SIZE);
        for band in [1, 2, 5, 16] {
            assert!(render_red(curved_colour, 7.5e-5, band) == expected, "bands of {band} rows");
        }
    }

    /// Wall at a z-depth; its opacity grows with the depth.
    struct Wall(f32);

    impl Wall {
        fn pixel(&self, ray: &Ray) -> radiance::Pixel {
            let median_depth = self.0 / -ray.direction[2] as f32;
            let opacity = 0.25 * self.0;
            radiance::Pixel { opacity, median_depth, ..radiance::Pixel::default() }
        }
    }

    impl RayField for Wall {
        fn render(&self, rays: &[Ray]) -> Result<Vec<radiance::Pixel>, radiance::RenderError> {
            Ok(rays.iter().map(|ray| self.pixel(ray)).collect())
        }
    }

    /// A pixel's depth is that of one ray of one member: their lower median by distance. Its
    /// opacity is the mean.
    #[test]
    fn a_pixel_has_the_depth_of_one_ray_of_one_member() {
        let camera = &camera();
        // Walls of the members, then the pixel's depth and opacity.
        let cases: [(&[f32], f32, f32); 3] =
            [(&[1.0], 1.0, 0.25), (&[1.0, 3.0], 1.0, 0.5), (&[3.0, 1.0, 3.0], 3.0, 7.0 / 12.0)];
        for (walls, depth, opacity) in cases {
            let members: Vec<Box<dyn RayField>> =
                walls.iter().map(|wall| Box::new(Wall(*wall)) as Box<dyn RayField>).collect();
            let (params, members) = (&Params::default(), &members[..]);
            let job = RenderJob { params, members, background: Background::White, camera };
            let channels = job.cast(&[[14, 12]], 2).unwrap()[0].channels;
            let is_near = |(a, b): (&f32, &f32)| (a - b).abs() < 1e-4;
            assert!(
                channels[3..].iter().zip(&[opacity, depth]).all(is_near),
                "walls {walls:?}: {channels:?}, expected {opacity} and {depth}"
            );
        }
    }
}

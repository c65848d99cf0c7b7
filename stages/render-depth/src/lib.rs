//! `render-depth`: colour, opacity and depth of a field, for any list of cameras at any size.
//!
//! A field may have several members, trained apart or one on from another; what they render is averaged: each errs in its own
//! way where the images leave it open.
//!
//! Every view becomes an EXR (R, G, B, A in half precision; `Z` in single) and a PNG to look at. Rows are rendered and
//! written sixteen at a time, so memory doesn't grow with the image.

use anyhow::Context as _;
use artifact::{Context, Failure, Input, Output, Stage, amount, counted};
use fields::Members;
use pixels::{PixelError, PngRows, VIEW_CHANNELS, VIEW_NOTE, to_u8, write_exr};
use radiance::{Ray, RayField};
use scene::{Background, Camera, VIEWS_FILE, View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `render-depth`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Width of the views; heights follow the cameras' aspect. Default: the cameras' own size.
    #[schemars(range(min = 1, max = 65536), extend("x-default" = "by camera"))]
    pub size: Option<u32>,
    /// Rays along each side of a pixel; 2 casts four. A pixel shows the mean of their colours and the depth of one of them.
    #[schemars(range(min = 1, max = 8))]
    pub samples_per_axis: u32,
    /// Depth that channel `Z` holds. The median lies on a surface; the mean lies between the surface and floaters before it.
    pub depth: Depth,
    /// Also writes the distance along the ray, as channel `distance`.
    pub ray_distance: bool,
}

impl Default for Params {
    fn default() -> Self {
        Self { size: None, samples_per_axis: 2, depth: Depth::Median, ray_distance: false }
    }
}

/// Kinds of depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Depth {
    /// Mean of where light is stopped, weighted by how much of it is.
    Expected,
    /// Where half of the light is stopped; the far end where less ever is.
    Median,
}

/// The stage.
pub struct RenderDepth;

impl Stage for RenderDepth {
    type Params = Params;
    const NAME: &'static str = "render-depth";
    const SUMMARY: &'static str = "Renders colour, opacity and depth of a field for a list of cameras.";
    const ENVIRONMENT: &'static [&'static str] = fields::ENVIRONMENT;

    fn inputs() -> Vec<(&'static str, Input)> {
        let cameras = ["scene/cameras", "scene/truth", "scene/train", "scene/references", "cameras", "views"];
        vec![
            ("field", Input::required(&["field"], "a trained field")),
            ("cameras", Input::required(&cameras, "folder with views.json: the cameras to render")),
        ]
    }

    fn output() -> Output {
        Output::kind("views")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let Members { file, fields } = Members::read(context.input("field")?, &context.device)?;
        let cameras = Views::read(context.input("cameras")?)?;
        let resized: Vec<Camera> = cameras.views.iter().map(|v| resize(&v.camera, params.size)).collect();
        let rows = resized.iter().map(|c| u64::from(c.intrinsics.height)).sum();
        let progress = context.progress("rendering", rows);
        let (mut views, mut done) = (Vec::with_capacity(resized.len()), 0);
        for camera in resized {
            let [image, preview] = [format!("images/{}.exr", camera.name), format!("previews/{}.png", camera.name)];
            let job = RenderJob { context, params, members: &fields, background: file.background, camera: &camera };
            context.part(&camera.name, &[&image, &preview], || job.render(&image, &preview, &progress))?;
            done += u64::from(camera.intrinsics.height);
            progress.set(done, "");
            views.push(View { image: Some(image.clone()), depth: Some(image), ..View::camera_only(camera) });
        }
        let count = views.len();
        context.write_json(VIEWS_FILE, &Views { hull: None, ..Views::new(file.background, cameras.bounds, views) })?;
        let pixels = amount(pixels_of(&cameras, params.size));
        context.write_summary(&format!("{}, {pixels} pixels", counted(count, "view")))
    }
}

fn resize(camera: &Camera, width: Option<u32>) -> Camera {
    let k = camera.intrinsics;
    match width {
        Some(width) => {
            let height = (f64::from(k.height) * f64::from(width) / f64::from(k.width)).round().max(1.0);
            camera.resized(width, height as u32)
        }
        None => camera.clone(),
    }
}

fn pixels_of(cameras: &Views, width: Option<u32>) -> u64 {
    let size = |v: &View| resize(&v.camera, width).intrinsics;
    cameras.views.iter().map(|v| u64::from(size(v).width) * u64::from(size(v).height)).sum()
}

/// One view.
struct RenderJob<'a> {
    context: &'a Context,
    params: &'a Params,
    members: &'a [Box<dyn RayField>],
    background: Background,
    camera: &'a Camera,
}

impl RenderJob<'_> {
    fn render(&self, image: &str, preview: &str, progress: &artifact::Progress) -> anyhow::Result<()> {
        let k = self.camera.intrinsics;
        let (width, height) = (k.width as usize, k.height as usize);
        let channels = &VIEW_CHANNELS[..if self.params.ray_distance { 6 } else { 5 }];
        let exr = self.context.output_path(image)?;
        let mut png = PngRows::create(&self.context.output_path(preview)?, width, height)?;
        write_exr(&exr, (width, height), channels, VIEW_NOTE, |first, rows, samples| -> Result<(), Stopped> {
            self.context.check_interrupt().map_err(Stopped::Other)?;
            let bytes = self.band(first, rows, samples, channels.len()).map_err(Stopped::Other)?;
            png.write(&bytes)?;
            progress.add(rows as u64);
            Ok(())
        })
        .map_err(|stopped| match stopped {
            Stopped::Pixels(error @ PixelError::NotFinite { .. }) => Failure::Numerical(error.to_string()).into(),
            Stopped::Pixels(error) => error.into(),
            Stopped::Other(error) => error,
        })?;
        png.finish().context("cannot write the preview")
    }

    /// Renders some rows into EXR samples; returns the preview's bytes.
    fn band(&self, first: usize, rows: usize, samples: &mut [f32], channels: usize) -> anyhow::Result<Vec<u8>> {
        let width = self.camera.intrinsics.width as usize;
        let background = [self.background.shown(); 3];
        let n = self.params.samples_per_axis as usize;
        let (rays, to_z): (Vec<Ray>, Vec<f32>) = (0..rows * width * n * n)
            .map(|i| {
                let (pixel, sub) = (i / (n * n), i % (n * n));
                let within = |k: usize| (k as f64 + 0.5) / n as f64;
                let u = (pixel % width) as f64 + within(sub % n);
                let v = (first + pixel / width) as f64 + within(sub / n);
                let ray = self.camera.ray(u, v);
                let (origin, direction) = (ray.origin.as_vec3().to_array(), ray.direction.as_vec3().to_array());
                (Ray { origin, direction, background }, self.camera.depth_per_distance(&ray) as f32)
            })
            .unzip();
        let rendered: Result<Vec<_>, _> = self.members.iter().map(|m| m.render(&rays)).collect();
        let rendered = rendered.map_err(|e| anyhow::anyhow!(e))?;
        let share = 1.0 / (n * n * self.members.len()) as f32;
        let mut preview = Vec::with_capacity(3 * rows * width);
        let (mut subs, mut distances) = (Vec::new(), Vec::new());
        for (i, sample) in samples.chunks_exact_mut(channels).enumerate() {
            let rays = i * n * n..(i + 1) * n * n;
            subs.clear();
            subs.extend(rendered.iter().flat_map(|r| &r[rays.clone()]));
            let mean = |of: &dyn Fn(&radiance::Pixel) -> f32| subs.iter().map(of).sum::<f32>() * share;
            for c in 0..3 {
                sample[c] = mean(&|p| p.premultiplied[c]);
            }
            sample[3] = mean(&|p| p.opacity);
            distances.clear();
            distances.extend(subs.iter().map(|p| self.distance(p)).zip(to_z[rays].iter().copied().cycle()));
            let (distance, to_z) = middle(&mut distances);
            sample[4] = distance * to_z;
            if let Some(last) = sample.get_mut(5) {
                *last = distance;
            }
            preview.extend((0..3).map(|c| to_u8(mean(&|p| p.colour[c]))));
        }
        Ok(preview)
    }

    fn distance(&self, pixel: &radiance::Pixel) -> f32 {
        match self.params.depth {
            Depth::Expected => pixel.depth,
            Depth::Median => pixel.median_depth,
        }
    }
}

/// The middle one of the sub-pixel rays' distances, and its z-depth per distance: a mean would invent a surface between two.
fn middle(distances: &mut [(f32, f32)]) -> (f32, f32) {
    distances.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    distances[(distances.len() - 1) / 2]
}

/// Why writing a view ended early.
enum Stopped {
    Pixels(PixelError),
    Other(anyhow::Error),
}

impl From<PixelError> for Stopped {
    fn from(error: PixelError) -> Self {
        Self::Pixels(error)
    }
}

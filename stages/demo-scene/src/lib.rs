//! `demo-scene`: renders a small procedural scene in linear light and writes a data set: in
//! Blender's format with exact depth, or JPEG files with a `transforms.json`, like photographs.
//!
//! The scene separates good methods from bad ones: it has fine texture (base, crate, sign), thin
//! parts (cage, spring), gloss (ball, copper) and occlusion (a striped ball inside the cage). It
//! uses only arithmetic and `libm`, so equal parameters give equal bytes.
//!
//! * `world`: the objects, their shapes, and intersection with rays.
//! * `material`: albedo and gloss at a surface point.
//! * `camera`: pinhole camera, or a fisheye lens for training views.
//! * `render`: light, shadow, reflection, anti-aliasing.
//! * `disturbance`: exposures that differ, and poses that aren't exact.
//! * `dataset_writer`: files of both formats.

mod camera;
mod dataset_writer;
mod disturbance;
mod material;
mod params;
mod render;
mod world;

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use scene::{Pose, looking_at, pose_of};
use stage::{Context, Output, Stage};

use camera::ViewCamera;
use dataset_writer::DatasetWriter;
pub use params::{Form, Layout, Params};
pub use render::RenderedImage;
pub use world::World;

/// Distance of every camera from the scene's centre, in scene units.
const CAMERA_DISTANCE: f64 = 4.0;

/// Number of bytes per pixel while an image is rendered and written: colour, depth, and a copy of
/// the colour for the PNG or JPEG encoder.
const BYTES_PER_PIXEL: u64 = 16;
/// Remedy if memory is insufficient, as a sentence fragment.
const REMEDY: &str = "choose a smaller size, or end other programs";

/// The stage.
pub struct DemoScene;

impl Stage for DemoScene {
    type Params = Params;
    const NAME: &'static str = "demo-scene";
    const SUMMARY: &'static str = "Renders a small procedural scene as a data set; with \
        `form: blender`, test views have exact depth.";

    fn output() -> Output {
        Output::kind("dataset")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let world = World::new(params.seed);
        let world = if params.backdrop { world.with_backdrop() } else { world };
        let splits = [
            ("train", params.train, ViewCamera::of_training(params)),
            ("test", params.test, ViewCamera::of_test(params)),
        ];
        check_memory(context, &splits)?;
        let rows = splits.iter().map(|(_, count, camera)| u64::from(count * camera.sides[1]));
        let progress = context.progress("rendering", rows.sum());
        let mut writer = DatasetWriter::new(params);
        for (split, count, camera) in splits {
            let poses: Vec<[[f64; 4]; 4]> =
                (0..count).map(|i| camera_pose(params.layout, split, i, count)).collect();
            (0..count)
                .into_par_iter()
                .map(|i| {
                    context.check_interrupt()?;
                    let pose = &poses[i as usize];
                    let samples = params.samples_per_axis;
                    let mut image = render::render(&world, pose, &camera, samples, &progress);
                    if split == "train" {
                        disturbance::expose(&mut image.colour, params, i);
                    }
                    params.form.write_view(context, split, i as usize, &image)
                })
                .collect::<anyhow::Result<Vec<()>>>()?;
            let stated_poses = (0..).zip(&poses).map(|(i, pose)| match split {
                "train" => disturbance::with_error(pose, params, i),
                _ => *pose,
            });
            writer.add_split(context, split, &camera, &stated_poses.collect::<Vec<_>>())?;
        }
        writer.finish(context)?;
        let [width, height] = splits[0].2.sides;
        context.write_summary(&format!(
            "{}, {}, {width}×{height}",
            artifact::format_count(params.train as usize, "training view"),
            artifact::format_count(params.test as usize, "test view"),
        ))
    }
}

/// Fails unless there is memory for the views that are rendered in parallel.
fn check_memory(context: &Context, splits: &[(&str, u32, ViewCamera)]) -> anyhow::Result<()> {
    let needs = splits.iter().map(|(_, count, camera)| {
        let pixels = u64::from(camera.sides[0]) * u64::from(camera.sides[1]);
        BYTES_PER_PIXEL * pixels * u64::from(*count).min(context.threads as u64)
    });
    Ok(context.check_memory("rendering", needs.max().unwrap_or(0), REMEDY)?)
}

/// Returns the pose of camera `i` of `count`.
///
/// Around: training views are evenly spread over the upper hemisphere and slightly below it, test
/// views are on a wavy circle between them. Forward: training views fill a square evenly (a
/// golden-ratio sequence), test views are on a circle in this square. Heights and radii are chosen
/// by hand.
fn camera_pose(layout: Layout, split: &str, i: u32, count: u32) -> [[f64; 4]; 4] {
    use std::f64::consts::{PI, TAU};
    let fraction = (f64::from(i) + 0.5) / f64::from(count);
    if layout == Layout::Forward {
        let (u, v) = if split == "train" {
            (fraction - 0.5, (f64::from(i) * 0.618_033_988_75 + 0.5) % 1.0 - 0.5)
        } else {
            (0.3 * libm::cos(TAU * fraction), 0.3 * libm::sin(TAU * fraction))
        };
        // Cameras look along +y.
        let axes = DMat3::from_cols(DVec3::X, DVec3::Z, -DVec3::Y);
        return camera_to_world(pose_of(axes, DVec3::new(u, -CAMERA_DISTANCE, 0.3 + v)));
    }
    let (azimuth, height) = if split == "train" {
        // Azimuths by the golden angle; heights from just below the horizon to 72° above it.
        (f64::from(i) * PI * (3.0 - 5.0f64.sqrt()), -0.08 + 1.03 * fraction)
    } else {
        (TAU * fraction, 0.42 + 0.28 * libm::sin(3.0 * TAU * fraction))
    };
    let radius = (1.0 - height * height).sqrt();
    let direction = DVec3::new(radius * libm::cos(azimuth), radius * libm::sin(azimuth), height);
    camera_to_world(looking_at(CAMERA_DISTANCE * direction, DVec3::ZERO, DVec3::Z))
}

/// Returns the 4 × 4 matrix of a pose.
fn camera_to_world([x, y, z]: Pose) -> [[f64; 4]; 4] {
    [x, y, z, [0.0, 0.0, 0.0, 1.0]]
}

#[cfg(test)]
mod tests {
    use scene::Projection;
    use stage::Progress;

    use super::*;

    fn test_camera(size: u32, aspect: f64) -> ViewCamera {
        ViewCamera::of_test(&Params { size, aspect, ..Params::default() })
    }

    #[test]
    fn depth_agrees_with_the_surfaces() {
        let world = World::new(0);
        let pose = camera_pose(Layout::Around, "test", 3, 10);
        let frame = render::render(&world, &pose, &test_camera(64, 1.0), 2, &Progress::silent());
        let depths: Vec<f32> = frame.depth.iter().flatten().copied().collect();
        assert!(depths.len() > 64 * 64 / 8, "{} pixels hit a surface", depths.len());
        assert!(depths.iter().all(|z| (2.0..6.0).contains(z)));
        // Centre rays hit a surface in nearly all pixels where all four rays do, and in hardly any
        // where none does.
        let agree = frame
            .depth
            .iter()
            .zip(frame.colour.data.chunks_exact(4))
            .filter(|(d, p)| d.is_some() == (p[3] >= 128));
        assert!(agree.count() > 64 * 64 * 95 / 100);
    }

    /// The distance is 0 at a ray's first surface and grows along its normal. Before the surface,
    /// the distance is positive and at most the ray's remaining length.
    #[test]
    fn distances_agree_with_the_surfaces() {
        let world = World::new(2);
        let mut hits = 0;
        for i in 0..200 {
            let pose = camera_pose(Layout::Around, "train", i, 200);
            let origin = DVec3::new(pose[0][3], pose[1][3], pose[2][3]);
            let target = 0.2 * DVec3::new(f64::from(i % 7) - 3.0, f64::from(i % 11) - 5.0, -1.0);
            let direction = (target - origin).normalize();
            let Some((point, normal)) = world.surface(origin, direction) else { continue };
            hits += 1;
            assert!(world.distance(point).abs() < 1e-9, "ray {i}");
            let step = 1e-4;
            let [outside, inside] =
                [step, -step].map(|offset| world.distance(point + offset * normal));
            assert!(outside > 0.5 * step && inside < 0.0, "ray {i}: {outside} and {inside}");
            for k in 1..10 {
                let fraction = f64::from(k) / 10.0;
                let remaining = (1.0 - fraction) * (point - origin).length();
                let distance = world.distance(origin.lerp(point, fraction));
                assert!(distance > 0.0 && distance <= remaining + 1e-9, "ray {i}");
            }
        }
        assert!(hits > 100, "{hits} rays hit a surface");
    }

    /// The border of every test view is transparent, so no object is cut off.
    #[test]
    fn test_views_show_the_whole_scene() {
        let world = World::new(0);
        for aspect in [1.0, 1.5, 0.75] {
            let camera = test_camera(48, aspect);
            let [width, height] = camera.sides;
            for i in 0..10 {
                let pose = camera_pose(Layout::Around, "test", i, 10);
                let frame = render::render(&world, &pose, &camera, 1, &Progress::silent());
                let rows = (0..width).flat_map(|x| [(x, 0), (x, height - 1)]);
                for (x, y) in rows.chain((0..height).flat_map(|y| [(0, y), (width - 1, y)])) {
                    let alpha = frame.colour.data[((y * width + x) * 4 + 3) as usize];
                    assert_eq!(alpha, 0, "view {i} of {width}×{height} is cut off at ({x}, {y})");
                }
            }
        }
    }

    fn view(seed: u32) -> pixels::Rgba8 {
        let pose = camera_pose(Layout::Around, "test", 0, 10);
        let camera = test_camera(32, 1.0);
        render::render(&World::new(seed), &pose, &camera, 1, &Progress::silent()).colour
    }

    #[test]
    fn seeds_differ() {
        assert_eq!(view(0), view(0));
        assert_ne!(view(0), view(1));
    }

    /// A fisheye's middle has as many pixels per degree as a test view, its border is at the
    /// requested angle, and corners beyond 89° are black.
    #[test]
    fn a_fisheye_view_is_taken_through_its_lens() {
        let params = Params {
            size: 40,
            projection: Projection::Fisheye,
            angle: Some(150.0),
            ..Params::default()
        };
        let [camera, test] = [ViewCamera::of_training(&params), ViewCamera::of_test(&params)];
        let axes = [DVec3::X, DVec3::Y, DVec3::Z];
        let angle = |camera: &ViewCamera, from_middle: f64| {
            let [cx, cy] = camera.sides.map(|side| 0.5 * f64::from(side));
            camera.direction([cx + from_middle, cy], axes).unwrap().dot(-DVec3::Z).acos()
        };
        assert!((angle(&camera, 0.1) - angle(&test, 0.1)).abs() < 1e-6);
        let half = 0.5 * f64::from(camera.sides[0]);
        assert!((angle(&camera, half).to_degrees() - 75.0).abs() < 0.5, "{camera:?}");
        assert_eq!(camera.direction([0.0, 0.0], axes), None);
        let pose = camera_pose(Layout::Around, "train", 3, 10);
        let frame = render::render(&World::new(0), &pose, &camera, 1, &Progress::silent());
        assert_eq!(frame.colour.data[..4], [0, 0, 0, 255]);
    }
}

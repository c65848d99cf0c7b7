//! `demo-scene`: a small procedural scene, rendered in linear light and written as a Blender-format dataset with exact depth.
//!
//! It is made to tell methods apart: fine texture (base, crate, sign), thin parts (cage, spring), gloss (ball, copper),
//! occlusion (a striped ball inside the cage). Everything is arithmetic and `libm`, so equal parameters give equal bytes.
//!
//! * `world`: shapes, where they stand, how they intersect a ray.
//! * `material`: albedo and gloss of a point.
//! * `render`: light, shadow, reflection, anti-aliasing.

mod material;
mod render;
mod world;

use anyhow::Context as _;
use artifact::{Context, Output, Stage};
use glam::{DMat3, DVec3};
use pixels::{Channel, PixelError, SampleType, write_exr, write_png};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;

pub use render::RenderedImage;
pub use world::World;

/// Horizontal angle of view, as in NeRF's Blender scenes.
const CAMERA_ANGLE_X: f64 = 0.691_111_2;
/// Distance of every camera from the scene's centre.
const DISTANCE: f64 = 4.0;

/// Parameters of `demo-scene`.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Side of the square images, in pixels.
    #[schemars(range(min = 1, max = 2048))]
    pub size: u32,
    /// Number of training views.
    #[schemars(range(min = 1, max = 1000))]
    pub train: u32,
    /// Number of test views, which have depth.
    #[schemars(range(min = 1, max = 1000))]
    pub test: u32,
    /// Rays along each side of a pixel, against aliasing.
    #[schemars(range(min = 1, max = 16))]
    pub samples_per_axis: u32,
    /// Where cameras stand.
    pub layout: Layout,
    /// Adds an unbounded background: ground, towers far away, a sky.
    pub backdrop: bool,
    /// Seed of the objects' places and textures.
    pub seed: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self { size: 200, train: 80, test: 10, samples_per_axis: 4, layout: Layout::Around, backdrop: false, seed: 0 }
    }
}

/// Where cameras stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// All around the things, looking at their middle.
    Around,
    /// In front of them, a step to the sides, up and down, all looking one way.
    Forward,
}

/// The stage.
pub struct DemoScene;

impl Stage for DemoScene {
    type Params = Params;
    const NAME: &'static str = "demo-scene";
    const SUMMARY: &'static str = "Renders a small procedural scene as a Blender-format dataset with exact depth.";

    fn output() -> Output {
        Output::kind("dataset")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let world = World::new(params.seed);
        let world = if params.backdrop { world.with_backdrop() } else { world };
        let total = u64::from(params.train + params.test);
        let progress = context.progress("rendering", total);
        for (split, count) in [("train", params.train), ("test", params.test)] {
            let poses: Vec<[[f64; 4]; 4]> = (0..count).map(|i| pose(params.layout, split, i, count)).collect();
            context.output_path(&format!("{split}/."))?;
            (0..count)
                .into_par_iter()
                .map(|i| {
                    context.check_interrupt()?;
                    let frame = render::render(&world, &poses[i as usize], CAMERA_ANGLE_X, params.size, params.samples_per_axis);
                    write_png(&context.output_path(&format!("{split}/r_{i}.png"))?, &frame.colour)?;
                    if split == "test" {
                        write_depth(&context.output_path(&format!("test/r_{i}_depth.exr"))?, &frame)?;
                    }
                    progress.add(1);
                    Ok(())
                })
                .collect::<anyhow::Result<Vec<()>>>()?;
            let frames: Vec<_> = poses
                .iter()
                .enumerate()
                .map(|(i, pose)| {
                    let mut frame = json!({"file_path": format!("./{split}/r_{i}"), "transform_matrix": pose});
                    if split == "test" {
                        frame["depth_file_path"] = json!(format!("./test/r_{i}_depth.exr"));
                    }
                    frame
                })
                .collect();
            context
                .write_json(&format!("transforms_{split}.json"), &json!({"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}))
                .context("cannot write the cameras")?;
        }
        context.write_summary(&format!(
            "{}, {}, {size}×{size}",
            artifact::counted(params.train as usize, "training view"),
            artifact::counted(params.test as usize, "test view"),
            size = params.size
        ))
    }
}

/// Depth of the first surface at each pixel's centre; where there is none, `Z` is 0 and `A` is 0.
fn write_depth(path: &std::path::Path, frame: &RenderedImage) -> Result<(), PixelError> {
    let channels = [Channel { name: "A", sample_type: SampleType::Half }, Channel { name: "Z", sample_type: SampleType::Float }];
    let size = frame.colour.width;
    write_exr(
        path,
        (size, size),
        &channels,
        "Z: camera-space z-depth in scene units; A: 0 where nothing is seen",
        |first, rows, samples| {
            let band = &frame.depth[first * size..(first + rows) * size];
            for (sample, depth) in samples.chunks_exact_mut(2).zip(band) {
                sample.copy_from_slice(&[f32::from(u8::from(depth.is_some())), depth.unwrap_or(0.0)]);
            }
            Ok(())
        },
    )
}

/// Camera `i` of `count`. Around: training views spread evenly over the upper hemisphere, test views on a wavy circle between them.
/// Forward: training views fill a square by the golden ratio, test views lie on a circle in it.
fn pose(layout: Layout, split: &str, i: u32, count: u32) -> [[f64; 4]; 4] {
    use std::f64::consts::{PI, TAU};
    let share = (f64::from(i) + 0.5) / f64::from(count);
    let row = |r: &DMat3, centre: DVec3, k: usize| [r.x_axis[k], r.y_axis[k], r.z_axis[k], centre[k]];
    let matrix = |r: DMat3, centre: DVec3| [row(&r, centre, 0), row(&r, centre, 1), row(&r, centre, 2), [0.0, 0.0, 0.0, 1.0]];
    if layout == Layout::Forward {
        let (u, v) = if split == "train" {
            (share - 0.5, (f64::from(i) * 0.618_033_988_75 + 0.5) % 1.0 - 0.5)
        } else {
            (0.3 * libm::cos(TAU * share), 0.3 * libm::sin(TAU * share))
        };
        // Looking along +y.
        let axes = DMat3::from_cols(DVec3::X, DVec3::Z, -DVec3::Y);
        return matrix(axes, DVec3::new(u, -DISTANCE, 0.3 + v));
    }
    let (azimuth, height) = if split == "train" {
        // The golden angle; heights between just below the horizon and almost straight above.
        (f64::from(i) * PI * (3.0 - 5.0f64.sqrt()), -0.08 + 1.03 * share)
    } else {
        (TAU * share, 0.42 + 0.28 * libm::sin(3.0 * TAU * share))
    };
    let level = (1.0 - height * height).sqrt();
    let centre = DISTANCE * DVec3::new(level * libm::cos(azimuth), level * libm::sin(azimuth), height);
    let back = centre.normalize();
    let right = DVec3::Z.cross(back).normalize();
    let r = DMat3::from_cols(right, back.cross(right), back);
    matrix(r, centre)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_is_that_of_the_surface() {
        let world = World::new(0);
        let pose = pose(Layout::Around, "test", 3, 10);
        let frame = render::render(&world, &pose, CAMERA_ANGLE_X, 64, 2);
        let seen: Vec<f32> = frame.depth.iter().flatten().copied().collect();
        assert!(seen.len() > 64 * 64 / 8, "{} pixels see something", seen.len());
        assert!(seen.iter().all(|z| (2.0..6.0).contains(z)));
        // Where all four rays of a pixel meet something, so does nearly every centre ray; where none does, hardly any.
        let agree = frame.depth.iter().zip(frame.colour.data.chunks_exact(4)).filter(|(d, p)| d.is_some() == (p[3] >= 128));
        assert!(agree.count() > 64 * 64 * 95 / 100);
    }

    #[test]
    fn the_scene_stays_in_every_view() {
        // What a test view sees must be inside the training views' frusta, or near/far and hull would be guesses.
        let world = World::new(0);
        for i in 0..10 {
            let frame = render::render(&world, &pose(Layout::Around, "test", i, 10), CAMERA_ANGLE_X, 48, 1);
            for k in 0..48 {
                for (x, y) in [(k, 0), (k, 47), (0, k), (47, k)] {
                    assert_eq!(frame.colour.data[(y * 48 + x) * 4 + 3], 0, "view {i} is cut off at ({x}, {y})");
                }
            }
        }
    }

    #[test]
    fn seeds_differ() {
        let view = |seed| render::render(&World::new(seed), &pose(Layout::Around, "test", 0, 10), CAMERA_ANGLE_X, 32, 1).colour;
        assert_eq!(view(0), view(0));
        assert_ne!(view(0), view(1));
    }
}

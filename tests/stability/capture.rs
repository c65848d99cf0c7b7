//! Photographs of the demo scene by arbitrary cameras, as a data set in the format of
//! `transforms.json`.

use std::path::Path;

use demo_scene::World;
use glam::{DMat3, DVec3};
use pixels::{Filter, Rgba8, resize_pillow, write_png};
use scene::{Camera, Distortion, Intrinsics, looking_at, pose_of};
use serde_json::{Value, json};

use crate::common::random::Random;

/// Width and height of the photographs in pixels.
pub(crate) const SIZE: u32 = 48;
/// Distance of the cameras from the scene's centre.
pub(crate) const DISTANCE: f64 = 4.0;
/// Angle of view of the photographs in degrees.
const ANGLE: f64 = 39.6;
/// Rays per pixel along each axis.
const SAMPLES: u32 = 2;

/// Content of the photographs.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Content {
    /// The scene.
    Scene,
    /// The scene, with all colours four times as bright.
    Overexposed,
    /// One opaque grey level.
    Constant(u8),
    /// A random opaque grey level in each channel of each pixel.
    Noise,
    /// Transparent pixels.
    Transparent,
}

/// Photographs to take, and their description in the data set.
pub(crate) struct Capture {
    /// True if ground, towers and sky surround the scene.
    pub(crate) backdrop: bool,
    pub(crate) train: Vec<Camera>,
    pub(crate) test: Vec<Camera>,
    pub(crate) content: Content,
    /// Width and height to which photographs are enlarged.
    pub(crate) enlarged: Option<[u32; 2]>,
    /// Scene units per unit of the demo scene.
    pub(crate) unit: f64,
    /// Origin of the demo scene in the data set's coordinates.
    pub(crate) origin: DVec3,
    /// Index of the training view that has another view's pose in the data set.
    pub(crate) outlier: Option<usize>,
}

/// Returns the intrinsics of a pinhole camera with an angle of view of `angle` degrees.
pub(crate) fn pinhole(size: u32, angle: f64) -> Intrinsics {
    Intrinsics::from_angle_x(size, size, angle.to_radians())
}

/// Returns the direction from the scene's centre to camera `i` of `count`.
fn direction(split: &str, i: usize, count: usize) -> DVec3 {
    let fraction = (i as f64 + 0.5) / count as f64;
    let (azimuth, height) = match split {
        "train" => (2.4 * i as f64, 0.95 * fraction),
        _ => (std::f64::consts::TAU * fraction, 0.4 + 0.2 * (7.0 * fraction).sin()),
    };
    let horizontal = (1.0 - height * height).sqrt();
    DVec3::new(horizontal * azimuth.cos(), horizontal * azimuth.sin(), height)
}

/// Creates cameras around the scene's centre, directed at the centre.
pub(crate) fn cameras_around(
    split: &str,
    count: usize,
    distance: f64,
    intrinsics: Intrinsics,
) -> Vec<Camera> {
    let camera = |i: usize| {
        let centre = distance * direction(split, i, count);
        Camera {
            name: format!("{split}_{i}"),
            intrinsics,
            camera_to_world: looking_at(centre, DVec3::ZERO, DVec3::Z),
        }
    };
    (0..count).map(camera).collect()
}

/// Creates cameras with one viewing direction, in a square in front of the scene.
pub(crate) fn forward(split: &str, count: usize) -> Vec<Camera> {
    let mut cameras = cameras_around(split, count, DISTANCE, pinhole(SIZE, ANGLE));
    let axes = DMat3::from_cols(DVec3::X, DVec3::Z, -DVec3::Y);
    for (i, camera) in cameras.iter_mut().enumerate() {
        let (u, v) = ((0.618 * i as f64) % 1.0 - 0.5, (i as f64 + 0.5) / count as f64 - 0.5);
        camera.camera_to_world = pose_of(axes, DVec3::new(u, -DISTANCE, 0.3 + v));
    }
    cameras
}

/// Turns a camera by 180° around its up axis.
pub(crate) fn turn_away(camera: &mut Camera) {
    let centre = camera.centre();
    camera.camera_to_world = looking_at(centre, centre - camera.forward(), DVec3::Z);
}

impl Default for Capture {
    fn default() -> Self {
        let mut capture = Self {
            backdrop: false,
            train: Vec::new(),
            test: Vec::new(),
            content: Content::Scene,
            enlarged: None,
            unit: 1.0,
            origin: DVec3::ZERO,
            outlier: None,
        };
        capture.surround(16, DISTANCE, pinhole(SIZE, ANGLE));
        capture
    }
}

impl Capture {
    /// Replaces all cameras: `train` training and four test cameras around the scene.
    pub(crate) fn surround(&mut self, train: usize, distance: f64, intrinsics: Intrinsics) {
        self.train = cameras_around("train", train, distance, intrinsics);
        self.test = cameras_around("test", 4, distance, intrinsics);
    }

    /// Returns all cameras.
    pub(crate) fn cameras(&mut self) -> impl Iterator<Item = &mut Camera> {
        self.train.iter_mut().chain(&mut self.test)
    }

    /// Takes the photographs and writes the data set.
    pub(crate) fn write(&self, folder: &Path) {
        let world = World::new(0);
        let world = if self.backdrop { world.with_backdrop() } else { world };
        std::fs::create_dir_all(folder.join("images")).unwrap();
        let mut frames = Vec::new();
        for (i, camera) in self.train.iter().chain(&self.test).enumerate() {
            let mut image = self.photograph(&world, camera, i as u64);
            let mut entry = camera.clone();
            if let Some([width, height]) = self.enlarged {
                let [w, h] = [width, height].map(|side| side as usize);
                image = resize_pillow(&image, w, h, Filter::Box);
                entry.intrinsics = camera.intrinsics.resized(width, height);
            }
            if self.outlier == Some(i) {
                entry.camera_to_world = self.train[(i + 7) % self.train.len()].camera_to_world;
            }
            let path = format!("images/{}.png", camera.name);
            write_png(&folder.join(&path), &image).unwrap();
            frames.push(self.frame(&entry, &path));
        }
        let names = |cameras: &[Camera]| -> Vec<String> {
            cameras.iter().map(|camera| format!("images/{}.png", camera.name)).collect()
        };
        let transforms = json!({"frames": frames, "train_filenames": names(&self.train),
            "test_filenames": names(&self.test)});
        std::fs::write(folder.join("transforms.json"), transforms.to_string()).unwrap();
    }

    /// Returns a frame of `transforms.json`.
    fn frame(&self, camera: &Camera, path: &str) -> Value {
        let Intrinsics { width, height, fx, fy, cx, cy, distortion } = camera.intrinsics;
        let mut matrix = camera.camera_to_world.to_vec();
        for (axis, row) in matrix.iter_mut().enumerate() {
            row[3] = self.unit * row[3] + self.origin[axis];
        }
        let model = if distortion.is_fisheye() { "OPENCV_FISHEYE" } else { "OPENCV" };
        let [k1, k2, k3, k4] = distortion.radial;
        let mut frame = json!({"file_path": path, "transform_matrix": matrix, "w": width,
            "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "k3": k3,
            "camera_model": model});
        if distortion.is_fisheye() {
            frame["k4"] = json!(k4);
        }
        frame
    }

    /// Renders a camera's photograph; an invalid lens is replaced by a pinhole.
    fn photograph(&self, world: &World, camera: &Camera, seed: u64) -> Rgba8 {
        let Intrinsics { width, height, .. } = camera.intrinsics;
        let mut camera = camera.clone();
        if camera.check().is_err() {
            camera.intrinsics.distortion = Distortion::default();
        }
        let mut random = Random::new(seed + 1);
        let mut data = Vec::new();
        for y in 0..height {
            for x in 0..width {
                data.extend(match self.content {
                    Content::Constant(level) => [level, level, level, 255],
                    Content::Transparent => [0; 4],
                    Content::Noise => {
                        let [r, g, b] = [(); 3].map(|()| random.below(256) as u8);
                        [r, g, b, 255]
                    }
                    Content::Scene => self.pixel(world, &camera, [x, y], 1.0),
                    Content::Overexposed => self.pixel(world, &camera, [x, y], 4.0),
                });
            }
        }
        Rgba8::new(width as usize, height as usize, data)
    }

    /// Renders a pixel of a camera's photograph, with straight alpha.
    fn pixel(&self, world: &World, camera: &Camera, [x, y]: [u32; 2], gain: f64) -> [u8; 4] {
        let (mut sum, mut hits) = (DVec3::ZERO, 0.0);
        for k in 0..SAMPLES * SAMPLES {
            let offset = |k: u32| (f64::from(k) + 0.5) / f64::from(SAMPLES);
            let [x, y] = [f64::from(x) + offset(k % SAMPLES), f64::from(y) + offset(k / SAMPLES)];
            let ray = camera.ray(x, y);
            if let Some((point, normal)) = world.surface(ray.origin, ray.direction) {
                sum += colour(point, normal);
                hits += 1.0;
            } else if self.backdrop {
                sum += DVec3::new(0.5, 0.65, 0.9) - 0.2 * ray.direction.z;
                hits += 1.0;
            }
        }
        let mean = gain * sum / f64::max(hits, 1.0);
        let [r, g, b] = mean.to_array().map(|c| (255.0 * c).round() as u8);
        [r, g, b, (255.0 * hits / f64::from(SAMPLES * SAMPLES)).round() as u8]
    }
}

/// Returns the colour of a surface: waves of the position, lit from above.
fn colour(point: DVec3, normal: DVec3) -> DVec3 {
    let light = 0.6 + 0.4 * normal.dot(DVec3::new(0.3, 0.5, 0.81)).max(-1.0);
    let wave = |phase: f64| 0.5 + 0.4 * (8.0 * point.x + phase).sin() * (8.0 * point.y).cos();
    light * DVec3::new(wave(0.0), wave(2.0), 0.5 + 0.4 * (9.0 * point.z).sin())
}

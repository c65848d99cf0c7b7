//! `camera-path`: creates cameras along a path through a scene, for `render-depth` and `video`.
//!
//! * [`Params`]: [`Kind`] of the path, number of frames, and more.
//! * `recorded`: reads a path that a viewer has recorded.
//! * [`poses`]: computes the poses of a path from the scene's cameras and bounds.

mod recorded;

use std::f64::consts::TAU;

use artifact::{Failure, GivenInput};
use glam::{DMat3, DQuat, DVec3};
use pixels::{DEGRADATION_FILE, Degradation};
use scene::{
    Bounds, Camera, Intrinsics, Pose, Space, VIEWS_FILE, View, Views, common_direction, looking_at,
    pose_of,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Stage};

/// Parameters of `camera-path`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Kind of path. Default: `list` if `poses` are given, `spiral` for cameras that look in one
    /// direction, otherwise `orbit`.
    #[schemars(extend("x-default" = "by cameras"))]
    pub kind: Option<Kind>,
    /// Number of frames. A `list` has one frame per pose.
    #[schemars(range(min = 1, max = 10000))]
    pub frames: u32,
    /// Number of turns of a spiral or orbit.
    #[schemars(range(min = 0.01, max = 100.0))]
    pub turns: f64,
    /// Radius of a spiral or orbit relative to that of the input cameras.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub radius: f64,
    /// Poses of `kind: list`: for each frame a `camera_to_world` matrix of three rows of four
    /// numbers, as in `views.json`.
    pub poses: Vec<Pose>,
    /// Width of the frames in pixels; the height follows from the first camera's aspect. Default:
    /// the width of the scene's HR images, or that of input `path`.
    #[schemars(range(min = 1, max = 65536), extend("x-default" = "by scene"))]
    pub size: Option<u32>,
}

impl Default for Params {
    fn default() -> Self {
        Self { kind: None, frames: 120, turns: 1.0, radius: 1.0, poses: Vec::new(), size: None }
    }
}

/// Kind of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Spiral around the mean camera, as wide as the positions of most cameras, looking at one
    /// point; for forward-facing photographs.
    Spiral,
    /// Circle around the middle of the scene's box, at the cameras' mean distance and height.
    Orbit,
    /// Closed curve through all cameras, in their order.
    Between,
    /// Poses of the parameter `poses`.
    List,
}

/// The stage.
pub struct CameraPath;

impl Stage for CameraPath {
    type Params = Params;
    const NAME: &'static str = "camera-path";
    const SUMMARY: &'static str = "Creates cameras along a path through a scene.";

    fn inputs() -> Vec<(&'static str, Input)> {
        let kinds =
            ["scene/train", "scene/cameras", "scene/truth", "scene/references", "cameras", "views"];
        let path = "folder with camera_path.json, as the viewer or nerfstudio records it; replaces \
            kind, frames and poses";
        vec![
            ("cameras", Input::required(&kinds, "folder with views.json: the scene's cameras")),
            ("path", Input::optional(&["camera-path"], path)),
        ]
    }

    fn output() -> Output {
        Output::kind("cameras")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let input = context.input("cameras")?;
        let scene = Views::read(input)?;
        let (cameras, kind) = match context.optional_input("path") {
            Some(path) => (recorded_cameras(path, params)?, "recorded".to_owned()),
            None => computed_cameras(input, &scene, params)?,
        };
        let views = cameras.into_iter().map(View::camera_only).collect();
        let views = Views::new(scene.background, scene.bounds, views);
        views.check().map_err(|e| Failure::Usage(format!("parameter poses: {e}")))?;
        context.write_json(VIEWS_FILE, &views)?;
        let size = views.views[0].camera.intrinsics;
        context.write_summary(&format!(
            "{} of {}×{}, {kind}",
            artifact::format_count(views.views.len(), "frame"),
            size.width,
            size.height,
        ))
    }
}

/// Returns a frame's name by its index.
pub(crate) fn frame_name(index: usize) -> String {
    format!("frame_{index:05}")
}

/// Returns the height of an image with another width and the same aspect.
fn height_at(width: u32, intrinsics: &Intrinsics) -> u32 {
    let aspect = f64::from(intrinsics.height) / f64::from(intrinsics.width);
    (f64::from(width) * aspect).round().max(1.0) as u32
}

/// Reads the cameras of a recorded path, with the width of the parameters, if given.
fn recorded_cameras(path: &GivenInput, params: &Params) -> Result<Vec<Camera>, Failure> {
    let mut cameras = recorded::read_cameras(path)?;
    if let Some(width) = params.size {
        for camera in &mut cameras {
            *camera = camera.resized(width, height_at(width, &camera.intrinsics));
        }
    }
    Ok(cameras)
}

/// Computes the cameras of a path, and the name of its kind.
fn computed_cameras(
    input: &GivenInput,
    scene: &Views,
    params: &Params,
) -> Result<(Vec<Camera>, String), Failure> {
    let mut first = scene.views[0].camera.clone();
    // Frames have no lens distortion.
    first.intrinsics = first.intrinsics.pinhole().unwrap_or(first.intrinsics);
    let degradation: Option<Degradation> = input.read_optional_json(DEGRADATION_FILE)?;
    let hr_width = degradation.map(|degradation| degradation.hr[0]);
    let width = params.size.or(hr_width).unwrap_or(first.intrinsics.width);
    let height = height_at(width, &first.intrinsics);
    let cameras: Vec<Camera> = scene.views.iter().map(|v| v.camera.clone()).collect();
    let kind = params.kind.unwrap_or_else(|| default_kind(&cameras, params));
    let poses = poses(kind, params, &cameras, &scene.bounds);
    if poses.is_empty() {
        let message = "parameter poses: kind list needs at least one pose";
        return Err(Failure::Usage(message.to_owned()));
    }
    let frames = poses.into_iter().enumerate().map(|(i, camera_to_world)| {
        Camera { name: frame_name(i), camera_to_world, ..first.clone() }.resized(width, height)
    });
    Ok((frames.collect(), format!("{kind:?}").to_lowercase()))
}

/// Chooses the kind of path if the parameter isn't given.
fn default_kind(cameras: &[Camera], params: &Params) -> Kind {
    if !params.poses.is_empty() {
        Kind::List
    } else if common_direction(cameras.iter()).is_some() {
        Kind::Spiral
    } else {
        Kind::Orbit
    }
}

/// Computes the poses of a path: `camera_to_world` of each frame.
pub fn poses(kind: Kind, params: &Params, cameras: &[Camera], bounds: &Bounds) -> Vec<Pose> {
    let fractions = (0..params.frames).map(|i| f64::from(i) / f64::from(params.frames));
    match kind {
        Kind::Spiral => spiral_poses(cameras, bounds, params, fractions),
        Kind::Orbit => orbit_poses(cameras, bounds, params, fractions),
        Kind::Between => fractions.map(|fraction| interpolated_pose(cameras, fraction)).collect(),
        Kind::List => params.poses.clone(),
    }
}

/// Returns the mean of a vector over the cameras.
fn mean(cameras: &[Camera], vector: impl Fn(&Camera) -> DVec3) -> DVec3 {
    cameras.iter().map(vector).sum::<DVec3>() / cameras.len().max(1) as f64
}

/// Computes the poses of a spiral at fractions of its length.
fn spiral_poses(
    cameras: &[Camera],
    bounds: &Bounds,
    params: &Params,
    fractions: impl Iterator<Item = f64>,
) -> Vec<Pose> {
    let centre = mean(cameras, Camera::centre);
    let forward = mean(cameras, Camera::forward).normalize_or(DVec3::NEG_Z);
    let right = forward.cross(mean(cameras, |c| c.rotation().y_axis)).normalize_or(DVec3::X);
    let up = right.cross(forward);
    let [width, height, depth] =
        [right, up, forward].map(|axis| params.radius * spread(cameras, centre, axis));
    let (near, far) = match bounds.space {
        Space::Ndc(frustum) => (frustum.near, frustum.far),
        _ => (bounds.near, bounds.far),
    };
    // Three quarters of the way from far to near in disparity, where most of a scene is; chosen by
    // hand.
    let focus = centre + forward / (0.25 / far + 0.75 / near.max(1e-3 * far));
    fractions
        .map(|fraction| {
            let angle = TAU * params.turns * fraction;
            let offset = width * angle.cos() * right
                + height * angle.sin() * up
                + depth * (0.5 * angle).sin() * forward;
            looking_at(centre + offset, focus, up)
        })
        .collect()
}

/// Returns the 90th percentile of the cameras' distances from a point along an axis (as in LLFF's
/// spirals).
fn spread(cameras: &[Camera], centre: DVec3, axis: DVec3) -> f64 {
    let mut offsets: Vec<f64> =
        cameras.iter().map(|c| (c.centre() - centre).dot(axis).abs()).collect();
    offsets.sort_by(f64::total_cmp);
    offsets[(offsets.len() - 1) * 9 / 10]
}

/// Computes the poses of an orbit at fractions of its length.
fn orbit_poses(
    cameras: &[Camera],
    bounds: &Bounds,
    params: &Params,
    fractions: impl Iterator<Item = f64>,
) -> Vec<Pose> {
    let up = mean(cameras, |c| c.rotation().y_axis).normalize_or(DVec3::Z);
    let middle = 0.5 * (DVec3::from(bounds.min) + DVec3::from(bounds.max));
    let height = mean(cameras, |c| c.centre() - middle).dot(up);
    let distance = cameras.iter().map(|c| (c.centre() - middle).length()).sum::<f64>()
        / cameras.len().max(1) as f64;
    let radius = (distance * distance - height * height).max(0.0).sqrt();
    let offset = cameras[0].centre() - middle;
    let first = (offset - offset.dot(up) * up).normalize_or(up.any_orthonormal_vector());
    fractions
        .map(|fraction| {
            let rotation = DQuat::from_axis_angle(up, TAU * params.turns * fraction);
            let offset = params.radius * (rotation * first * radius + height * up);
            looking_at(middle + offset, middle, up)
        })
        .collect()
}

/// Interpolates the pose at a fraction of the closed curve through all cameras: centres by a
/// Catmull-Rom spline, rotations along the shorter arc.
fn interpolated_pose(cameras: &[Camera], fraction: f64) -> Pose {
    let count = cameras.len();
    let position = fraction * count as f64;
    let (i, t) = (position as usize % count, position.fract());
    let [before, from, to, after] = [count - 1, 0, 1, 2].map(|k| &cameras[(i + k) % count]);
    let [a, b, c, d] = [before, from, to, after].map(Camera::centre);
    let centre = 0.5
        * (2.0 * b
            + (c - a) * t
            + (2.0 * a - 5.0 * b + 4.0 * c - d) * t * t
            + (3.0 * (b - c) + d - a) * t * t * t);
    let from = DQuat::from_mat3(&from.rotation());
    let to = DQuat::from_mat3(&to.rotation());
    pose_of(DMat3::from_quat(from.slerp(to, t).normalize()), centre)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(name: &str, camera_to_world: Pose) -> Camera {
        let intrinsics = Intrinsics::from_angle_x(40, 30, 0.7);
        Camera { name: name.to_owned(), intrinsics, camera_to_world }
    }

    fn cameras(places: &[DVec3], at: impl Fn(DVec3) -> DVec3) -> Vec<Camera> {
        let poses = places.iter().map(|&place| looking_at(place, at(place), DVec3::Z));
        poses.enumerate().map(|(i, pose)| camera(&i.to_string(), pose)).collect()
    }

    fn ring() -> Vec<Camera> {
        let places: Vec<DVec3> = (0..7)
            .map(|i| {
                DVec3::new(
                    4.0 * f64::from(i).cos(),
                    4.0 * f64::from(i).sin(),
                    1.0 + 0.1 * f64::from(i),
                )
            })
            .collect();
        cameras(&places, |_| DVec3::ZERO)
    }

    fn row() -> Vec<Camera> {
        let places: Vec<DVec3> = (0..9)
            .map(|i| DVec3::new(f64::from(i % 3) - 1.0, 0.0, 0.5 * f64::from(i / 3)))
            .collect();
        cameras(&places, |p| p + DVec3::Y)
    }

    const BOX: Bounds = Bounds::cube(1.0, 2.0, 6.0);

    fn whole(poses: &[Pose]) -> Vec<Camera> {
        let cameras: Vec<Camera> = poses.iter().map(|&pose| camera("c", pose)).collect();
        cameras.iter().for_each(|c| c.check().unwrap());
        cameras
    }

    #[test]
    fn an_orbit_goes_around_the_middle() {
        let params = Params { frames: 24, ..Params::default() };
        let cameras = ring();
        assert_eq!(default_kind(&cameras, &params), Kind::Orbit);
        let path = whole(&poses(Kind::Orbit, &params, &cameras, &BOX));
        assert_eq!(path.len(), 24);
        for camera in &path {
            assert!((camera.centre().length() - 4.2).abs() < 0.3, "{}", camera.centre());
            assert!(camera.forward().dot(-camera.centre().normalize()) > 0.999);
        }
        // No jump, not from the last to the first either.
        for (a, b) in path.iter().zip(path.iter().cycle().skip(1)) {
            assert!((a.centre() - b.centre()).length() < 1.2);
        }
    }

    #[test]
    fn a_spiral_stays_among_the_cameras_and_looks_their_way() {
        let params = Params { frames: 30, ..Params::default() };
        let cameras = row();
        assert_eq!(default_kind(&cameras, &params), Kind::Spiral);
        for camera in whole(&poses(Kind::Spiral, &params, &cameras, &BOX)) {
            let off = camera.centre() - DVec3::new(0.0, 0.0, 0.5);
            assert!(
                off.x.abs() <= 1.0 + 1e-9 && off.z.abs() <= 0.5 + 1e-9 && camera.forward().y > 0.8,
                "{off}"
            );
        }
    }

    #[test]
    fn between_passes_every_camera() {
        let cameras = ring();
        let params = Params { frames: 70, ..Params::default() };
        let path = whole(&poses(Kind::Between, &params, &cameras, &BOX));
        for (i, camera) in cameras.iter().enumerate() {
            let frame = &path[10 * i];
            assert!(
                (frame.centre() - camera.centre()).length() < 1e-9
                    && frame.forward().dot(camera.forward()) > 1.0 - 1e-9
            );
        }
    }

    #[test]
    fn one_camera_and_straight_down_are_paths_too() {
        let one = cameras(&[DVec3::new(0.0, 0.0, 4.0)], |_| DVec3::ZERO);
        let params = Params { frames: 5, ..Params::default() };
        for kind in [Kind::Spiral, Kind::Orbit, Kind::Between] {
            whole(&poses(kind, &params, &one, &BOX));
        }
    }
}

//! `camera-path`: cameras along a path through a scene, for `render-depth` to render and `video` to
//! show.
//!
//! * [`Params`]: which [`Kind`] of path, how many frames.
//! * [`poses`]: the poses of a path, from the cameras that saw the scene and its bounds.

use std::f64::consts::TAU;

use artifact::Failure;
use contract::{Input, Output};
use glam::{DMat3, DQuat, DVec3};
use pixels::{DEGRADATION_FILE, Degradation};
use scene::{
    Bounds, Camera, Pose, Space, VIEWS_FILE, View, Views, common_direction, looking_at, pose_of,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Stage};

/// Parameters of `camera-path`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Kind of path. Default: `list` with `poses`, `spiral` for cameras that look one way, else
    /// `orbit`.
    #[schemars(extend("x-default" = "by cameras"))]
    pub kind: Option<Kind>,
    /// Number of frames. A list has a frame for each pose.
    #[schemars(range(min = 1, max = 10000))]
    pub frames: u32,
    /// Turns of a spiral or orbit.
    #[schemars(range(min = 0.01, max = 100.0))]
    pub turns: f64,
    /// Radius of a spiral or orbit, over that of the given cameras.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub radius: f64,
    /// Poses of `kind: list`: for each frame a `camera_to_world` of three rows of four numbers, as
    /// in `views.json`.
    pub poses: Vec<Pose>,
    /// Width of the frames; the height follows the first camera's aspect. Default: the width of the
    /// scene's HR images.
    #[schemars(range(min = 1, max = 65536), extend("x-default" = "by scene"))]
    pub size: Option<u32>,
}

impl Default for Params {
    fn default() -> Self {
        Self { kind: None, frames: 120, turns: 1.0, radius: 1.0, poses: Vec::new(), size: None }
    }
}

/// Kinds of paths.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Around the mean camera, to the sides as far as most cameras go, looking at one point:
    /// forward-facing photographs.
    Spiral,
    /// Around the middle of the scene's box, at the cameras' mean distance and height.
    Orbit,
    /// From camera to camera, in their order, and back to the first.
    Between,
    /// The parameter `poses`.
    List,
}

/// The stage.
pub struct CameraPath;

impl Stage for CameraPath {
    type Params = Params;
    const NAME: &'static str = "camera-path";
    const SUMMARY: &'static str = "Makes cameras along a path through a scene.";

    fn inputs() -> Vec<(&'static str, Input)> {
        let kinds =
            ["scene/train", "scene/cameras", "scene/truth", "scene/references", "cameras", "views"];
        vec![(
            "cameras",
            Input::required(&kinds, "folder with views.json: the cameras that saw the scene"),
        )]
    }

    fn output() -> Output {
        Output::kind("cameras")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let input = context.input("cameras")?;
        let given = Views::read(input)?;
        let mut first = given.views[0].camera.clone();
        // Films are taken without lens distortion.
        first.intrinsics = first.intrinsics.pinhole().unwrap_or(first.intrinsics);
        let is_scene = input.path(DEGRADATION_FILE).exists();
        let made: Option<Degradation> =
            if is_scene { Some(input.read_json(DEGRADATION_FILE)?) } else { None };
        let width = params.size.or(made.map(|d| d.hr[0])).unwrap_or(first.intrinsics.width);
        let aspect = f64::from(first.intrinsics.height) / f64::from(first.intrinsics.width);
        let height = (f64::from(width) * aspect).round().max(1.0) as u32;
        let cameras: Vec<Camera> = given.views.iter().map(|v| v.camera.clone()).collect();
        let kind = params.kind.unwrap_or_else(|| default_kind(&cameras, params));
        let poses = poses(kind, params, &cameras, &given.bounds);
        if poses.is_empty() {
            return Err(
                Failure::Usage("parameter poses: kind list needs at least one".to_owned()).into()
            );
        }
        let views = poses.into_iter().enumerate().map(|(i, pose)| {
            let camera =
                Camera { name: format!("frame_{i:05}"), camera_to_world: pose, ..first.clone() };
            View::camera_only(camera.resized(width, height))
        });
        let views = Views::new(given.background, given.bounds, views.collect());
        views.check().map_err(|e| Failure::Usage(format!("parameter poses: {e}")))?;
        context.write_json(VIEWS_FILE, &views)?;
        context.write_summary(&format!(
            "{} of {width}×{height}, {}",
            artifact::counted(views.views.len(), "frame"),
            format!("{kind:?}").to_lowercase()
        ))
    }
}

fn default_kind(cameras: &[Camera], params: &Params) -> Kind {
    if !params.poses.is_empty() {
        Kind::List
    } else if common_direction(cameras.iter()).is_some() {
        Kind::Spiral
    } else {
        Kind::Orbit
    }
}

/// The poses of a path: `camera_to_world` of each frame.
pub fn poses(kind: Kind, params: &Params, cameras: &[Camera], bounds: &Bounds) -> Vec<Pose> {
    let shares = (0..params.frames).map(|i| f64::from(i) / f64::from(params.frames));
    match kind {
        Kind::Spiral => spiral(cameras, bounds, params, shares),
        Kind::Orbit => orbit(cameras, bounds, params, shares),
        Kind::Between => shares.map(|share| between(cameras, share)).collect(),
        Kind::List => params.poses.clone(),
    }
}

fn mean(cameras: &[Camera], of: impl Fn(&Camera) -> DVec3) -> DVec3 {
    cameras.iter().map(of).sum::<DVec3>() / cameras.len().max(1) as f64
}

fn spiral(
    cameras: &[Camera],
    bounds: &Bounds,
    params: &Params,
    shares: impl Iterator<Item = f64>,
) -> Vec<Pose> {
    let (centre, forward) =
        (mean(cameras, Camera::centre), mean(cameras, Camera::forward).normalize_or(DVec3::NEG_Z));
    let right = forward.cross(mean(cameras, |c| c.rotation().y_axis)).normalize_or(DVec3::X);
    let up = right.cross(forward);
    let [aside, above, ahead] =
        [right, up, forward].map(|axis| params.radius * reach(cameras, centre, axis));
    let (near, far) = match bounds.space {
        Space::Ndc(frustum) => (frustum.near, frustum.far),
        _ => (bounds.near, bounds.far),
    };
    // Three quarters of the way in disparity, where most is seen.
    let focus = centre + forward / (0.25 / far + 0.75 / near.max(1e-3 * far));
    shares
        .map(|share| {
            let angle = TAU * params.turns * share;
            let offset = aside * angle.cos() * right
                + above * angle.sin() * up
                + ahead * (0.5 * angle).sin() * forward;
            looking_at(centre + offset, focus, up)
        })
        .collect()
}

/// How far most cameras stand from a point along an axis: nine in ten lie within (as in LLFF's own
/// spirals).
fn reach(cameras: &[Camera], centre: DVec3, axis: DVec3) -> f64 {
    let mut offsets: Vec<f64> =
        cameras.iter().map(|c| (c.centre() - centre).dot(axis).abs()).collect();
    offsets.sort_by(f64::total_cmp);
    offsets[(offsets.len() - 1) * 9 / 10]
}

fn orbit(
    cameras: &[Camera],
    bounds: &Bounds,
    params: &Params,
    shares: impl Iterator<Item = f64>,
) -> Vec<Pose> {
    let up = mean(cameras, |c| c.rotation().y_axis).normalize_or(DVec3::Z);
    let middle = 0.5 * (DVec3::from(bounds.min) + DVec3::from(bounds.max));
    let height = mean(cameras, |c| c.centre() - middle).dot(up);
    // As far away as the cameras are, all in all.
    let distance = cameras.iter().map(|c| (c.centre() - middle).length()).sum::<f64>()
        / cameras.len().max(1) as f64;
    let around = (distance * distance - height * height).max(0.0).sqrt();
    let from = cameras[0].centre() - middle;
    let first = (from - from.dot(up) * up).normalize_or(up.any_orthonormal_vector());
    shares
        .map(|share| {
            let turn = DQuat::from_axis_angle(up, TAU * params.turns * share);
            looking_at(middle + params.radius * (turn * first * around + height * up), middle, up)
        })
        .collect()
}

/// Between two cameras of the round: centres by Catmull and Rom's spline, turns by the shorter arc.
fn between(cameras: &[Camera], share: f64) -> Pose {
    let count = cameras.len();
    let at = share * count as f64;
    let (i, t) = (at as usize % count, at.fract());
    let camera = |k: usize| &cameras[(i + k) % count];
    let [a, b, c, d] = [count - 1, 0, 1, 2].map(|k| camera(k).centre());
    let centre = 0.5
        * (2.0 * b
            + (c - a) * t
            + (2.0 * a - 5.0 * b + 4.0 * c - d) * t * t
            + (3.0 * (b - c) + d - a) * t * t * t);
    let (from, to) =
        (DQuat::from_mat3(&camera(0).rotation()), DQuat::from_mat3(&camera(1).rotation()));
    pose_of(DMat3::from_quat(from.slerp(to, t).normalize()), centre)
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::Intrinsics;

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

    const BOX: Bounds =
        Bounds { min: [-1.0; 3], max: [1.0; 3], near: 2.0, far: 6.0, space: Space::Box };

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

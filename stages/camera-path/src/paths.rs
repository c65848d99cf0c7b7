//! Poses of paths, from the scene's cameras and bounds.

use std::f64::consts::TAU;

use glam::{DMat3, DQuat, DVec3};
use scene::{Bounds, Camera, Pose, Space, looking_at, pose_of};

use crate::Kind;
use crate::coverage::Coverage;
use crate::orbit::Orbit;

/// Disparity of the point that a spiral's frames face, as a fraction of the disparity range: 0 is
/// far, 1 is near, where most of a scene is; chosen by hand.
const FOCUS_FRACTION: f64 = 0.75;
/// Shares of the focus's disparity that are tried; with 0 all frames look in one direction.
const FOCUS_STEPS: [f64; 5] = [1.0, 0.75, 0.5, 0.25, 0.0];
/// Maximum share of a frame's tested points that no camera observes. In frames of scene fern, the
/// unobserved points are in corners at the nearest depth, where fern has no surface. With a maximum
/// of 0, fern's spiral would be 0.35 times as wide as the cameras' positions, not 0.95 times.
const MAX_UNSEEN_FRACTION: f64 = 0.01;
/// Number of sizes that are tried for a spiral; chosen by hand.
const SIZE_STEPS: u32 = 20;
/// Number of frames of a spiral that are tested; chosen by hand.
const TESTED_FRAMES: u32 = 32;

/// Computes the poses of a closed path: `camera_to_world` of each frame. `template` has the frames'
/// image size and lens.
pub fn poses(
    kind: Kind,
    frame_count: u32,
    template: &Camera,
    cameras: &[Camera],
    bounds: &Bounds,
) -> Vec<Pose> {
    let fractions = (0..frame_count).map(|i| f64::from(i) / f64::from(frame_count));
    match kind {
        Kind::Spiral => {
            let spiral = Spiral::fit(cameras, template, bounds);
            fractions.map(|fraction| spiral.pose(TAU * fraction)).collect()
        }
        Kind::Orbit => {
            let orbit = Orbit::fit(cameras, bounds);
            fractions.map(|fraction| orbit.pose(fraction)).collect()
        }
        Kind::Between => fractions.map(|fraction| interpolated_pose(cameras, fraction)).collect(),
    }
}

/// Returns the mean of a vector over the cameras.
pub(crate) fn mean(cameras: &[Camera], vector: impl Fn(&Camera) -> DVec3) -> DVec3 {
    cameras.iter().map(vector).sum::<DVec3>() / cameras.len().max(1) as f64
}

/// Returns the minimum and maximum depth of the scene.
fn depth_range(bounds: &Bounds) -> (f64, f64) {
    let (near, far) = match bounds.space {
        Space::Ndc(frustum) => (frustum.near, frustum.far),
        _ => (bounds.near, bounds.far),
    };
    // The limit is chosen by hand.
    (near.max(1e-3 * far), far)
}

/// Spiral around the mean camera.
#[derive(Clone, Copy)]
struct Spiral {
    centre: DVec3,
    forward: DVec3,
    up: DVec3,
    /// Largest offsets to the right, up and forward.
    axes: [DVec3; 3],
    /// 1 / depth of the point that all frames look at; 0 for frames that look in one direction.
    disparity: f64,
}

impl Spiral {
    /// Creates a spiral as wide as the positions of most cameras, whose frames look at one point of
    /// the scene.
    fn around(cameras: &[Camera], (near, far): (f64, f64)) -> Self {
        let centre = mean(cameras, Camera::centre);
        let forward = mean(cameras, Camera::forward).normalize_or(DVec3::NEG_Z);
        let right = forward.cross(mean(cameras, |c| c.rotation().y_axis)).normalize_or(DVec3::X);
        let up = right.cross(forward);
        let axes = [right, up, forward].map(|axis| spread(cameras, centre, axis) * axis);
        let disparity = (1.0 - FOCUS_FRACTION) / far + FOCUS_FRACTION / near;
        Self { centre, forward, up, axes, disparity }
    }

    /// Creates the largest spiral that stays where the cameras looked: at most
    /// [`MAX_UNSEEN_FRACTION`] of a frame is unobserved, or as much as at the mean camera. A
    /// farther focus is preferred to a smaller spiral.
    fn fit(cameras: &[Camera], template: &Camera, bounds: &Bounds) -> Self {
        let (near, far) = depth_range(bounds);
        let whole = Self::around(cameras, (near, far));
        let coverage = Coverage::new(cameras, template, near, far);
        let at_mean = coverage.count_unseen(whole.scaled(0.0, 0.0).pose(0.0));
        let allowed = at_mean.max((MAX_UNSEEN_FRACTION * coverage.point_count() as f64) as usize);
        let angle = |i: u32| TAU * f64::from(i) / f64::from(TESTED_FRAMES);
        for step in (1..=SIZE_STEPS).rev() {
            for focus in FOCUS_STEPS {
                let spiral = whole.scaled(f64::from(step) / f64::from(SIZE_STEPS), focus);
                let stays = (0..TESTED_FRAMES)
                    .all(|i| coverage.count_unseen(spiral.pose(angle(i))) <= allowed);
                if stays {
                    return spiral;
                }
            }
        }
        whole.scaled(0.0, 0.0)
    }

    /// Returns the spiral with scaled offsets and disparity.
    fn scaled(self, size: f64, focus: f64) -> Self {
        Self { axes: self.axes.map(|axis| size * axis), disparity: focus * self.disparity, ..self }
    }

    /// Returns the pose at an angle.
    fn pose(&self, angle: f64) -> Pose {
        let [right, up, forward] = self.axes;
        let offset = angle.cos() * right + angle.sin() * up + (0.5 * angle).sin() * forward;
        let position = self.centre + offset;
        // Towards `centre + forward / disparity`, which is infinitely far at disparity 0.
        looking_at(position, position + self.forward - self.disparity * offset, self.up)
    }
}

/// Returns the 90th percentile of the cameras' distances from a point along an axis (as in LLFF's
/// spirals).
fn spread(cameras: &[Camera], centre: DVec3, axis: DVec3) -> f64 {
    let mut offsets: Vec<f64> =
        cameras.iter().map(|c| (c.centre() - centre).dot(axis).abs()).collect();
    offsets.sort_by(f64::total_cmp);
    offsets[(offsets.len() - 1) * 9 / 10]
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
    use scene::Intrinsics;

    use super::*;
    use crate::default_kind;

    fn camera(name: &str, camera_to_world: Pose) -> Camera {
        let intrinsics = Intrinsics::from_angle_x(40, 30, 0.7);
        Camera { name: name.to_owned(), intrinsics, camera_to_world }
    }

    fn cameras(positions: &[DVec3], target: impl Fn(DVec3) -> DVec3) -> Vec<Camera> {
        let poses = positions.iter().map(|&p| looking_at(p, target(p), DVec3::Z));
        poses.enumerate().map(|(i, pose)| camera(&i.to_string(), pose)).collect()
    }

    fn ring() -> Vec<Camera> {
        let positions: Vec<DVec3> = (0..7)
            .map(|i| {
                DVec3::new(
                    4.0 * f64::from(i).cos(),
                    4.0 * f64::from(i).sin(),
                    1.0 + 0.1 * f64::from(i),
                )
            })
            .collect();
        cameras(&positions, |_| DVec3::ZERO)
    }

    fn parallel_grid() -> Vec<Camera> {
        let positions: Vec<DVec3> = (0..9)
            .map(|i| DVec3::new(f64::from(i % 3) - 1.0, 0.0, 0.5 * f64::from(i / 3)))
            .collect();
        cameras(&positions, |p| p + DVec3::Y)
    }

    const BOX: Bounds = Bounds::cube(1.0, 2.0, 6.0);

    /// Returns cameras at the poses; fails if one is invalid.
    fn valid_cameras(poses: &[Pose]) -> Vec<Camera> {
        let cameras: Vec<Camera> = poses.iter().map(|&pose| camera("c", pose)).collect();
        cameras.iter().for_each(|c| c.check().unwrap());
        cameras
    }

    #[test]
    fn an_orbit_circles_the_origin() {
        let cameras = ring();
        assert_eq!(default_kind(&cameras), Kind::Orbit);
        let path = valid_cameras(&poses(Kind::Orbit, 24, &cameras[0], &cameras, &BOX));
        assert_eq!(path.len(), 24);
        for camera in &path {
            assert!((camera.centre().length() - 4.2).abs() < 0.3, "{}", camera.centre());
            assert!(camera.forward().dot(-camera.centre().normalize()) > 0.999);
        }
        // No jump between frames, nor from the last to the first.
        for (a, b) in path.iter().zip(path.iter().cycle().skip(1)) {
            assert!((a.centre() - b.centre()).length() < 1.2);
        }
    }

    #[test]
    fn a_spiral_stays_among_the_cameras_and_faces_their_direction() {
        let cameras = parallel_grid();
        assert_eq!(default_kind(&cameras), Kind::Spiral);
        for camera in valid_cameras(&poses(Kind::Spiral, 30, &cameras[0], &cameras, &BOX)) {
            let offset = camera.centre() - DVec3::new(0.0, 0.0, 0.5);
            assert!(
                offset.x.abs() <= 1.0 + 1e-9
                    && offset.z.abs() <= 0.5 + 1e-9
                    && camera.forward().y > 0.8,
                "{offset}"
            );
        }
    }

    /// A spiral fitted to a grid of parallel cameras shows few points that no camera observes. An
    /// unfitted spiral around a near point shows many.
    #[test]
    fn a_fitted_spiral_shows_observed_points() {
        let cameras = parallel_grid();
        let bounds = Bounds::cube(20.0, 4.0, 40.0);
        let range = depth_range(&bounds);
        let coverage = Coverage::new(&cameras, &cameras[0], range.0, range.1);
        let max_unseen = |poses: &[Pose]| {
            let counts = poses.iter().map(|&pose| coverage.count_unseen(pose));
            counts.max().unwrap_or(0)
        };
        let around = Spiral::around(&cameras, range);
        let poses_around: Vec<Pose> = (0..8).map(|i| around.pose(f64::from(i))).collect();
        assert!(max_unseen(&poses_around) > 15, "{}", max_unseen(&poses_around));
        let path = poses(Kind::Spiral, 50, &cameras[0], &cameras, &bounds);
        let max_x = valid_cameras(&path).iter().map(|c| c.centre().x).fold(0.0, f64::max);
        assert!(max_unseen(&path) <= 4 && max_x > 0.9, "{} {max_x}", max_unseen(&path));
    }

    #[test]
    fn between_passes_every_camera() {
        let cameras = ring();
        let path = valid_cameras(&poses(Kind::Between, 70, &cameras[0], &cameras, &BOX));
        for (i, camera) in cameras.iter().enumerate() {
            let frame = &path[10 * i];
            assert!(
                (frame.centre() - camera.centre()).length() < 1e-9
                    && frame.forward().dot(camera.forward()) > 1.0 - 1e-9
            );
        }
    }

    #[test]
    fn one_camera_that_looks_down_has_paths() {
        let single = cameras(&[DVec3::new(0.0, 0.0, 4.0)], |_| DVec3::ZERO);
        for kind in [Kind::Spiral, Kind::Orbit, Kind::Between] {
            valid_cameras(&poses(kind, 5, &single[0], &single, &BOX));
        }
    }
}

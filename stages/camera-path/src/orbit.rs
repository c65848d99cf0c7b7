//! Orbits: circles around a scene, or arcs of circles.

use std::f64::consts::TAU;

use glam::{DQuat, DVec3};
use scene::{Bounds, Camera, Pose, looking_at};

use crate::paths::mean;

/// Minimum angle without cameras that an orbit leaves out, in radians; chosen by hand.
const MIN_GAP: f64 = TAU / 8.0;
/// Minimum ratio of this angle to the median angle between neighbouring cameras, so that few
/// cameras all around give a circle. Chosen by hand.
const MIN_GAP_OVER_MEDIAN: f64 = 3.0;
/// Minimum distance of a camera from the axis, as a fraction of the orbit's radius: nearer cameras
/// look down, and their angles around the axis mean little. In a panorama, minimum horizontal part
/// of a unit viewing direction. Chosen by hand.
const MIN_AXIS_DISTANCE: f64 = 0.25;
/// Maximum mean distance of a panorama's cameras from the middle of the scene's box, as a fraction
/// of the box's longest side. Far above rounding errors; chosen by hand.
const MAX_PANORAMA_DISTANCE: f64 = 1e-6;
/// Steps of [`up_direction`]: enough for level cameras along an arc of 40°; chosen by hand.
const UP_STEPS: u32 = 100;

/// Circle around the middle of the scene's box, or an arc of this circle. For a panorama, whose
/// cameras are all at the middle, the frames are at the middle, too, and face outwards.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Orbit {
    middle: DVec3,
    up: DVec3,
    /// Direction from the axis to the frame at angle 0.
    first: DVec3,
    /// Radius; 0 for a panorama.
    radius: f64,
    /// Height above the middle; 0 for a panorama.
    height: f64,
    /// Maximum angle to both sides of `first` in radians; `None` for a whole circle.
    half_arc: Option<f64>,
}

impl Orbit {
    /// Creates the orbit at the cameras' mean distance and height. If the largest gap between
    /// cameras is wide, the orbit is the arc outside the gap.
    pub(crate) fn fit(cameras: &[Camera], bounds: &Bounds) -> Self {
        let up = up_direction(cameras);
        let middle = bounds.middle();
        let distance = cameras.iter().map(|c| (c.centre() - middle).length()).sum::<f64>()
            / cameras.len().max(1) as f64;
        let is_panorama = distance <= MAX_PANORAMA_DISTANCE * bounds.longest_side();
        let (mut height, mut radius) = (0.0, 0.0);
        if !is_panorama {
            height = mean(cameras, |c| c.centre() - middle).dot(up);
            radius = (distance * distance - height * height).max(0.0).sqrt();
        }
        let from_axis = |camera: &Camera| {
            let offset = if is_panorama { camera.forward() } else { camera.centre() - middle };
            offset - offset.dot(up) * up
        };
        let min_offset = MIN_AXIS_DISTANCE * if is_panorama { 1.0 } else { radius };
        let first = from_axis(&cameras[0]).normalize_or(up.any_orthonormal_vector());
        let angles = cameras
            .iter()
            .map(from_axis)
            .filter(|offset| offset.length() > min_offset)
            .map(|offset| up.cross(first).dot(offset).atan2(first.dot(offset)));
        let whole = Self { middle, up, first, radius, height, half_arc: None };
        match arc(angles.collect()) {
            Some((start, length)) => {
                let first = DQuat::from_axis_angle(up, start + 0.5 * length) * first;
                Self { first, half_arc: Some(0.5 * length), ..whole }
            }
            None => whole,
        }
    }

    /// Returns the pose at a fraction of the path.
    pub(crate) fn pose(&self, fraction: f64) -> Pose {
        let turn = TAU * fraction;
        // An arc is travelled there and back, so that the film loops.
        let angle = self.half_arc.map_or(turn, |half_arc| half_arc * turn.sin());
        let rotation = DQuat::from_axis_angle(self.up, angle);
        let outwards = rotation * self.first;
        if (self.radius, self.height) == (0.0, 0.0) {
            return looking_at(self.middle, self.middle + outwards, self.up);
        }
        let offset = outwards * self.radius + self.height * self.up;
        looking_at(self.middle + offset, self.middle, self.up)
    }
}

/// Returns the direction most perpendicular to the cameras' x axes, by power iteration from the
/// mean of their y axes, which lean to the middle.
fn up_direction(cameras: &[Camera]) -> DVec3 {
    let mut up = mean(cameras, |c| c.rotation().y_axis).normalize_or(DVec3::Z);
    for _ in 0..UP_STEPS {
        let rejected = mean(cameras, |c| up.reject_from_normalized(c.rotation().x_axis));
        up = rejected.normalize_or(up);
    }
    up
}

/// Returns start and length of the arc outside the largest gap between angles; `None` if no gap is
/// wide.
fn arc(mut angles: Vec<f64>) -> Option<(f64, f64)> {
    angles.sort_by(f64::total_cmp);
    let last = *angles.last()?;
    let previous = std::iter::once(last - TAU).chain(angles.iter().copied());
    // Each gap with the angle at which it ends.
    let mut gaps: Vec<(f64, f64)> =
        previous.zip(&angles).map(|(from, &to)| (to - from, to)).collect();
    gaps.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (median, _) = gaps[(gaps.len() - 1) / 2];
    let (largest, end) = *gaps.last()?;
    let is_wide = largest > MIN_GAP && largest > MIN_GAP_OVER_MEDIAN * median;
    is_wide.then_some((end, TAU - largest))
}

#[cfg(test)]
mod tests {
    use scene::Intrinsics;

    use super::*;

    const BOX: Bounds = Bounds::cube(1.0, 2.0, 6.0);

    /// Returns cameras that look at the origin, at angles in degrees and a height.
    fn cameras(angles: impl IntoIterator<Item = f64>, height: f64) -> Vec<Camera> {
        let camera = |angle: f64| {
            let (sine, cosine) = angle.to_radians().sin_cos();
            let position = DVec3::new(4.0 * cosine, 4.0 * sine, height);
            Camera {
                name: angle.to_string(),
                intrinsics: Intrinsics::from_angle_x(40, 30, 0.7),
                camera_to_world: looking_at(position, DVec3::ZERO, DVec3::Z),
            }
        };
        angles.into_iter().map(camera).collect()
    }

    /// Returns the angles of an orbit's frames in degrees.
    fn frames(cameras: &[Camera]) -> Vec<f64> {
        let orbit = Orbit::fit(cameras, &BOX);
        let poses = (0..64).map(|i| orbit.pose(f64::from(i) / 64.0));
        poses.map(|pose| pose[1][3].atan2(pose[0][3]).to_degrees()).collect()
    }

    /// Frames stay between the first and the last camera of an arc, also across 180°, and reach
    /// both. No step between frames is a jump, including the step from the last to the first.
    #[test]
    fn an_orbit_of_an_arc_stays_on_it() {
        for (start, step) in [(10.0, 8.0), (130.0, 6.0), (0.0, 18.0)] {
            let arc = cameras((0..16).map(|i| start + step * f64::from(i)), 1.0);
            let (middle, half) = (start + 7.5 * step, 7.5 * step);
            let offsets: Vec<f64> = frames(&arc)
                .iter()
                .map(|angle| (angle - middle + 540.0).rem_euclid(360.0) - 180.0)
                .collect();
            let extent = |sign: f64| offsets.iter().map(|o| sign * o).fold(f64::MIN, f64::max);
            for sign in [-1.0, 1.0] {
                assert!((extent(sign) - half).abs() < 1e-3, "{start}: {}", extent(sign));
            }
            for (a, b) in offsets.iter().zip(offsets.iter().cycle().skip(1)) {
                assert!((a - b).abs() < 0.1 * TAU * half / 6.0, "{a} {b}");
            }
        }
    }

    /// A few cameras all around, cameras with a small gap, and a single camera give a circle.
    #[test]
    fn cameras_all_around_give_a_circle() {
        let few = (0..4).map(|i| 90.0 * f64::from(i)).collect::<Vec<_>>();
        let gap = (0..41).map(|i| 8.0 * f64::from(i)).collect();
        for angles in [few, gap, vec![30.0]] {
            let frames = frames(&cameras(angles.clone(), 1.0));
            assert!(frames.iter().any(|a| *a < -170.0) && frames.iter().any(|a| *a > 170.0));
            // A quarter of the frames is in the first quadrant.
            let quarter =
                |from: f64| frames.iter().filter(move |a| (from..from + 90.0).contains(*a));
            assert!((14..=18).contains(&quarter(0.0).count()), "{angles:?}");
        }
    }

    /// The result is vertical although the cameras look down from one side, so that their own up
    /// directions lean to the middle.
    #[test]
    fn up_direction_of_an_arc_is_vertical() {
        for (count, height) in [(4, 2.0), (16, 5.0)] {
            let arc = cameras((0..=count).map(|i| 10.0 * f64::from(i)), height);
            let up = up_direction(&arc);
            assert!(up.dot(DVec3::Z) > 0.999, "{count}: {up}");
        }
        let rolled = cameras([0.0], 1.0);
        assert!(up_direction(&rolled).dot(rolled[0].rotation().y_axis) > 0.9999);
    }

    /// Frames of cameras at the middle, up to rounding, look all around or, for an arc, where the
    /// cameras look.
    #[test]
    fn cameras_at_the_middle_give_a_panorama() {
        for (count, arc) in [(12, None), (5, Some(120.0))] {
            let outwards = cameras((0..count).map(|i| 30.0 * f64::from(i)), 0.0);
            let at_centre = outwards.iter().map(|c| {
                let position = -1e-16 * c.centre();
                let pose = looking_at(position, position + c.centre(), DVec3::Z);
                Camera { camera_to_world: pose, ..c.clone() }
            });
            let orbit = Orbit::fit(&at_centre.collect::<Vec<_>>(), &BOX);
            let angles = (0..64).map(|i| {
                let pose = orbit.pose(f64::from(i) / 64.0);
                assert!([0, 1, 2].iter().all(|&row| pose[row][3].abs() < 1e-9), "{pose:?}");
                let forward = [0, 1, 2].map(|row| -pose[row][2]);
                assert!(forward[2].abs() < 1e-6, "{forward:?}");
                forward[1].atan2(forward[0]).to_degrees()
            });
            let angles: Vec<f64> = angles.collect();
            let min = angles.iter().copied().fold(f64::MAX, f64::min);
            let max = angles.iter().copied().fold(f64::MIN, f64::max);
            match arc {
                None => assert!(min < -170.0 && max > 170.0, "{min} {max}"),
                Some(end) => assert!(min.abs() < 1e-3 && f64::abs(max - end) < 1e-3, "{min} {max}"),
            }
        }
    }

    /// A camera above the centre has no meaningful angle around the axis.
    #[test]
    fn cameras_above_the_centre_are_ignored() {
        let mut arc = cameras((0..13).map(|i| 10.0 * f64::from(i)), 1.0);
        let above = DVec3::new(-0.3, -0.3, 4.0);
        let pose = looking_at(above, DVec3::ZERO, DVec3::Z);
        arc.push(Camera { camera_to_world: pose, ..arc[0].clone() });
        assert!(frames(&arc).iter().all(|a| (-10.0..130.0).contains(a)));
    }
}

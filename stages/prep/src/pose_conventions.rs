//! Detects poses in another convention than camera-to-world with axes right, up, backward.

use artifact::format_count;
use glam::{DMat3, DVec3};
use scene::{Camera, pose_of};

use crate::bounds::{MIN_CENTRE_DETERMINANT, crossing_point};
use crate::pose_warnings::{MIN_CAMERAS, median};

/// Maximum median sine of the angle between a camera's axis and the point that all cameras face:
/// hand-held photographs of an object have less than 0.1. Chosen by hand.
const MAX_AXIS_ERROR: f64 = 0.15;
/// Minimum mean sine by which cameras around an object look down; cameras of a level panorama look
/// neither down nor up. Chosen by hand.
const MIN_DOWNWARD: f64 = 0.05;

/// Returns a warning if the cameras face one point only in another convention. Photographs of an
/// object do; photographs in one direction, or from the middle of a room, do in none.
pub(crate) fn convention_warning(training: &[Camera]) -> Option<String> {
    if training.len() < MIN_CAMERAS || do_face_one_point(training) {
        return None;
    }
    let flipped: Vec<Camera> = training.iter().map(flipped).collect();
    let inverted: Vec<Camera> = training.iter().map(inverted).collect();
    let convention = if do_face_one_point(&flipped) && do_look_down(&flipped) {
        "with y and z axes flipped (OpenCV's axes)"
    } else if do_face_one_point(&inverted) {
        "with inverted matrices (world-to-camera)"
    } else {
        return None;
    };
    let count = format_count(training.len(), "training camera");
    Some(format!(
        "{count} face no common point, but would {convention}: poses must be camera-to-world, with \
        axes right, up, backward"
    ))
}

/// Returns a camera with its y and z axes negated.
fn flipped(camera: &Camera) -> Camera {
    let axes = camera.rotation();
    let rotation = DMat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis);
    Camera { camera_to_world: pose_of(rotation, camera.centre()), ..camera.clone() }
}

/// Returns a camera with the inverse pose.
fn inverted(camera: &Camera) -> Camera {
    let rotation = camera.rotation().transpose();
    Camera { camera_to_world: pose_of(rotation, -(rotation * camera.centre())), ..camera.clone() }
}

/// True if nine in ten cameras have the point nearest to all axes in front of them, and half of
/// the axes pass close by.
fn do_face_one_point(cameras: &[Camera]) -> bool {
    let all: Vec<&Camera> = cameras.iter().collect();
    let Some(point) = crossing_point(&all, MIN_CENTRE_DETERMINANT) else { return false };
    let directions = cameras.iter().map(|camera| (point - camera.centre()).normalize_or_zero());
    let (mut facing, mut errors) = (0, Vec::new());
    for (camera, direction) in cameras.iter().zip(directions) {
        facing += usize::from(direction.dot(camera.forward()) > 0.0);
        errors.push(direction.cross(camera.forward()).length());
    }
    10 * facing >= 9 * cameras.len() && median(errors.into_iter()) <= MAX_AXIS_ERROR
}

/// True if cameras look down in the mean, relative to their common up direction.
fn do_look_down(cameras: &[Camera]) -> bool {
    let sum = |vector: fn(&Camera) -> DVec3| cameras.iter().map(vector).sum::<DVec3>();
    let up = sum(|camera| camera.rotation().y_axis).normalize_or_zero();
    sum(Camera::forward).dot(up) < -MIN_DOWNWARD * cameras.len() as f64
}

#[cfg(test)]
mod tests {
    use scene::{Intrinsics, looking_at};

    use super::*;

    fn camera(from: DVec3, target: DVec3) -> Camera {
        Camera {
            name: "c".into(),
            intrinsics: Intrinsics::from_angle_x(32, 24, 0.69),
            camera_to_world: looking_at(from, target, DVec3::Z),
        }
    }

    /// Returns the direction of camera `i` of a turn, with slightly varying length and height.
    fn direction(i: u32, height: f64) -> DVec3 {
        let angle = 0.7 * f64::from(i);
        let jitter = 0.1 * f64::from(i % 3);
        DVec3::new(angle.cos(), angle.sin(), height + jitter)
    }

    /// Returns hand-held cameras around an object away from the origin.
    fn around_object() -> Vec<Camera> {
        let object = DVec3::new(3.0, -1.0, 0.5);
        let from = |i| object + 4.0 * direction(i, 0.4);
        let target = |i: u32| object + 0.2 * DVec3::new(f64::from(i % 2), f64::from(i % 3), 0.0);
        (0..20).map(|i| camera(from(i), target(i))).collect()
    }

    #[test]
    fn other_conventions_cause_a_warning() {
        let right = around_object();
        assert_eq!(convention_warning(&right), None);
        let converted = |convert: fn(&Camera) -> Camera| right.iter().map(convert).collect();
        let (wrong, inverse): (Vec<Camera>, Vec<Camera>) =
            (converted(flipped), converted(inverted));
        assert_eq!(
            convention_warning(&wrong).unwrap(),
            "20 training cameras face no common point, but would with y and z axes flipped \
            (OpenCV's axes): poses must be camera-to-world, with axes right, up, backward"
        );
        let message = convention_warning(&inverse).unwrap();
        assert!(message.contains("with inverted matrices (world-to-camera)"), "{message}");
        assert_eq!(convention_warning(&wrong[..3]), None);
    }

    #[test]
    fn other_captures_cause_no_warning() {
        let forward = |i: u32| {
            let from = DVec3::new(0.3 * f64::from(i % 5), 0.2 * f64::from(i / 5), 1.0);
            camera(from, from + DVec3::new(0.05 * f64::from(i % 2), 10.0, 0.0))
        };
        let panning = |i: u32| {
            let out = DVec3::new((0.1 * f64::from(i)).cos(), (0.1 * f64::from(i)).sin(), 0.0);
            camera(0.4 * out, 3.0 * out)
        };
        let level_panorama = |i: u32| {
            let out = direction(i, -0.1);
            camera(0.5 * out, 3.0 * out)
        };
        // An arm's length from the body, which moves, and the phone looks down.
        let hand_held = |i: u32| {
            let out = direction(i, -0.4);
            let step = 0.3 * DVec3::new(f64::from(i % 2), f64::from(i % 3), 0.0);
            camera(0.5 * out + step, 3.0 * out)
        };
        // From the centre, with photographs in all directions.
        let turning = |i: u32| camera(0.02 * direction(i * i, 0.3), 3.0 * direction(i, 0.1));
        for (name, camera_of) in [
            ("forward", &forward as &dyn Fn(u32) -> Camera),
            ("panning", &panning),
            ("level panorama", &level_panorama),
            ("hand-held", &hand_held),
            ("turning", &turning),
        ] {
            let cameras: Vec<Camera> = (0..20).map(camera_of).collect();
            assert_eq!(convention_warning(&cameras), None, "{name}");
        }
    }
}

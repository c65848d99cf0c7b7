//! Flaws of training views: exposures that differ, and poses that aren't exact.

use glam::{DMat3, DQuat, DVec3};
use numerics::CounterRng;
use pixels::Rgba8;
use scene::pose_of;

use crate::params::Params;

/// RNG stream of exposures.
const EXPOSURE_STREAM: u64 = 401;
/// RNG stream of pose errors.
const POSE_STREAM: u64 = 402;

/// Multiplies the display-encoded colours of training view `i` by a random gain.
pub(crate) fn expose(image: &mut Rgba8, params: &Params, i: u32) {
    if params.exposure_difference == 0.0 {
        return;
    }
    let mut rng = CounterRng::new(u64::from(params.seed), EXPOSURE_STREAM, u64::from(i));
    let sign = if rng.uniform() < 0.5 { -1.0 } else { 1.0 };
    let gain = libm::exp(sign * params.exposure_difference);
    for pixel in image.data.chunks_exact_mut(4) {
        for level in &mut pixel[..3] {
            *level = (f64::from(*level) * gain).round().min(255.0) as u8;
        }
    }
}

/// Returns the pose of training view `i`, turned by a random error, for the camera file.
pub(crate) fn with_error(pose: &[[f64; 4]; 4], params: &Params, i: u32) -> [[f64; 4]; 4] {
    if params.pose_error == 0.0 {
        return *pose;
    }
    let mut rng = CounterRng::new(u64::from(params.seed), POSE_STREAM, u64::from(i));
    // The sum of twelve uniform numbers is almost normal, with variance 1.
    let mut normal = || (0..12).map(|_| f64::from(rng.uniform())).sum::<f64>() - 6.0;
    let rotation = DVec3::new(normal(), normal(), normal());
    let error = DQuat::from_scaled_axis(params.pose_error.to_radians() * rotation);
    let column = |k: usize| DVec3::new(pose[0][k], pose[1][k], pose[2][k]);
    let axes = DMat3::from_cols(column(0), column(1), column(2)) * DMat3::from_quat(error);
    crate::camera_to_world(pose_of(axes, column(3)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Views and poses are unchanged unless a flaw is requested; flaws have the requested size.
    #[test]
    fn flaws_have_the_requested_size() {
        let exact = Params::default();
        let image = || Rgba8::new(2, 1, vec![100, 50, 200, 128, 250, 0, 10, 255]);
        let pose = crate::camera_pose(exact.layout, "train", 3, 10);
        let mut unchanged = image();
        expose(&mut unchanged, &exact, 0);
        assert_eq!((unchanged, with_error(&pose, &exact, 3)), (image(), pose));

        let flawed = Params { exposure_difference: 0.1, pose_error: 0.5, ..exact };
        let mut levels = [0; 100];
        for (i, level) in levels.iter_mut().enumerate() {
            let mut exposed = image();
            expose(&mut exposed, &flawed, i as u32);
            *level = exposed.data[0];
            assert_eq!([exposed.data[3], exposed.data[7]], [128, 255]);
        }
        assert!(levels.iter().all(|level| [90, 111].contains(level)), "{levels:?}");
        assert!((30..70).contains(&levels.iter().filter(|&&level| level == 90).count()));

        let mut mean_square = 0.0;
        for i in 0..400 {
            let moved = with_error(&pose, &flawed, i);
            assert_eq!(moved.map(|row| row[3]), pose.map(|row| row[3]));
            let back = [moved, pose].map(|pose| DVec3::new(pose[0][2], pose[1][2], pose[2][2]));
            mean_square += back[0].angle_between(back[1]).to_degrees().powi(2) / 400.0;
        }
        // Two of the three rotations turn the optical axis.
        assert!((mean_square / (2.0 * 0.25) - 1.0).abs() < 0.2, "{mean_square}");
    }
}

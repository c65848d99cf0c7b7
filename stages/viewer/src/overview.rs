//! Initial camera, up direction and centre of rotation of the page's view.

use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, SymmetricEigen};
use scene::{Bounds, Camera, Space, common_direction};

use crate::bake::{Volume, Voxel};
use crate::space::to_world;

/// Sine of the preferred elevation above the horizon; chosen by hand.
const ELEVATION_SINE: f64 = 0.4;

/// Returns centre and extent of the voxels, in scene units; of the box if there are no voxels. In a
/// contracted space, only voxels in the ball that isn't contracted count, if there are any.
/// Contraction distorts sizes outside this ball.
pub(crate) fn centre_and_size(bounds: &Bounds, volume: &Volume) -> (DVec3, f64) {
    let resolution = volume.resolution as f64;
    let position = |v: &Voxel| DVec3::from(v.position.map(|c| (f64::from(c) + 0.5) / resolution));
    let mut positions: Vec<DVec3> = volume.voxels.iter().map(position).collect();
    let is_in_ball = |p: &DVec3| p.distance(DVec3::splat(0.5)) < 0.25;
    if bounds.space == Space::Contraction && positions.iter().any(is_in_ball) {
        positions.retain(is_in_ball);
    }
    if positions.is_empty() {
        return (bounds.middle(), bounds.longest_side());
    }
    // The median ignores floaters and distant background.
    let median = [0, 1, 2].map(|axis| quantile(positions.iter().map(|p| p[axis]).collect(), 0.5));
    let centre = to_world(bounds, DVec3::from(median));
    let distances = positions.iter().map(|&p| to_world(bounds, p).distance(centre)).collect();
    // Half of a frustum's voxels may lie in the far background. Both fractions are chosen by hand.
    let fraction = if matches!(bounds.space, Space::Ndc(_)) { 0.5 } else { 0.9 };
    (centre, (2.0 * quantile(distances, fraction)).max(f64::MIN_POSITIVE))
}

/// Depth of a drawn frustum as a fraction of the distance to the nearest camera; chosen by hand.
const FRUSTUM_SHARE: f64 = 0.4;
/// Maximum depth of a drawn frustum as a fraction of the scene's size; chosen by hand.
const MAX_FRUSTUM_SHARE: f64 = 0.06;

/// Returns the depth of the drawn frusta in scene units: so small that most don't overlap.
pub(crate) fn frustum_depth(cameras: &[&Camera], size: f64) -> f64 {
    let centres: Vec<DVec3> = cameras.iter().map(|camera| camera.centre()).collect();
    let mut spacings = Vec::with_capacity(centres.len());
    for a in &centres {
        let distances = centres.iter().map(|b| a.distance(*b)).filter(|&distance| distance > 0.0);
        spacings.extend(distances.min_by(f64::total_cmp));
    }
    let largest = MAX_FRUSTUM_SHARE * size;
    if spacings.is_empty() { largest } else { largest.min(FRUSTUM_SHARE * quantile(spacings, 0.5)) }
}

/// Returns the value below which the given fraction of values is.
fn quantile(mut values: Vec<f64>, fraction: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * fraction) as usize]
}

/// Returns the scene's up direction, to which the x axes of level cameras are perpendicular. If the
/// axes don't determine it, returns the mean of the cameras' own up directions.
pub(crate) fn up_direction(cameras: &[&Camera]) -> DVec3 {
    let axis = |i: usize| cameras.iter().map(move |c: &&Camera| c.rotation().col(i));
    let mean = axis(1).sum::<DVec3>().try_normalize().unwrap_or(DVec3::Z);
    let moments: DMat3 =
        axis(0).fold(DMat3::ZERO, |sum, x| sum + DMat3::from_cols(x * x.x, x * x.y, x * x.z));
    let eigen = SymmetricEigen::new(Matrix3::from_fn(|i, j| moments.col(j)[i]));
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let [least, second, most] = order.map(|i| eigen.eigenvalues[i]);
    // Both limits are chosen by hand.
    if second < 0.1 * most || least > 0.3 * second {
        return mean;
    }
    let up = DVec3::from([0, 1, 2].map(|i| eigen.eigenvectors[(i, order[0])]));
    if up.dot(mean) < 0.0 { -up } else { up }
}

/// Returns the index of the initial camera: one that looks from slightly above; of cameras that
/// look in one direction, the middle one.
pub(crate) fn start_camera(cameras: &[&Camera], up: DVec3) -> usize {
    let middle = cameras.iter().map(|c| c.centre()).sum::<DVec3>() / cameras.len().max(1) as f64;
    let deviations: Vec<f64> = if common_direction(cameras.iter().copied()).is_some() {
        cameras.iter().map(|camera| camera.centre().distance(middle)).collect()
    } else {
        cameras.iter().map(|camera| (-camera.forward().dot(up) - ELEVATION_SINE).abs()).collect()
    };
    (0..cameras.len()).min_by(|&a, &b| deviations[a].total_cmp(&deviations[b])).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::COEFFICIENTS;
    use scene::Intrinsics;

    /// Returns a level camera at `centre` that looks at the origin.
    fn camera(centre: DVec3, up: DVec3) -> Camera {
        let back = centre.normalize();
        let right = up.cross(back).normalize();
        let above = back.cross(right);
        let row = |i: usize| [right[i], above[i], back[i], centre[i]];
        Camera {
            name: "a".into(),
            intrinsics: Intrinsics::from_angle_x(8, 8, 0.5),
            camera_to_world: [row(0), row(1), row(2)],
        }
    }

    #[test]
    fn level_cameras_determine_the_up_direction() {
        let up = DVec3::new(0.1, -0.5, 0.8).normalize();
        let side = up.any_orthonormal_vector();
        // All cameras are on one side, so that the mean of their up directions is tilted.
        let centres = (0..12).map(|i| {
            let rotation = glam::DQuat::from_axis_angle(up, 0.25 * f64::from(i));
            rotation * side * 3.0 + up * (0.5 + 0.2 * f64::from(i))
        });
        let cameras: Vec<Camera> = centres.map(|centre| camera(centre, up)).collect();
        let cameras: Vec<&Camera> = cameras.iter().collect();
        let found = up_direction(&cameras);
        assert!(found.dot(up) > 0.9999, "{found}");
        let start = cameras[start_camera(&cameras, up)];
        assert!((-start.forward().dot(up) - ELEVATION_SINE).abs() < 0.1);
        // A single camera has its own up direction.
        assert!(up_direction(&cameras[..1]).dot(cameras[0].rotation().y_axis) > 0.9999);
    }

    /// Frusta of close cameras are small; the scene's size limits frusta of distant or single
    /// cameras.
    #[test]
    fn frusta_stay_apart() {
        let camera_at = |x: f64| camera(DVec3::new(x, 1.0, 1.0), DVec3::Z);
        let cameras = [0.0, 0.1, 0.2, 0.2, 9.0].map(camera_at);
        let cameras: Vec<&Camera> = cameras.iter().collect();
        assert!((frustum_depth(&cameras, 10.0) - 0.04).abs() < 1e-9);
        assert!((frustum_depth(&cameras, 0.1) - 0.006).abs() < 1e-9);
        assert!((frustum_depth(&cameras[..1], 10.0) - 0.6).abs() < 1e-9);
    }

    #[test]
    fn the_centre_ignores_outlying_voxels() {
        let bounds = Bounds::cube(1.0, 0.0, 9.0);
        let voxel = |position| Voxel {
            position,
            opacity: 1.0,
            colour: [0.5; 3],
            view: [0.0; COEFFICIENTS],
        };
        let mut voxels: Vec<Voxel> = (0..100).map(|i| voxel([40 + i % 5, 20, 32])).collect();
        voxels.push(voxel([0, 63, 63]));
        let (centre, size) = centre_and_size(&bounds, &Volume { resolution: 64, voxels });
        let world = |c: f64| (c + 0.5) / 32.0 - 1.0;
        assert!(
            centre.distance(DVec3::new(world(42.0), world(20.0), world(32.0))) < 1e-9,
            "{centre}"
        );
        assert!(size < 0.2, "{size}");
    }
}

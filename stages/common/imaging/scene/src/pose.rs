use glam::{DMat3, DVec3};

/// Rigid motion from camera to world: `[R | t]`, row by row. R's columns are the camera's axes (x
/// right, y up, z back) in world space, t is the camera's centre.
pub type Pose = [[f64; 4]; 3];

/// Returns the pose of a camera with given axes, as columns, and centre.
pub fn pose_of(axes: DMat3, centre: DVec3) -> Pose {
    [0, 1, 2].map(|k| [axes.x_axis[k], axes.y_axis[k], axes.z_axis[k], centre[k]])
}

/// Returns the pose of a camera that looks at a point. If it looks straight along `up`, its right
/// axis is arbitrary.
pub fn looking_at(from: DVec3, at: DVec3, up: DVec3) -> Pose {
    let back = (from - at).normalize_or(DVec3::Z);
    let right = up.cross(back).try_normalize().unwrap_or_else(|| back.any_orthonormal_vector());
    pose_of(DMat3::from_cols(right, back.cross(right), back), from)
}

/// Returns a pose moved by a vector.
pub(crate) fn moved(pose: &Pose, by: DVec3) -> Pose {
    let mut moved = *pose;
    for (axis, row) in moved.iter_mut().enumerate() {
        row[3] += by[axis];
    }
    moved
}

/// Maximum deviation of R·Rᵀ from the identity at which R is a rotation; chosen by hand. Published
/// poses are rounded to single precision; real mistakes are far off.
pub(crate) const MAX_ROTATION_ERROR: f64 = 1e-2;

/// Returns the largest deviation of R·Rᵀ from the identity.
pub(crate) fn rotation_error(rotation: DMat3) -> f64 {
    let deviation = rotation * rotation.transpose() - DMat3::IDENTITY;
    deviation.to_cols_array().into_iter().fold(0.0, |a: f64, b| a.max(b.abs()))
}

/// Returns a column of a pose: an axis or, with index 3, the centre.
pub(crate) fn column_of(pose: &Pose, index: usize) -> DVec3 {
    DVec3::new(pose[0][index], pose[1][index], pose[2][index])
}

/// Returns the rotation R of a pose, its left 3×3 part.
pub(crate) fn rotation_of(pose: &Pose) -> DMat3 {
    DMat3::from_cols(column_of(pose, 0), column_of(pose, 1), column_of(pose, 2))
}

/// Removes a uniform scale from a pose's rotation. Returns the pose with the same centre, and the
/// scale; `None` if the left 3×3 part is a rotation, or not a multiple of one. A reflection stays a
/// reflection.
pub fn without_scale(pose: &Pose) -> Option<(Pose, f64)> {
    let rotation = rotation_of(pose);
    if rotation_error(rotation) <= MAX_ROTATION_ERROR {
        return None;
    }
    let squares = rotation.to_cols_array().map(|x| x * x).iter().sum::<f64>();
    let scale = (squares / 3.0).sqrt();
    let rigid = rotation * (1.0 / scale);
    let is_rigid = rigid.is_finite() && rotation_error(rigid) <= MAX_ROTATION_ERROR;
    is_rigid.then(|| (pose_of(rigid, column_of(pose, 3)), scale))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scaled_rotation(scale: f64) -> DMat3 {
        DMat3::from_axis_angle(DVec3::new(0.3, -0.5, 0.8).normalize(), 1.1) * scale
    }

    #[test]
    fn a_uniform_scale_is_removed() {
        let centre = DVec3::new(1.0, -2.0, 4e6);
        for scale in [0.25, 1e-20, 3e20, 1.1] {
            let (rigid, found) = without_scale(&pose_of(scaled_rotation(scale), centre)).unwrap();
            assert!((found / scale - 1.0).abs() < 1e-12, "{found}");
            assert!(rotation_error(rotation_of(&rigid)) < 1e-12);
            assert_eq!([0, 1, 2].map(|i| rigid[i][3]), centre.to_array());
        }
        let (mirrored, _) = without_scale(&pose_of(scaled_rotation(-0.5), centre)).unwrap();
        assert!((rotation_of(&mirrored).determinant() + 1.0).abs() < 1e-12);
    }

    #[test]
    fn rotations_and_other_matrices_stay_unchanged() {
        let sheared = DMat3::from_cols(DVec3::X, DVec3::new(0.2, 1.0, 0.0), DVec3::Z);
        let stretched = DMat3::from_diagonal(DVec3::new(1.0, 1.0, 1.1));
        for rotation in [1.0, 1.004, f64::NAN, f64::INFINITY, 1e200, 1e-200].map(scaled_rotation) {
            assert_eq!(without_scale(&pose_of(rotation, DVec3::ZERO)), None);
        }
        for matrix in [sheared, 3.0 * stretched, DMat3::ZERO, 2.0 * sheared] {
            assert_eq!(without_scale(&pose_of(matrix, DVec3::ZERO)), None);
        }
    }
}

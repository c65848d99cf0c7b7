use glam::{DMat3, DVec3};

/// A rigid motion from camera to world: `[R | t]`, row by row. R's columns are the camera's axes (x
/// right, y up, z back) in world space, t is its centre.
pub type Pose = [[f64; 4]; 3];

/// The pose of a camera with given axes, as columns, at a centre.
pub fn pose_of(axes: DMat3, centre: DVec3) -> Pose {
    [0, 1, 2].map(|k| [axes.x_axis[k], axes.y_axis[k], axes.z_axis[k], centre[k]])
}

/// The pose of a camera that looks at a point. Where it would look straight along `up`, another
/// axis is its right.
pub fn looking_at(from: DVec3, at: DVec3, up: DVec3) -> Pose {
    let back = (from - at).normalize_or(DVec3::Z);
    let right = up.cross(back).try_normalize().unwrap_or_else(|| back.any_orthonormal_vector());
    pose_of(DMat3::from_cols(right, back.cross(right), back), from)
}

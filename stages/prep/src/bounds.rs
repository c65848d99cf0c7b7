use glam::{DMat3, DVec3};
use scene::{Bounds, Camera};

/// A box around what all cameras look at, from the cameras alone.
///
/// The centre is the point nearest to all optical axes; the box reaches as far as the widest camera sees at that distance, so
/// that a scene which fits into its views fits into the box. Cameras that look past each other (one view, a forward-facing
/// row) leave the centre open along their axes; then it is put at distance 4 of the mean camera, the Blender scenes' habit.
pub fn bounds_of(cameras: &[Camera]) -> Bounds {
    let mut normal = DMat3::ZERO;
    let mut right = DVec3::ZERO;
    for camera in cameras {
        let d = camera.forward();
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        normal += across;
        right += across * camera.centre();
    }
    let count = cameras.len().max(1) as f64;
    let crossing = normal * (1.0 / count);
    // The determinant is 0 for parallel axes and 8/27 for axes from all sides.
    let centre = if crossing.determinant() > 1e-3 {
        normal.inverse() * right
    } else {
        let mean = |f: &dyn Fn(&Camera) -> DVec3| cameras.iter().map(f).sum::<DVec3>() / count;
        mean(&|c| c.centre()) + 4.0 * mean(&|c| c.forward()).normalize_or(DVec3::NEG_Z)
    };
    let reach = |camera: &Camera| {
        let k = &camera.intrinsics;
        let slope = (0.5 * f64::from(k.width) / k.fx).max(0.5 * f64::from(k.height) / k.fy);
        (camera.centre() - centre).length() * slope
    };
    // A twentieth more: silhouettes that touch the border.
    let half = 1.05 * cameras.iter().map(reach).fold(0.0, f64::max).max(f64::MIN_POSITIVE.sqrt());
    let box_only = Bounds {
        min: (centre - DVec3::splat(half)).to_array(),
        max: (centre + DVec3::splat(half)).to_array(),
        near: 0.0,
        far: 0.0,
    };
    with_range(box_only, cameras)
}

/// The same box with near and far from its nearest and farthest point over all cameras.
pub(crate) fn with_range(bounds: Bounds, cameras: &[Camera]) -> Bounds {
    let (min, max) = (DVec3::from(bounds.min), DVec3::from(bounds.max));
    let (mut near, mut far) = (f64::INFINITY, 0.0f64);
    for camera in cameras {
        let c = camera.centre();
        near = near.min((c - c.clamp(min, max)).length());
        far = far.max((c - min).abs().max((c - max).abs()).length());
    }
    // Inside the box a sliver is left out: a surface on the lens is never meant.
    Bounds { near: near.max(1e-3 * far), far, ..bounds }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::Intrinsics;

    fn looking_at(from: DVec3, target: DVec3) -> Camera {
        let back = (from - target).normalize();
        let right = DVec3::Z.cross(back).normalize();
        let up = back.cross(right);
        let row = |k: usize| [right[k], up[k], back[k], from[k]];
        Camera {
            name: "c".into(),
            intrinsics: Intrinsics::from_angle_x(100, 100, 0.69),
            camera_to_world: [row(0), row(1), row(2)],
        }
    }

    fn circle(target: DVec3, distance: f64) -> Vec<Camera> {
        (0..12)
            .map(|i| {
                let a = f64::from(i) * std::f64::consts::FRAC_PI_6;
                looking_at(target + distance * DVec3::new(a.cos(), a.sin(), 0.4).normalize(), target)
            })
            .collect()
    }

    #[test]
    fn the_box_is_around_what_all_cameras_see_at_any_scale() {
        for scale in [1e-6, 1.0, 1e6] {
            let target = scale * DVec3::new(0.5, -0.3, 0.2);
            let bounds = bounds_of(&circle(target, 4.0 * scale));
            let centre = 0.5 * (DVec3::from(bounds.min) + DVec3::from(bounds.max));
            assert!((centre - target).length() < 1e-6 * scale, "{bounds:?}");
            let half = 0.5 * (bounds.max[0] - bounds.min[0]) / scale;
            assert!((1.4..1.7).contains(&half), "{half}");
            assert!(bounds.near / scale > 1.0 && bounds.far / scale < 7.5, "{bounds:?}");
        }
    }

    #[test]
    fn one_camera_has_a_box_too() {
        let bounds = bounds_of(&[looking_at(DVec3::new(4.0, 0.0, 0.5), DVec3::ZERO)]);
        assert!(bounds.near > 0.0 && bounds.far > bounds.near && bounds.far.is_finite());
    }
}

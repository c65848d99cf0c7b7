use glam::{DMat3, DVec3};
use scene::{Bounds, Camera};

/// A box around what all cameras look at, from the cameras alone where they say enough.
///
/// The centre is the point nearest to all optical axes; the box reaches as far as the widest camera sees at that distance, so
/// that a scene which fits into its views fits into the box. Cameras that look past each other (one view, a forward-facing
/// row) leave the centre open along their axes. Then the box is around all that they see between the nearest and the farthest depth
/// that is known of each; where nothing is known, it is put at distance 4 of the mean camera, the Blender scenes' habit.
pub fn bounds_of(cameras: &[Camera], depths: &[Option<[f64; 2]>]) -> Bounds {
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
    } else if let Some(bounds) = around_frusta(cameras, depths) {
        return bounds;
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

/// A box around what each camera sees between its depths, a tenth more to either side. `None` where a camera has none.
fn around_frusta(cameras: &[Camera], depths: &[Option<[f64; 2]>]) -> Option<Bounds> {
    let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (mut near, mut far) = (f64::INFINITY, 0.0f64);
    for (camera, depths) in cameras.iter().zip(depths) {
        let [nearest, farthest] = (*depths)?;
        let (width, height) = (f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
        near = near.min(0.9 * nearest);
        for (x, y) in [(0.0, 0.0), (width, 0.0), (0.0, height), (width, height)] {
            let ray = camera.ray(x, y);
            for depth in [0.9 * nearest, 1.1 * farthest] {
                let distance = depth / camera.depth_per_distance(&ray);
                (min, max) = (min.min(ray.at(distance)), max.max(ray.at(distance)));
                far = far.max(distance);
            }
        }
    }
    let bounds = Bounds { min: min.to_array(), max: max.to_array(), near, far };
    bounds.is_valid().then_some(bounds)
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
            let bounds = bounds_of(&circle(target, 4.0 * scale), &[]);
            let centre = 0.5 * (DVec3::from(bounds.min) + DVec3::from(bounds.max));
            assert!((centre - target).length() < 1e-6 * scale, "{bounds:?}");
            let half = 0.5 * (bounds.max[0] - bounds.min[0]) / scale;
            assert!((1.4..1.7).contains(&half), "{half}");
            assert!(bounds.near / scale > 1.0 && bounds.far / scale < 7.5, "{bounds:?}");
        }
    }

    #[test]
    fn one_camera_has_a_box_too() {
        let bounds = bounds_of(&[looking_at(DVec3::new(4.0, 0.0, 0.5), DVec3::ZERO)], &[None]);
        assert!(bounds.near > 0.0 && bounds.far > bounds.near && bounds.far.is_finite());
    }

    /// Whatever a camera of a row sees between its depths lies in the box, and between near and far.
    #[test]
    fn a_row_of_cameras_has_what_it_sees() {
        let row: Vec<Camera> = (0..5)
            .map(|i| {
                let from = DVec3::new(0.2 * f64::from(i), 0.0, 0.0);
                looking_at(from, from + DVec3::Y)
            })
            .collect();
        let depths = vec![Some([2.0, 10.0]); 5];
        let bounds = bounds_of(&row, &depths);
        for camera in &row {
            for (x, y) in [(0.0, 0.0), (100.0, 50.0), (50.0, 100.0), (50.0, 50.0)] {
                let ray = camera.ray(x, y);
                for depth in [2.0, 5.0, 10.0] {
                    let distance = depth / camera.depth_per_distance(&ray);
                    let p = ray.at(distance).to_array();
                    assert!((0..3).all(|i| (bounds.min[i]..=bounds.max[i]).contains(&p[i])), "{p:?} {bounds:?}");
                    assert!((bounds.near..=bounds.far).contains(&distance));
                }
            }
        }
        assert!(bounds.max[1] < 11.1 && bounds.min[1] > 1.5, "{bounds:?}");
        let unknown = bounds_of(&row, &[None; 5]);
        assert!(unknown.is_valid() && unknown != bounds);
    }
}

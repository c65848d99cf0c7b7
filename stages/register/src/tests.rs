use glam::DVec3;
use radiance::{Pixel, Ray, RenderError};
use scene::Intrinsics;

use super::*;

/// Painted wall. Images smaller than `full_size` render the wall displaced by `shift`. Unless
/// `shift` is 0, larger images have no depth and hence move no camera.
struct Wall {
    /// Minimum number of pixels of a full-size image.
    full_size: usize,
    shift: f64,
}

fn pixel_along(ray: &Ray, is_full_size: bool, shift: f64) -> Pixel {
    let (origin, direction) = (DVec3::from(ray.origin), DVec3::from(ray.direction));
    let distance = -origin.z / direction.z;
    let point = origin + distance * direction + DVec3::X * if is_full_size { 0.0 } else { shift };
    let colour = [0.0, 1.0, 2.0].map(|c| {
        (0.5 + 0.2 * ((2.0 + c) * point.x + c).sin() + 0.2 * (3.0 * point.y - c).cos()) as f32
    });
    let depth = if is_full_size && shift != 0.0 { f32::INFINITY } else { distance as f32 };
    Pixel { colour, premultiplied: colour, opacity: 1.0, depth, median_depth: depth }
}

impl RayField for Wall {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        let is_full_size = rays.len() >= self.full_size;
        Ok(rays.iter().map(|ray| pixel_along(ray, is_full_size, self.shift)).collect())
    }
}

fn camera(x: f64) -> Camera {
    let intrinsics = Intrinsics::from_angle_x(48, 48, 0.7);
    Camera {
        name: "r_0".into(),
        intrinsics,
        camera_to_world: [[1., 0., 0., x], [0., 1., 0., 0.], [0., 0., 1., 4.]],
    }
}

fn photograph() -> Image {
    let k = camera(0.0).intrinsics;
    let rays = (0..k.width * k.height).map(|i| {
        let ray = camera(0.0).ray(f64::from(i % k.width) + 0.5, f64::from(i / k.width) + 0.5);
        Ray::new(&ray, [1.0; 3])
    });
    let pixels = Wall { full_size: 0, shift: 0.0 }.render(&rays.collect::<Vec<_>>()).unwrap();
    Image::new(48, 48, 3, pixels.iter().flat_map(|pixel| pixel.colour).collect())
}

fn registered(field: &Wall, x: f64) -> Registered {
    Registered::from_image(field, &camera(x), &photograph(), 1.0).unwrap()
}

#[test]
fn a_camera_is_registered_and_a_large_motion_causes_a_warning() {
    let near = registered(&Wall { full_size: 0, shift: 0.0 }, 0.02);
    assert!(
        near.to.centre().x.abs() < 2e-3 && near.errors.unwrap()[1] < 1e-6,
        "{:?}",
        near.to.centre()
    );
    assert!((near.depth.unwrap() - 4.0).abs() < 0.1);
    let far = registered(&Wall { full_size: 0, shift: 0.0 }, 0.4);
    assert!(far.to.centre().x.abs() < 2e-3, "{:?}", far.to.centre());
    // A photograph's 48 pixels span 2.9 units: 0.02 units are a third of a pixel, 0.4 units 6.6.
    let (text, warning) = summary(&[near]);
    assert!(
        text.starts_with("1 of 1 camera registered: ") && warning.is_none(),
        "{text} {warning:?}"
    );
    let (text, warning) = summary(&[
        far,
        Registered::unchanged(&camera(0.0)),
        registered(&Wall { full_size: 0, shift: 0.0 }, 0.4),
    ]);
    assert!(text.starts_with("2 of 3 cameras registered: "), "{text}");
    // A photograph without a gradient, or masked entirely, registers nothing.
    for value in [0.5, f32::NAN] {
        let image = Image::new(48, 48, 3, vec![value; 3 * 48 * 48]);
        let wall = Wall { full_size: 0, shift: 0.0 };
        let uninformed = Registered::from_image(&wall, &camera(0.4), &image, 1.0).unwrap();
        assert_eq!((&uninformed.to, uninformed.errors), (&camera(0.4), None));
    }
    assert!(
        warning.as_ref().is_some_and(
            |w| w.contains("check that the field and the photographs are of the same scene")
        ),
        "{warning:?}"
    );
}

/// Smaller images mislead; at full size the given pose fits best.
#[test]
fn the_given_pose_is_kept_unless_another_is_better() {
    let misled = registered(&Wall { full_size: 2000, shift: 0.5 }, 0.0);
    assert_eq!(misled.to, camera(0.0));
    let [before, after] = misled.errors.unwrap();
    assert!(before == after && before < 1e-9, "{before} {after}");
}

use glam::DVec3;
use radiance::{Pixel, Ray, RenderError};
use scene::Intrinsics;

use super::*;

/// Painted wall. Images of fewer pixels than `whole` render the wall shifted; larger ones have no
/// depth, so that no camera moves by them.
struct Wall {
    whole: usize,
    shift: f64,
}

fn seen_along(ray: &Ray, is_whole: bool, shift: f64) -> Pixel {
    let (origin, direction) = (DVec3::from(ray.origin), DVec3::from(ray.direction));
    let distance = -origin.z / direction.z;
    let point = origin + distance * direction + DVec3::X * if is_whole { 0.0 } else { shift };
    let colour = [0.0, 1.0, 2.0].map(|c| {
        (0.5 + 0.2 * ((2.0 + c) * point.x + c).sin() + 0.2 * (3.0 * point.y - c).cos()) as f32
    });
    let depth = if is_whole && shift != 0.0 { f32::INFINITY } else { distance as f32 };
    Pixel { colour, premultiplied: colour, opacity: 1.0, depth, median_depth: depth }
}

impl RayField for Wall {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        let is_whole = rays.len() >= self.whole;
        Ok(rays.iter().map(|ray| seen_along(ray, is_whole, self.shift)).collect())
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
    let pixels = Wall { whole: 0, shift: 0.0 }.render(&rays.collect::<Vec<_>>()).unwrap();
    Image::new(48, 48, 3, pixels.iter().flat_map(|pixel| pixel.colour).collect())
}

fn registered(field: &Wall, from: f64) -> Registered {
    Registered::from_image(field, &camera(from), &photograph(), 1.0).unwrap()
}

#[test]
fn a_camera_is_registered_and_a_far_one_is_warned_of() {
    let near = registered(&Wall { whole: 0, shift: 0.0 }, 0.02);
    assert!(
        near.to.centre().x.abs() < 2e-3 && near.errors.unwrap()[1] < 1e-6,
        "{:?}",
        near.to.centre()
    );
    assert!((near.depth.unwrap() - 4.0).abs() < 0.1);
    let far = registered(&Wall { whole: 0, shift: 0.0 }, 0.4);
    assert!(far.to.centre().x.abs() < 2e-3, "{:?}", far.to.centre());
    // A photograph is 48 pixels across 2.9 units: 0.02 of those are a third of a pixel, 0.4 are
    // 6.6.
    let (text, warning) = summary(&[near]);
    assert!(
        text.starts_with("1 of 1 camera registered: ") && warning.is_none(),
        "{text} {warning:?}"
    );
    let (text, warning) = summary(&[
        far,
        Registered::unchanged(&camera(0.0)),
        registered(&Wall { whole: 0, shift: 0.0 }, 0.4),
    ]);
    assert!(text.starts_with("2 of 3 cameras registered: "), "{text}");
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
    let misled = registered(&Wall { whole: 2000, shift: 0.5 }, 0.0);
    assert_eq!(misled.to, camera(0.0));
    let [before, after] = misled.errors.unwrap();
    assert!(before == after && before < 1e-9, "{before} {after}");
}

//! Fuzzes the lens parameters of a camera. No value may cause a panic or a hang. An accepted
//! fisheye camera must have a forward ray for each image position, and a point on that ray must
//! project to the same position.
#![no_main]

use fuzz::lens_camera;
use libfuzzer_sys::fuzz_target;
use scene::Camera;

fuzz_target!(|data: &[u8]| {
    let Some((which, numbers)) = data.split_first() else { return };
    let camera = lens_camera(*which, numbers);
    let k = camera.intrinsics;
    k.pinhole();
    k.lens_mask();
    let is_accepted = camera.check().is_ok();
    for i in 0..=32 {
        let at = [
            f64::from(i % 9) / 8.0 * f64::from(k.width),
            f64::from(i / 9) / 3.0 * f64::from(k.height),
        ];
        let seen = camera.project(camera.ray(at[0], at[1]).at(2.0));
        // Numbers of any size can cancel all digits of f64, so only small ones are checked.
        let is_tame = which & 2 == 0;
        if is_accepted && is_tame && k.distortion.is_fisheye() {
            check_ray(&camera, at, seen);
        }
    }
});

fn check_ray(camera: &Camera, at: [f64; 2], seen: Option<(f64, f64, f64)>) {
    let ray = camera.ray(at[0], at[1]);
    assert!((ray.direction.length() - 1.0).abs() < 1e-12, "{ray:?}");
    let cosine = camera.depth_per_distance(&ray);
    assert!(cosine > 0.0174, "{cosine}");
    if camera.intrinsics.is_clamped(at) {
        return;
    }
    let (x, y, _) = seen.expect("a ray that isn't cut is seen");
    assert!((x - at[0]).hypot(y - at[1]) < 1e-3, "{at:?} is seen at {x}, {y}");
}

use radiance::Ray;
use scene::Camera;

/// The ray through a position in the image, exact and as fields take it.
pub(crate) fn cast(camera: &Camera, [x, y]: [f64; 2], background: f32) -> (scene::CameraRay, Ray) {
    let ray = camera.ray(x, y);
    (ray, Ray::new(&ray, [background; 3]))
}

//! Parts of a frame that the scene's cameras observe.

use glam::DVec3;
use scene::{Camera, Pose};

/// Number of positions along each side of a frame that are tested; chosen by hand.
const SIDE_SAMPLES: u32 = 9;
/// Number of depths that are tested, from near to far with even steps of disparity; chosen by hand.
const DEPTH_SAMPLES: u32 = 6;
/// Tolerance at an image's border relative to the image's side: half a pixel of 200.
const BORDER_TOLERANCE: f64 = 0.0025;

/// Cameras whose images cover the scene.
pub(crate) struct Coverage<'a> {
    cameras: &'a [Camera],
    /// Camera with the image size and lens of all tested frames.
    template: &'a Camera,
    depths: Vec<f64>,
}

impl<'a> Coverage<'a> {
    /// Creates the coverage of frames by cameras, for surfaces between two depths.
    pub(crate) fn new(cameras: &'a [Camera], template: &'a Camera, near: f64, far: f64) -> Self {
        let depth = |i: u32| {
            let fraction = f64::from(i) / f64::from(DEPTH_SAMPLES - 1);
            1.0 / ((1.0 - fraction) / near + fraction / far)
        };
        Self { cameras, template, depths: (0..DEPTH_SAMPLES).map(depth).collect() }
    }

    /// Returns the number of points of a frame that are tested.
    pub(crate) fn point_count(&self) -> usize {
        (SIDE_SAMPLES * SIDE_SAMPLES) as usize * self.depths.len()
    }

    /// Returns the number of tested points of a frame that no camera observes.
    pub(crate) fn count_unseen(&self, pose: Pose) -> usize {
        let frame = Camera { camera_to_world: pose, ..self.template.clone() };
        let rays = frame.rays();
        let (width, height) =
            (f64::from(frame.intrinsics.width), f64::from(frame.intrinsics.height));
        let fraction = |i: u32| f64::from(i) / f64::from(SIDE_SAMPLES - 1);
        let mut last = 0;
        let mut count = 0;
        for (column, row) in (0..SIDE_SAMPLES).flat_map(|j| (0..SIDE_SAMPLES).map(move |i| (i, j)))
        {
            let ray = rays.ray(fraction(column) * width, fraction(row) * height);
            let cosine = frame.depth_per_distance(&ray);
            for depth in &self.depths {
                let point = ray.at(depth / cosine);
                // Neighbouring points are mostly observed by the same camera.
                let order = (last..self.cameras.len()).chain(0..last);
                match order.into_iter().find(|&i| observes(&self.cameras[i], point)) {
                    Some(camera) => last = camera,
                    None => count += 1,
                }
            }
        }
        count
    }
}

/// Returns whether a point is inside a camera's image.
fn observes(camera: &Camera, point: DVec3) -> bool {
    let inside = |x: f64, side: u32| {
        (-BORDER_TOLERANCE..=1.0 + BORDER_TOLERANCE).contains(&(x / f64::from(side)))
    };
    let k = &camera.intrinsics;
    camera.project(point).is_some_and(|(x, y, _)| inside(x, k.width) && inside(y, k.height))
}

#[cfg(test)]
mod tests {
    use scene::{Intrinsics, looking_at};

    use super::*;

    fn camera(x: f64) -> Camera {
        let position = DVec3::new(x, 0.0, 0.0);
        let pose = looking_at(position, position + DVec3::Y, DVec3::Z);
        let intrinsics = Intrinsics::from_angle_x(40, 30, 0.7);
        Camera { name: x.to_string(), intrinsics, camera_to_world: pose }
    }

    #[test]
    fn frames_between_cameras_are_covered() {
        let cameras = [camera(-0.5), camera(0.5)];
        let coverage = Coverage::new(&cameras, &cameras[0], 2.0, 10.0);
        let unseen = |x: f64| coverage.count_unseen(camera(x).camera_to_world);
        assert_eq!([-0.5, 0.0, 0.2, 0.5].map(unseen), [0; 4]);
        // Farther to the side, first a column is unobserved, then all points.
        assert!((9..100).contains(&unseen(0.6)), "{}", unseen(0.6));
        assert_eq!(unseen(100.0), coverage.point_count());
        let turned = looking_at(DVec3::ZERO, DVec3::new(0.3, 1.0, 0.0), DVec3::Z);
        assert!(coverage.count_unseen(turned) > 100);
    }
}

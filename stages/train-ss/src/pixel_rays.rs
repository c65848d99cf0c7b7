use radiance::Ray;
use scene::{Camera, Intrinsics};

/// Casts rays through places of a view's image; pixel (i, j) covers [i, i+1] × [j, j+1].
pub(crate) struct PixelRays {
    intrinsics: Intrinsics,
    origin: [f32; 3],
    /// Of a pinhole: direction of image position (0, 0), and what one pixel to the right or down
    /// adds; not of unit length.
    corner: [f64; 3],
    right: [f64; 3],
    down: [f64; 3],
}

impl PixelRays {
    /// From where a camera is.
    pub(crate) fn of(camera: &Camera) -> Self {
        let (k, r) = (camera.intrinsics, camera.rotation());
        Self {
            intrinsics: k,
            origin: camera.centre().as_vec3().to_array(),
            corner: (r * glam::DVec3::new(-k.cx / k.fx, k.cy / k.fy, -1.0)).to_array(),
            right: (r.x_axis / k.fx).to_array(),
            down: (-r.y_axis / k.fy).to_array(),
        }
    }

    /// The ray through a place, in pixels.
    pub(crate) fn ray(&self, place: [f64; 2], background: [f32; 3]) -> Ray {
        let [u, v] = self.intrinsics.undistort(place);
        let d: [f64; 3] =
            std::array::from_fn(|i| self.corner[i] + u * self.right[i] + v * self.down[i]);
        let length = d.iter().map(|x| x * x).sum::<f64>().sqrt();
        Ray { origin: self.origin, direction: d.map(|x| (x / length) as f32), background }
    }
}

//! Visibility of voxels from training cameras. Invisible voxels are dropped; the colours of visible
//! voxels are fitted to the cameras' viewing directions.

use std::sync::atomic::{AtomicU64, Ordering};

use radiance::{Ray, clip};
use rayon::prelude::*;
use scene::{Bounds, Camera};
use stage::Progress;

use crate::bricks::{BRICK_SIDE, Bricks, grid_index};
use crate::space::{leap_along, step_along};

/// Maximum number of observing cameras: one bit each (docs/design/042).
pub(crate) const MAX_CAMERAS: usize = 64;
/// Minimum share of a ray's light that a visible voxel stops (docs/design/042).
const MIN_STOPPED_LIGHT: f32 = 0.01;

/// Chooses observing cameras, spread evenly over the list, and resizes them to `resolution` pixels
/// on the longer side.
pub(crate) fn observers(cameras: &[&Camera], resolution: usize) -> Vec<Camera> {
    let count = cameras.len().min(MAX_CAMERAS);
    (0..count)
        .map(|i| {
            let camera = cameras[i * cameras.len() / count];
            let k = camera.intrinsics;
            let scale = resolution as f64 / f64::from(k.width.max(k.height));
            let [width, height] = [k.width, k.height]
                .map(|pixels| (f64::from(pixels) * scale).round().max(1.0) as u32);
            camera.resized(width, height)
        })
        .collect()
}

/// Finds the cameras from which each voxel is visible: bit i is set for camera i. `opacity` is the
/// opacity of each voxel for a step of one voxel's length.
pub(crate) fn visible_from(
    bricks: &Bricks,
    opacity: &[f32],
    (cameras, bounds): (&[Camera], &Bounds),
    progress: &Progress,
) -> Vec<u64> {
    let seen: Vec<AtomicU64> = opacity.iter().map(|_| AtomicU64::new(0)).collect();
    let distances = bricks.distances();
    for (bit, camera) in cameras.iter().enumerate() {
        let size = camera.intrinsics;
        let rays = camera.rays();
        let march = March { bricks, distances: &distances, opacity };
        (0..size.height).into_par_iter().for_each(|row| {
            for column in 0..size.width {
                let ray = rays.ray(f64::from(column) + 0.5, f64::from(row) + 0.5);
                march.trace(bounds, &Ray::new(&ray, [0.0; 3]), |voxel| {
                    // Bits are only added, so the order of threads doesn't matter.
                    seen[voxel].fetch_or(1 << bit, Ordering::Relaxed);
                });
            }
        });
        progress.add(1);
    }
    seen.into_iter().map(AtomicU64::into_inner).collect()
}

/// Volume that rays march through.
struct March<'a> {
    bricks: &'a Bricks,
    distances: &'a [u8],
    opacity: &'a [f32],
}

impl March<'_> {
    /// Calls `visit` with the visible voxels along a ray: those that stop at least
    /// [`MIN_STOPPED_LIGHT`] of the ray's light.
    fn trace(&self, bounds: &Bounds, ray: &Ray, mut visit: impl FnMut(usize)) {
        let ray = clip(bounds, ray);
        let voxel = 1.0 / self.bricks.resolution as f32;
        let per_brick = BRICK_SIDE as f32 * voxel;
        let mut t = ray.enter + 0.5 * voxel;
        let mut transmittance = 1.0f32;
        while t < ray.leave && transmittance > MIN_STOPPED_LIGHT {
            let position = ray.position(t).map(|x| x * self.bricks.resolution as f32 - 0.5);
            let distance = self.distance(position);
            let step = step_along(&ray, t, voxel);
            if distance > 1 {
                t += leap_along(&ray, f32::from(distance - 1) * per_brick).max(step);
                continue;
            }
            let corners = self.corners(position);
            let alpha: f32 = corners.iter().map(|(_, alpha)| alpha).sum();
            let stopped = 1.0 - (1.0 - alpha.min(1.0)).powf(step / voxel);
            if transmittance * stopped >= MIN_STOPPED_LIGHT {
                for (voxel, _) in corners.into_iter().filter(|(_, alpha)| *alpha > 0.0) {
                    visit(voxel);
                }
            }
            transmittance *= 1.0 - stopped;
            t += step;
        }
    }

    /// Returns the distance in bricks from a position in voxels to the nearest brick.
    fn distance(&self, position: [f32; 3]) -> u8 {
        let side = self.bricks.bricks_per_side();
        let brick = position.map(|c| (c.max(0.0) as usize / BRICK_SIDE).min(side - 1));
        self.distances[grid_index(brick, side)]
    }

    /// Returns the voxels around a position, each with its share of the interpolated opacity.
    fn corners(&self, position: [f32; 3]) -> [(usize, f32); 8] {
        let last = self.bricks.resolution - 1;
        let low = position.map(|c| c.max(0.0).min(last as f32));
        std::array::from_fn(|corner| {
            let mut voxel = [0; 3];
            let mut weight = 1.0;
            for axis in 0..3 {
                let floor = low[axis].floor();
                let fraction = low[axis] - floor;
                let upper = corner >> axis & 1;
                voxel[axis] = (floor as usize + upper).min(last);
                weight *= if upper == 1 { fraction } else { 1.0 - fraction };
            }
            match self.bricks.voxel_index(voxel) {
                Some(index) => (index, weight * self.opacity[index]),
                None => (0, 0.0),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::{Intrinsics, Space};

    fn camera_at(z: f64) -> Camera {
        Camera {
            name: "a".into(),
            intrinsics: Intrinsics::from_angle_x(32, 32, 0.5),
            camera_to_world: [[z.signum(), 0., 0., 0.], [0., 1., 0., 0.], [0., 0., z.signum(), z]],
        }
    }

    /// A wall hides a second wall from one camera; a camera on the other side sees the second wall.
    #[test]
    fn walls_hide_each_other() {
        let bricks = Bricks::new(32, |_| true);
        let mut opacity = vec![0.0; 32 * 32 * 32];
        for voxel in 0..opacity.len() {
            let [.., z] = bricks.voxel_position(voxel);
            // Two voxels thick: samples between the middles of two voxels still stop all light.
            opacity[voxel] = if [9, 10, 20, 21].contains(&z) { 1.0 } else { 0.0 };
        }
        // Both walls are in the ball that a contraction leaves unchanged.
        for space in [Space::Box, Space::Contraction] {
            let bounds = Bounds { space, ..Bounds::cube(1.0, 0.0, 9.0) };
            let cameras = [camera_at(4.0), camera_at(-4.0)];
            let find = || visible_from(&bricks, &opacity, (&cameras, &bounds), &Progress::silent());
            let visible = find();
            let mask_at = |z: usize| visible[bricks.voxel_index([16, 16, z]).unwrap()];
            assert_eq!([mask_at(21), mask_at(9), mask_at(15)], [0b01, 0b10, 0], "{space:?}");
            let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
            assert!(one_thread.install(find) == visible);
        }
    }

    fn camera(i: usize) -> Camera {
        Camera {
            name: i.to_string(),
            intrinsics: Intrinsics::from_angle_x(100, 50, 0.5),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 4.]],
        }
    }

    #[test]
    fn observers_are_spread_over_the_list() {
        let all: Vec<Camera> = (0..128).map(camera).collect();
        let chosen = observers(&all.iter().collect::<Vec<_>>(), 256);
        assert_eq!((chosen.len(), chosen[1].name.as_str()), (64, "2"));
        assert_eq!((chosen[0].intrinsics.width, chosen[0].intrinsics.height), (256, 128));
    }
}

//! Which voxels training cameras see: only these are kept, and directions from which they are seen
//! are those for which colours must be right.

use std::sync::atomic::{AtomicU64, Ordering};

use radiance::{Ray, clip};
use rayon::prelude::*;
use scene::{Bounds, Camera};
use stage::Progress;

use crate::bricks::{Bricks, SIDE};

/// Cameras that look, at most: a bit each.
pub(crate) const MOST_CAMERAS: usize = 64;
/// Share of a ray's light that a voxel must stop to be seen.
const LEAST_LIGHT: f32 = 0.01;

/// Some of the cameras, spread evenly over the list, with as many pixels as a voxel needs.
pub(crate) fn looking(cameras: &[&Camera], resolution: usize) -> Vec<Camera> {
    let count = cameras.len().min(MOST_CAMERAS);
    (0..count)
        .map(|i| {
            let camera = cameras[i * cameras.len() / count];
            let k = camera.intrinsics;
            let scale = resolution as f64 / f64::from(k.width.max(k.height));
            let size = |pixels: u32| (f64::from(pixels) * scale).round().max(1.0) as u32;
            camera.resized(size(k.width), size(k.height))
        })
        .collect()
}

/// Which of the cameras see each voxel: bit i is camera i's. `opacity` is that of a step of one
/// voxel, by the number of the voxel.
pub(crate) fn seen_by(
    bricks: &Bricks,
    opacity: &[f32],
    (cameras, bounds): (&[Camera], &Bounds),
    progress: &Progress,
) -> Vec<u64> {
    let seen: Vec<AtomicU64> = opacity.iter().map(|_| AtomicU64::new(0)).collect();
    let distances = bricks.distances();
    for (bit, camera) in cameras.iter().enumerate() {
        let (k, rays) = (camera.intrinsics, camera.rays());
        (0..k.height).into_par_iter().for_each(|row| {
            for column in 0..k.width {
                let ray = rays.ray(f64::from(column) + 0.5, f64::from(row) + 0.5);
                let ray = Ray::new(&ray, [0.0; 3]);
                let march = March { bricks, distances: &distances, opacity };
                march.look(bounds, &ray, |voxel| {
                    // Bits are only ever added, so their order doesn't matter.
                    seen[voxel].fetch_or(1 << bit, Ordering::Relaxed);
                });
            }
        });
        progress.add(1);
    }
    seen.into_iter().map(AtomicU64::into_inner).collect()
}

/// A volume that rays march through.
struct March<'a> {
    bricks: &'a Bricks,
    distances: &'a [u8],
    opacity: &'a [f32],
}

impl March<'_> {
    /// Calls `sees` with every voxel that stops light of a ray.
    fn look(&self, bounds: &Bounds, ray: &Ray, mut sees: impl FnMut(usize)) {
        let ray = clip(bounds, ray);
        let step = 1.0 / self.bricks.resolution as f32;
        let per_brick = SIDE as f32 * step;
        let (mut t, mut through) = (ray.enter + 0.5 * step, 1.0f32);
        while t < ray.leave && through > LEAST_LIGHT {
            let place = ray.position(t).map(|x| x * self.bricks.resolution as f32 - 0.5);
            let far = self.distance(place);
            if far > 1 {
                t += (f32::from(far - 1) * per_brick).max(step);
                continue;
            }
            let corners = self.corners(place);
            let stopped: f32 = corners.iter().map(|(_, alpha)| alpha).sum();
            if through * stopped >= LEAST_LIGHT {
                corners.iter().filter(|(_, alpha)| *alpha > 0.0).for_each(|(v, _)| sees(*v));
            }
            through *= 1.0 - stopped;
            t += step;
        }
    }

    /// Bricks to the nearest one from a place in voxels.
    fn distance(&self, place: [f32; 3]) -> u8 {
        let side = self.bricks.side();
        let [x, y, z] = place.map(|c| (c.max(0.0) as usize / SIDE).min(side - 1));
        self.distances[x + side * (y + side * z)]
    }

    /// The voxels around a place, each with its part of the opacity there.
    fn corners(&self, place: [f32; 3]) -> [(usize, f32); 8] {
        let last = self.bricks.resolution - 1;
        let low = place.map(|c| c.max(0.0).min(last as f32));
        std::array::from_fn(|corner| {
            let (mut at, mut weight) = ([0; 3], 1.0);
            for axis in 0..3 {
                let whole = low[axis].floor();
                let (fraction, upper) = (low[axis] - whole, corner >> axis & 1);
                at[axis] = (whole as usize + upper).min(last);
                weight *= if upper == 1 { fraction } else { 1.0 - fraction };
            }
            self.bricks.voxel(at).map_or((0, 0.0), |voxel| (voxel, weight * self.opacity[voxel]))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::Intrinsics;

    fn camera_at(z: f64) -> Camera {
        Camera {
            name: "a".into(),
            intrinsics: Intrinsics::from_angle_x(32, 32, 0.5),
            camera_to_world: [[z.signum(), 0., 0., 0.], [0., 1., 0., 0.], [0., 0., z.signum(), z]],
        }
    }

    /// A wall hides the one behind it; what looks from the other side sees that one.
    #[test]
    fn walls_hide_each_other() {
        let bricks = Bricks::new(32, |_| true);
        let mut opacity = vec![0.0; 32 * 32 * 32];
        for voxel in 0..opacity.len() {
            let [.., z] = bricks.place_of(voxel);
            opacity[voxel] = if z == 10 || z == 20 { 1.0 } else { 0.0 };
        }
        let bounds =
            Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.0, far: 9.0, ..Bounds::default() };
        let cameras = [camera_at(4.0), camera_at(-4.0)];
        let look = || seen_by(&bricks, &opacity, (&cameras, &bounds), &Progress::silent());
        let seen = look();
        let at = |z: usize| seen[bricks.voxel([16, 16, z]).unwrap()];
        assert_eq!([at(20), at(10), at(15)], [0b01, 0b10, 0]);
        let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert!(alone.install(look) == seen);
    }

    fn camera(i: usize) -> Camera {
        Camera {
            name: i.to_string(),
            intrinsics: Intrinsics::from_angle_x(100, 50, 0.5),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 4.]],
        }
    }

    #[test]
    fn cameras_are_spread_over_the_list() {
        let all: Vec<Camera> = (0..128).map(camera).collect();
        let chosen = looking(&all.iter().collect::<Vec<_>>(), 256);
        assert_eq!((chosen.len(), chosen[1].name.as_str()), (64, "2"));
        assert_eq!((chosen[0].intrinsics.width, chosen[0].intrinsics.height), (256, 128));
    }
}

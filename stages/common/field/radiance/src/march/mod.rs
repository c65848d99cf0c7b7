//! Ray marching: samples at equal steps in occupied cells, leaps over empty cubes.

mod curved;
mod lanes;
mod marched;
mod straight;
#[cfg(test)]
mod tests;

use crate::ray::RayMap;
use numerics::kernel;

use curved::Curved;
pub(crate) use marched::{DONE, March, MarchedSamples};
use straight::Straight;

kernel! {
    /// Finds at most `max_samples` more samples of each of the `active` rays, all of one scene.
    /// Step k of a ray is at t = enter + (k + offset)·step and has a sample if its cell is
    /// occupied. With double [`Strides`](crate::spec::Strides) only even-numbered steps have a
    /// sample, which covers two steps and lies at their middle. `next[r]` is the next step k of ray
    /// r: 0 at first, [`DONE`] if the ray has no further samples.
    pub(crate) fn march<L>(march: &March<'_>, max_samples: usize, active: &[u32], next: &mut [u32],
        samples: &mut MarchedSamples) {
        // A scene has rays of one kind, but a ray that misses the cube has a straight one's map.
        if active.iter().any(|&r| matches!(march.rays[r as usize].map, RayMap::Contracted { .. })) {
            lanes::march::<Curved>(march, max_samples, active, next, samples);
        } else {
            lanes::march::<Straight>(march, max_samples, active, next, samples);
        }
        samples.starts.push(samples.t.len());
    }
}

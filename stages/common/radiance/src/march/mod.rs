//! Where rays take samples: they march by equal steps, and leap over what is empty.

mod bent;
mod marched;
mod side_by_side;
mod steps;
mod straight;
#[cfg(test)]
mod tests;

use crate::ray::RayMap;
use crate::simd::kernel;

use bent::Bent;
pub(crate) use marched::{DONE, March, Marched};
use straight::Straight;

kernel! {
    /// Marches on: at most `most` more samples of each of the `active` rays, all of one scene. Step
    /// k of a ray lies at t = enter + (k + offset)·step. An occupied cell gives a sample there;
    /// where [`Strides`](crate::strides::Strides) are double, it gives a sample of two steps where
    /// k is even, in the middle of both. `next` is each ray's k, from 0 to [`DONE`].
    pub(crate) fn march<L>(march: &March<'_>, most: usize, active: &[u32], next: &mut [u32],
        samples: &mut Marched) {
        let is_bent = |r: &u32| matches!(march.rays[*r as usize].map, RayMap::Contracted { .. });
        // Of a scene with bent rays, those that meet nothing have a straight one's map.
        if active.iter().any(is_bent) {
            side_by_side::march::<Bent>(march, most, active, next, samples);
        } else {
            side_by_side::march::<Straight>(march, most, active, next, samples);
        }
        samples.starts.push(samples.t.len());
    }
}

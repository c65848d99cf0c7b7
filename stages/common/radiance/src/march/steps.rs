//! Numbers of steps and cells.

use crate::math::floor;
use crate::spec::OCCUPANCY_CELLS as GRID;

/// Steps of a ray are counted to here: many times as many as a ray has.
const MOST_STEPS: f32 = 4_194_304.0;

/// The first step at a number of steps or behind it; of NaN the first of all.
#[inline(always)]
pub(super) fn first_step(steps: f32) -> u32 {
    let steps = steps.max(0.0).min(MOST_STEPS);
    let (below, step) = floor(steps);
    step + u32::from(steps > below)
}

/// The cell along an axis that a coordinate of the unit cube lies in.
#[inline(always)]
pub(super) fn cell(coordinate: f32) -> u32 {
    floor((coordinate * GRID as f32).max(0.0).min(GRID as f32 - 1.0)).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::occupancy::cell_of;

    #[test]
    fn steps_are_counted_exactly() {
        for (number, step) in [
            (f32::NAN, 0),
            (f32::NEG_INFINITY, 0),
            (-0.5, 0),
            (0.0, 0),
            (1e-9, 1),
            (6.5, 7),
            (7.0, 7),
            (4_194_303.5, 4_194_304),
            (1e9, 4_194_304),
            (f32::INFINITY, 4_194_304),
        ] {
            assert_eq!(first_step(number), step, "{number}");
        }
        for place in (0..40_000).map(|i| [i as f32 * 3e-5 - 0.1, 0.5, 0.5]) {
            assert_eq!(cell(place[0]) as usize, cell_of(place)[0], "{place:?}");
        }
    }
}

//! Numbers of steps.

use crate::math::floor;

/// Steps of a ray are counted to here: many times as many as a ray has.
const MOST_STEPS: f32 = 4_194_304.0;

/// The first step at a number of steps or behind it; of NaN the first of all.
#[inline(always)]
pub(super) fn first_step(steps: f32) -> u32 {
    let steps = steps.max(0.0).min(MOST_STEPS);
    let (below, step) = floor(steps);
    step + u32::from(steps > below)
}

#[cfg(test)]
mod tests {
    use super::*;

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
    }
}

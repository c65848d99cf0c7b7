//! Numbers of steps.

/// Steps of a ray are counted to here: many times as many as a ray has.
const MOST_STEPS: f32 = 4_194_304.0;

/// The first step at a number of steps or behind it; of NaN the first of all.
#[inline(always)]
pub(super) fn first_step(steps: f32) -> u32 {
    whole(steps.ceil(), MOST_STEPS)
}

/// A number, at least 0 and at most `most`, without its fraction. Written so that it vectorises,
/// which `as u32` doesn't; exact below 2^23.
#[inline(always)]
pub(super) fn whole(number: f32, most: f32) -> u32 {
    // From 2^23 to 2^24 numbers are whole, and are their last bits.
    const WHOLE_FROM: f32 = 8_388_608.0;
    let number = number.max(0.0).min(most).floor();
    (number + WHOLE_FROM).to_bits() - WHOLE_FROM.to_bits()
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
        for number in (0..400_000).map(|i| i as f32 * 0.37) {
            assert_eq!(whole(number, MOST_STEPS), number as u32);
        }
        assert_eq!(whole(128.0, 127.0), 127);
    }
}

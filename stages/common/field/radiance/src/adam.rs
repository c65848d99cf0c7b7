use std::ops::Range;

use crate::spec::{ADAM_BETA, ADAM_EPSILON, ADAM_ROUNDED_BITS};
use numerics::kernel;
use numerics::simd::LANES;

/// Constants of one optimiser step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AdamStep {
    /// Learning rate times this step's bias corrections.
    pub(crate) rate: f32,
    pub(crate) beta1: f32,
    pub(crate) beta2: f32,
    pub(crate) epsilon: f32,
    /// Weight decay: decay·weight is added to the gradient.
    pub(crate) decay: f32,
}

impl AdamStep {
    /// Creates the constants of Adam (Kingma and Ba 2015), with both bias corrections folded into
    /// the rate. `step` counts from 1.
    pub(crate) fn new(step: u64, rate: f64, decay: f32) -> Self {
        let [beta1, beta2] = ADAM_BETA;
        // Both corrections are 1 long before this limit, which is chosen by hand.
        let t = step.min(100_000) as i32;
        let corrected = rate * (1.0 - beta2.powi(t)).sqrt() / (1.0 - beta1.powi(t));
        Self {
            rate: corrected as f32,
            beta1: beta1 as f32,
            beta2: beta2 as f32,
            epsilon: ADAM_EPSILON as f32,
            decay,
        }
    }
}

/// Number of bricks whose marks are scanned together; chosen by hand.
const BRICKS_PER_SCAN: usize = 512;
/// Number of touched blocks that are prefetched before their use; chosen by hand.
const BLOCKS_AHEAD: usize = 16;

/// Rounds both moments of a weight to 16 bits each, so that a step reads and writes less memory
/// (docs/design/006). The upper half is the first moment's bfloat16; the lower half is the second
/// moment, which is never negative: eight bits of exponent, eight of fraction.
#[inline(always)]
fn pack_moments(moments: [f32; 2]) -> u32 {
    let [first, second] = [0, 1].map(|i| {
        let bits = ADAM_ROUNDED_BITS[i];
        moments[i].to_bits().wrapping_add(1 << (bits - 1)) >> bits
    });
    first << 16 | second
}

/// Returns the first and second moment of [`pack_moments`].
#[inline(always)]
fn unpack_moments(packed: u32) -> [f32; 2] {
    let [first, second] = ADAM_ROUNDED_BITS;
    [f32::from_bits(packed >> 16 << first), f32::from_bits((packed & 0xffff) << second)]
}

/// Takes the Adam step of sixteen weights. Weights whose gradient is 0 keep value and moments.
#[inline(always)]
fn update_block(
    step: &AdamStep,
    gradients: &[f32; LANES],
    weights: &mut [f32; LANES],
    moments: &mut [u32; LANES],
) {
    for i in 0..LANES {
        let touched = gradients[i] != 0.0;
        let [first, second] = unpack_moments(moments[i]);
        let gradient = step.decay.mul_add(weights[i], gradients[i]);
        let m1 = (first - gradient).mul_add(step.beta1, gradient);
        let square = gradient * gradient;
        let v1 = (second - square).mul_add(step.beta2, square);
        let w1 = (-step.rate).mul_add(m1 / (v1.sqrt() + step.epsilon), weights[i]);
        // Rounding changes no rounded number. A choice between old and new bits would become a
        // masked store, which is slow on AMD processors (docs/design/006).
        moments[i] =
            pack_moments([if touched { m1 } else { first }, if touched { v1 } else { second }]);
        weights[i] = if touched { w1 } else { weights[i] };
    }
}

kernel! {
    /// Takes an Adam step of the networks' weights, and clears the gradients. Lengths are equal
    /// multiples of 16.
    pub(crate) fn adam<L>(
        step: &AdamStep, gradients: &mut [f32], weights: &mut [f32], moments: &mut [u32],
    ) {
        let gradients = gradients.as_chunks_mut::<LANES>().0;
        let weights = weights.as_chunks_mut::<LANES>().0;
        let moments = moments.as_chunks_mut::<LANES>().0;
        for ((gradients, weights), moments) in gradients.iter_mut().zip(weights).zip(moments) {
            update_block(step, gradients, weights, moments);
            *gradients = [0.0; LANES];
        }
    }
}

/// For some bricks: the gradients of one half of each brick, and one mark per brick. A mark is 0 if
/// the half has no gradient. Half h of brick b is block 2·b + h of the weights.
pub(crate) type HalfPiece<'a> = (&'a mut [f32], &'a mut [u8]);

kernel! {
    /// Takes one lazy Adam step of some bricks of a level: entries whose gradient is 0 keep value
    /// and moments. Visits only touched halves of bricks, and clears their gradients and marks.
    pub(crate) fn adam_of_bricks<L>(
        step: &AdamStep, halves: &mut [HalfPiece<'_>; 2], weights: &mut [f32],
        moments: &mut [u32],
    ) {
        let weights = weights.as_chunks_mut::<LANES>().0;
        let moments = moments.as_chunks_mut::<LANES>().0;
        let n_bricks = weights.len() / 2;
        let mut list = [0; 2 * BRICKS_PER_SCAN];
        for start in (0..n_bricks).step_by(BRICKS_PER_SCAN) {
            let bricks = start..(start + BRICKS_PER_SCAN).min(n_bricks);
            let count = list_touched(halves, bricks, &mut list);
            for at in 0..count {
                // Blocks are far apart in memory, and each needs little arithmetic.
                let ahead = list[(at + BLOCKS_AHEAD).min(count - 1)];
                L::prefetch(&weights[ahead]);
                L::prefetch(&halves[ahead % 2].0[ahead / 2 * LANES..]);
                L::prefetch(&moments[ahead]);
                let block = list[at];
                let gradients = &mut halves[block % 2].0.as_chunks_mut::<LANES>().0[block / 2];
                update_block(step, gradients, &mut weights[block], &mut moments[block]);
                *gradients = [0.0; LANES];
            }
        }
    }
}

/// Lists the touched blocks of a range of bricks, and clears the marks. Returns the number of
/// blocks.
#[inline(always)]
fn list_touched(
    halves: &mut [HalfPiece<'_>; 2],
    bricks: Range<usize>,
    list: &mut [usize; 2 * BRICKS_PER_SCAN],
) -> usize {
    let mut count = 0;
    let [(_, even), (_, odd)] = halves;
    let marks = even[bricks.clone()].iter_mut().zip(&mut odd[bricks.clone()]);
    for (brick, (even, odd)) in bricks.zip(marks) {
        for (half, mark) in [even, odd].into_iter().enumerate() {
            list[count] = 2 * brick + half;
            count += usize::from(std::mem::take(mark) != 0);
        }
    }
    count
}

kernel! {
    /// Moves the weights' running average towards `now` by the fraction `share`.
    pub(crate) fn update_average<L>(average: &mut [f32], now: &[f32], share: f32) {
        for (average, now) in average.iter_mut().zip(now) {
            *average = share.mul_add(now - *average, *average);
        }
    }
}

#[cfg(test)]
mod tests {
    use numerics::uniform;

    use super::*;
    use numerics::simd::test_every_family;

    /// Rounding changes a moment by at most half of its last stored bit.
    #[test]
    fn moments_are_rounded_to_nearest() {
        for i in 0..10_000 {
            let power = (160.0 * uniform(3, 0, i) - 80.0).exp2();
            let [first, second] = [uniform(3, 1, i) - 0.5, uniform(3, 2, i)].map(|x| x * power);
            let packed = pack_moments([first, second]);
            let rounded = unpack_moments(packed);
            assert!((rounded[0] - first).abs() <= first.abs() / 256.0, "{first}");
            assert!((rounded[1] - second).abs() <= second / 512.0, "{second}");
            assert_eq!(pack_moments(rounded), packed);
        }
        assert_eq!(unpack_moments(pack_moments([0.0, f32::INFINITY])), [0.0, f32::INFINITY]);
        assert_eq!(pack_moments([0.0, 0.0]), 0);
    }

    #[test]
    fn touched_entries_equal_adam_in_f64_with_rounded_moments() {
        let n = 32;
        let mut w: Vec<f32> = (0..n).map(|i| i as f32 / 10.0).collect();
        let mut moments = vec![0; n];
        let mut exact: Vec<[f64; 3]> = w.iter().map(|&w| [f64::from(w), 0.0, 0.0]).collect();
        for t in 1..=3 {
            let mut g: Vec<f32> =
                (0..n).map(|i| if i % 3 == 0 { 0.0 } else { ((i * t) as f32).sin() }).collect();
            for (e, &g) in exact.iter_mut().zip(&g) {
                if g != 0.0 {
                    let g = f64::from(g);
                    e[1] = 0.9 * e[1] + 0.1 * g;
                    e[2] = 0.99 * e[2] + 0.01 * g * g;
                    let (mh, vh) = (
                        e[1] / (1.0 - 0.9f64.powi(t as i32)),
                        e[2] / (1.0 - 0.99f64.powi(t as i32)),
                    );
                    e[0] -= 0.01 * mh / (vh.sqrt() + 1e-15);
                    let rounded = unpack_moments(pack_moments([e[1] as f32, e[2] as f32]));
                    [e[1], e[2]] = rounded.map(f64::from);
                }
            }
            adam(&AdamStep::new(t as u64, 0.01, 0.0), &mut g, &mut w, &mut moments);
            assert!(g.iter().all(|&g| g == 0.0));
        }
        for (i, (w, e)) in w.iter().zip(&exact).enumerate() {
            assert!((f64::from(*w) - e[0]).abs() < 1e-6, "{i}");
        }
        assert_eq!(w[3], 0.3);
    }

    /// Number of bricks in these tests.
    const BRICKS: usize = 4501;

    fn is_touched(block: usize) -> bool {
        uniform(8, 0, block as u64) < 0.1
    }

    /// Returns weights and moments of [`BRICKS`] bricks after a step in pieces of `bricks` bricks.
    /// A tenth of the blocks, which are halves of bricks, are touched.
    fn after_step(bricks: usize) -> (Vec<f32>, Vec<u32>) {
        let n = (2 * BRICKS * LANES) as u64;
        let mut weights: Vec<f32> = (0..n).map(|i| uniform(7, 0, i)).collect();
        let mut moments: Vec<u32> =
            (0..n).map(|i| pack_moments([uniform(7, 1, i), uniform(7, 2, i)])).collect();
        let mut marks = [0, 1].map(|half| -> Vec<u8> {
            (0..BRICKS).map(|brick| u8::from(is_touched(2 * brick + half))).collect()
        });
        let mut sums = marks.each_ref().map(|marks| -> Vec<f32> {
            marks.iter().flat_map(|mark| [0.5 * f32::from(*mark); LANES]).collect()
        });
        let step = AdamStep::new(3, 0.01, 0.0);
        for first in (0..BRICKS).step_by(bricks) {
            let piece = first..(first + bricks).min(BRICKS);
            let blocks = piece.start * LANES..piece.end * LANES;
            let table = 2 * blocks.start..2 * blocks.end;
            let (weights, moments) = (&mut weights[table.clone()], &mut moments[table]);
            let [even, odd] = &mut sums;
            let [even_marks, odd_marks] = &mut marks;
            let mut halves = [
                (&mut even[blocks.clone()], &mut even_marks[piece.clone()]),
                (&mut odd[blocks], &mut odd_marks[piece]),
            ];
            adam_of_bricks(&step, &mut halves, weights, moments);
        }
        assert!(marks.iter().flatten().all(|mark| *mark == 0));
        assert!(sums.iter().flatten().all(|sum| *sum == 0.0));
        (weights, moments)
    }

    #[test]
    fn pieces_and_families_give_equal_bits_and_leave_untouched_blocks() {
        let undivided = after_step(BRICKS);
        for (block, weights) in undivided.0.chunks(LANES).enumerate() {
            let initial = uniform(7, 0, (block * LANES) as u64);
            assert_eq!(weights[0] != initial, is_touched(block), "block {block}");
        }
        test_every_family(|family| {
            for bricks in [1, 127, 2048] {
                assert!(after_step(bricks) == undivided, "{family:?}, pieces of {bricks}");
            }
        });
    }
}

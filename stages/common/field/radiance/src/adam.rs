use std::ops::Range;

use crate::spec::{ADAM_BETA, ADAM_EPSILON};
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
    /// Creates the constants of Adam's (Kingma and Ba 2015) step 1, 2, …, with both bias
    /// corrections folded into the rate.
    pub(crate) fn new(step: u64, rate: f64, decay: f32) -> Self {
        let [beta1, beta2] = ADAM_BETA;
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
const BRICKS_PER_SCAN: usize = 128;
/// Number of touched blocks that are prefetched before their use; chosen by hand.
const BLOCKS_AHEAD: usize = 8;

/// Takes the Adam step of sixteen weights. Weights whose gradient is 0 keep value and moments.
#[inline(always)]
fn update_block(
    step: &AdamStep,
    gradients: &[f32; LANES],
    weights: &mut [f32; LANES],
    first: &mut [f32; LANES],
    second: &mut [f32; LANES],
) {
    for i in 0..LANES {
        let touched = gradients[i] != 0.0;
        let gradient = step.decay.mul_add(weights[i], gradients[i]);
        let m1 = (first[i] - gradient).mul_add(step.beta1, gradient);
        let square = gradient * gradient;
        let v1 = (second[i] - square).mul_add(step.beta2, square);
        let w1 = (-step.rate).mul_add(m1 / (v1.sqrt() + step.epsilon), weights[i]);
        first[i] = if touched { m1 } else { first[i] };
        second[i] = if touched { v1 } else { second[i] };
        weights[i] = if touched { w1 } else { weights[i] };
    }
}

kernel! {
    /// Takes an Adam step of the networks' weights, and clears the gradients. Lengths are equal
    /// multiples of 16.
    pub(crate) fn adam<L>(
        step: &AdamStep, gradients: &mut [f32], weights: &mut [f32], first: &mut [f32],
        second: &mut [f32],
    ) {
        let (weights, gradients) = (weights.as_chunks_mut::<LANES>().0,
            gradients.as_chunks_mut::<LANES>().0);
        let (first, second) = (first.as_chunks_mut::<LANES>().0, second.as_chunks_mut::<LANES>().0);
        let blocks = gradients.iter_mut().zip(weights).zip(first.iter_mut().zip(second));
        for ((gradients, weights), (first, second)) in blocks {
            update_block(step, gradients, weights, first, second);
            *gradients = [0.0; LANES];
        }
    }
}

/// Gradients of one half of each of some bricks, and a mark for each brick: not 0 if its half has a
/// gradient. Half h of brick b is block 2·b + h of the weights.
pub(crate) type HalfPiece<'a> = (&'a mut [f32], &'a mut [u8]);

kernel! {
    /// Takes one lazy Adam step of some bricks of a level: entries whose gradient is 0 keep value
    /// and moments. Visits only touched halves of bricks, and clears their gradients and marks.
    pub(crate) fn adam_of_bricks<L>(
        step: &AdamStep, halves: &mut [HalfPiece<'_>; 2], weights: &mut [f32],
        first: &mut [f32], second: &mut [f32],
    ) {
        let weights = weights.as_chunks_mut::<LANES>().0;
        let (first, second) = (first.as_chunks_mut::<LANES>().0, second.as_chunks_mut::<LANES>().0);
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
                L::prefetch(&first[ahead]);
                L::prefetch(&second[ahead]);
                let block = list[at];
                let sums = &mut halves[block % 2].0.as_chunks_mut::<LANES>().0[block / 2];
                update_block(step, sums, &mut weights[block], &mut first[block],
                    &mut second[block]);
                *sums = [0.0; LANES];
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

    #[test]
    fn equals_adam_in_f64_where_touched() {
        let n = 32;
        let mut w: Vec<f32> = (0..n).map(|i| i as f32 / 10.0).collect();
        let (mut m, mut v) = (vec![0.0f32; n], vec![0.0f32; n]);
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
                }
            }
            adam(&AdamStep::new(t as u64, 0.01, 0.0), &mut g, &mut w, &mut m, &mut v);
            assert!(g.iter().all(|&g| g == 0.0));
        }
        for (i, (w, e)) in w.iter().zip(&exact).enumerate() {
            assert!((f64::from(*w) - e[0]).abs() < 1e-6, "{i}");
        }
        assert_eq!(w[3], 0.3);
    }

    /// Number of bricks of the tests.
    const BRICKS: usize = 4501;

    fn is_touched(block: usize) -> bool {
        uniform(8, 0, block as u64) < 0.1
    }

    /// Returns weights and moments of many bricks, few of whose halves are touched, after a step in
    /// pieces of `bricks` bricks.
    fn after_step(bricks: usize) -> [Vec<f32>; 3] {
        let [mut w, mut m, mut v] = [0, 1, 2].map(|purpose| -> Vec<f32> {
            (0..(2 * BRICKS * LANES) as u64).map(|i| uniform(7, purpose, i)).collect()
        });
        let mut marks = [0, 1].map(|half| -> Vec<u8> {
            (0..BRICKS).map(|brick| u8::from(is_touched(2 * brick + half))).collect()
        });
        let mut sums = marks.each_ref().map(|marks| -> Vec<f32> {
            marks.iter().flat_map(|mark| [0.5 * f32::from(*mark); LANES]).collect()
        });
        let step = AdamStep::new(3, 0.01, 0.0);
        for first in (0..BRICKS).step_by(bricks) {
            let here = first..(first + bricks).min(BRICKS);
            let blocks = here.start * LANES..here.end * LANES;
            let table = 2 * blocks.start..2 * blocks.end;
            let [w, m, v] = [&mut w, &mut m, &mut v].map(|n| &mut n[table.clone()]);
            let [even, odd] = &mut sums;
            let [even_marks, odd_marks] = &mut marks;
            let mut halves = [
                (&mut even[blocks.clone()], &mut even_marks[here.clone()]),
                (&mut odd[blocks], &mut odd_marks[here]),
            ];
            adam_of_bricks(&step, &mut halves, w, m, v);
        }
        assert!(marks.iter().flatten().all(|mark| *mark == 0));
        assert!(sums.iter().flatten().all(|sum| *sum == 0.0));
        [w, m, v]
    }

    #[test]
    fn pieces_and_families_give_equal_bits_and_leave_what_is_untouched() {
        let whole = after_step(BRICKS);
        for (block, numbers) in whole[0].chunks(LANES).enumerate() {
            let begin = uniform(7, 0, (block * LANES) as u64);
            assert_eq!(numbers[0] != begin, is_touched(block), "block {block}");
        }
        test_every_family(|family| {
            for pieces in [1, 127, 2048] {
                assert!(after_step(pieces) == whole, "{family:?}, pieces of {pieces}");
            }
        });
    }
}

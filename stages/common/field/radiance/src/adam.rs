use crate::simd::{LANES, kernel};
use crate::spec::{ADAM_BETA, ADAM_EPSILON};

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

/// Marks of the blocks of 16 floats that a step has touched. A mark is a byte, since a bit would
/// have to be read before it is set.
pub(crate) type Touched = [u8];

/// Number of blocks whose marks are scanned together; chosen by hand.
const BLOCKS_PER_SCAN: usize = 256;
/// Number of touched blocks that are prefetched before their use; chosen by hand.
const BLOCKS_AHEAD: usize = 8;

kernel! {
    /// Takes one lazy Adam step: entries whose gradient is 0 keep value and moments. Visits only
    /// the touched blocks, and clears their gradients and marks. Lengths are equal multiples of 16.
    pub(crate) fn adam<L>(
        step: &AdamStep, touched: &mut Touched, weights: &mut [f32], gradients: &mut [f32],
        first: &mut [f32], second: &mut [f32],
    ) {
        let (weights, gradients) = (weights.as_chunks_mut::<LANES>().0,
            gradients.as_chunks_mut::<LANES>().0);
        let (first, second) = (first.as_chunks_mut::<LANES>().0, second.as_chunks_mut::<LANES>().0);
        let n_blocks = touched.len().min(weights.len());
        let mut list = [0; BLOCKS_PER_SCAN];
        for start in (0..n_blocks).step_by(BLOCKS_PER_SCAN) {
            let marks = &mut touched[start..(start + BLOCKS_PER_SCAN).min(n_blocks)];
            if marks.iter().fold(0, |any, m| any | m) == 0 {
                continue;
            }
            let mut count = 0;
            for (block, mark) in (start..).zip(marks) {
                list[count] = block;
                count += usize::from(std::mem::take(mark) != 0);
            }
            for at in 0..count {
                // Blocks are far apart in memory, and each needs little arithmetic.
                let ahead = list[(at + BLOCKS_AHEAD).min(count - 1)];
                L::prefetch(&weights[ahead]);
                L::prefetch(&gradients[ahead]);
                L::prefetch(&first[ahead]);
                L::prefetch(&second[ahead]);
                let block = list[at];
                let (w, g, m, v) = (&mut weights[block], &mut gradients[block], &mut first[block],
                    &mut second[block]);
                for i in 0..LANES {
                    let touched = g[i] != 0.0;
                    let gradient = step.decay.mul_add(w[i], g[i]);
                    let m1 = (m[i] - gradient).mul_add(step.beta1, gradient);
                    let square = gradient * gradient;
                    let v1 = (v[i] - square).mul_add(step.beta2, square);
                    let w1 = (-step.rate).mul_add(m1 / (v1.sqrt() + step.epsilon), w[i]);
                    m[i] = if touched { m1 } else { m[i] };
                    v[i] = if touched { v1 } else { v[i] };
                    w[i] = if touched { w1 } else { w[i] };
                    g[i] = 0.0;
                }
            }
        }
    }
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
    use counter_rng::uniform;

    use super::*;
    use crate::simd::by_every_family;

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
            let mut touched = [1; 2];
            adam(&AdamStep::new(t as u64, 0.01, 0.0), &mut touched, &mut w, &mut g, &mut m, &mut v);
            assert!(g.iter().all(|&g| g == 0.0));
        }
        for (i, (w, e)) in w.iter().zip(&exact).enumerate() {
            assert!((f64::from(*w) - e[0]).abs() < 1e-6, "{i}");
        }
        assert_eq!(w[3], 0.3);
    }

    /// Numbers of many blocks, few of them touched, after a step in pieces of so many blocks.
    fn after_step(in_pieces_of: usize) -> [Vec<f32>; 4] {
        let blocks = 9001;
        let [mut w, mut m, mut v, mut g] = [0, 1, 2, 3].map(|purpose| -> Vec<f32> {
            (0..(blocks * LANES) as u64).map(|i| uniform(7, purpose, i)).collect()
        });
        let mut touched: Vec<u8> =
            (0..blocks as u64).map(|block| u8::from(uniform(8, 0, block) < 0.1)).collect();
        for (block, numbers) in g.chunks_mut(LANES).enumerate() {
            if touched[block] == 0 {
                numbers.fill(0.0);
            }
        }
        let (step, len) = (AdamStep::new(3, 0.01, 0.0), in_pieces_of * LANES);
        for (i, touched) in touched.chunks_mut(in_pieces_of).enumerate() {
            let here = i * len..(i * len + touched.len() * LANES);
            let [w, g, m, v] = [&mut w, &mut g, &mut m, &mut v].map(|n| &mut n[here.clone()]);
            adam(&step, touched, w, g, m, v);
        }
        assert!(touched.iter().all(|mark| *mark == 0));
        [w, g, m, v]
    }

    #[test]
    fn pieces_and_families_give_equal_bits_and_leave_what_is_untouched() {
        let whole = after_step(1 << 20);
        for (block, numbers) in whole[0].chunks(LANES).enumerate() {
            let begin = uniform(7, 0, (block * LANES) as u64);
            assert_eq!(numbers[0] != begin, uniform(8, 0, block as u64) < 0.1, "block {block}");
        }
        by_every_family(|family| {
            for pieces in [1, 255, 4096] {
                assert!(after_step(pieces) == whole, "{family:?}, pieces of {pieces}");
            }
        });
    }
}

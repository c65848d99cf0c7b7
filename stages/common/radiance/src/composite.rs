//! Volume rendering in optical depth: T = e^(-Σ τ) and w = T·(1 - e^(-τ)), so that no product of
//! (1-α) can round to 0.

use crate::math::{exp, one_minus_exp_neg};
use crate::simd::kernel;
use crate::spec::MAX_RAW_DENSITY;

kernel! {
    /// Optical depth τ of each sample: density e^raw times the step.
    pub(crate) fn optical_depths<L>(raw: &[f32], step: f32, tau: &mut [f32]) {
        for (tau, &raw) in tau.iter_mut().zip(raw) {
            *tau = exp(raw.min(MAX_RAW_DENSITY)) * step;
        }
    }
}

kernel! {
    /// Transmittance before each sample and its weight, from the optical depth before it and its
    /// own.
    pub(crate) fn weights<L>(before: &[f32], tau: &[f32], transmittance: &mut [f32],
        weight: &mut [f32]) {
        for i in 0..before.len().min(tau.len()).min(transmittance.len()).min(weight.len()) {
            let t = exp(-before[i]);
            transmittance[i] = t;
            weight[i] = t * one_minus_exp_neg(tau[i]);
        }
    }
}

/// Gradient of a loss by each sample's optical depth, along one ray from back to front.
///
/// With C = Σ w c + T_end·b and g = dL/dC: dL/dτ_i = T_{i+1}·(g·c_i) - Σ_{j>i} w_j·(g·c_j) -
/// T_end·(g·b).
pub(crate) fn optical_depth_gradients(
    shade: &[f32],
    transmittance: &[f32],
    weight: &[f32],
    behind: f32,
    gradient: &mut [f32],
) {
    let mut suffix = behind;
    for i in (0..shade.len()).rev() {
        gradient[i] = (transmittance[i] - weight[i]).mul_add(shade[i], -suffix);
        suffix = weight[i].mul_add(shade[i], suffix);
    }
}

/// Weights of what is asked of rays beside their colours, for one ray.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Regularisers {
    /// Of the distortion loss.
    pub(crate) distortion: f32,
    /// Of the floater loss: T·Σ_i w_i·[`likeness`]_i, without a gradient by the colours, which
    /// would make floaters darker instead of thinner, or by the ray's transmittance T. What stops a
    /// ray is paint of the background's colour, no floater: it would become thin and darker, and
    /// look the same.
    pub(crate) floater_loss: f32,
}

/// How far apart colours at most are for matter to pass for the background.
pub const LIKE_BACKGROUND: f32 = 0.1;

/// How much matter passes for the background it lies before: 1 where it has its colour, 0 from
/// [`LIKE_BACKGROUND`] on. Whether it is there no image tells that sees it before the background
/// alone.
pub(crate) fn likeness(colour: [f32; 3], background: [f32; 3]) -> f32 {
    let squared: f32 = colour.iter().zip(background).map(|(c, b)| (c - b) * (c - b)).sum();
    (1.0 - squared / (LIKE_BACKGROUND * LIKE_BACKGROUND)).max(0.0)
}

/// Adds to `shade`, the gradient of a loss by each weight of a ray, that of the distortion loss
/// (Barron et al. 2022, "Mip-NeRF 360", eq. 15) times `factor`: Σ_ij w_i·w_j·|t_i - t_j| +
/// ⅓·step·Σ_i w_i². It draws a ray's weights together. `t` rises.
pub(crate) fn add_distortion_gradients(
    t: &[f32],
    weight: &[f32],
    step: f32,
    factor: f32,
    shade: &mut [f32],
) {
    let whole: f32 = weight.iter().sum();
    // Measured from the mean, so that nothing cancels.
    let mean = weight.iter().zip(t).map(|(w, t)| w * t).sum::<f32>() / whole.max(f32::MIN_POSITIVE);
    let (mut before, mut moment) = (0.0, 0.0);
    for ((shade, &w), &t) in shade.iter_mut().zip(weight).zip(t) {
        let t = t - mean;
        // Σ_j w_j·|t - t_j|: what lies before with +, what lies behind with -; all moments add up
        // to 0.
        let apart = t * (2.0 * before + w - whole) - (2.0 * moment + w * t);
        *shade += 2.0 * factor * (apart + step * w / 3.0);
        before += w;
        moment += w * t;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn composite(tau: &[f32]) -> (Vec<f32>, Vec<f32>, f32) {
        let mut before = vec![0.0; tau.len()];
        let mut sum = 0.0f32;
        for (b, t) in before.iter_mut().zip(tau) {
            *b = sum;
            sum += t;
        }
        let (mut transmittance, mut weight) = (before.clone(), before.clone());
        weights(&before, tau, &mut transmittance, &mut weight);
        (transmittance, weight, exp(-sum))
    }

    proptest! {
        /// From nothing to far beyond opaque.
        #[test]
        fn weights_are_a_partition(exponents in prop::collection::vec(-40.0f32..16.0, 1..200)) {
            let tau: Vec<f32> = exponents.iter().map(|e| e.exp2()).collect();
            let (transmittance, weight, end) = composite(&tau);
            prop_assert!(weight.iter().all(|w| *w >= 0.0 && w.is_finite()));
            prop_assert!(transmittance.is_sorted_by(|a, b| a >= b));
            let total: f64 = weight.iter().map(|&w| f64::from(w)).sum::<f64>() + f64::from(end);
            prop_assert!((total - 1.0).abs() < 2e-5, "{total}");
        }

        #[test]
        fn gradients_equal_f64_differences(
            samples in prop::collection::vec((-8.0f32..3.0, -1.0f32..1.0), 1..40),
            behind in -1.0f32..1.0,
        ) {
            let tau: Vec<f32> = samples.iter().map(|(e, _)| e.exp2()).collect();
            let shade: Vec<f32> = samples.iter().map(|(_, s)| *s).collect();
            let (transmittance, weight, end) = composite(&tau);
            let mut gradient = vec![0.0; tau.len()];
            optical_depth_gradients(&shade, &transmittance, &weight, end * behind, &mut gradient);
            let loss = |tau: &[f64]| {
                let (mut od, mut sum) = (0.0f64, 0.0f64);
                for (t, s) in tau.iter().zip(&shade) {
                    sum += (-od).exp() * -(-t).exp_m1() * f64::from(*s);
                    od += t;
                }
                sum + (-od).exp() * f64::from(behind)
            };
            for i in 0..tau.len() {
                let mut wide: Vec<f64> = tau.iter().map(|&t| f64::from(t)).collect();
                let h = 1e-5;
                wide[i] += h;
                let up = loss(&wide);
                wide[i] -= 2.0 * h;
                let numeric = (up - loss(&wide)) / (2.0 * h);
                prop_assert!((f64::from(gradient[i]) - numeric).abs() < 3e-6, "{i}: {} {numeric}",
                    gradient[i]);
            }
        }
    }

    proptest! {
        #[test]
        fn distortion_gradients_equal_f64_differences(
            samples in prop::collection::vec((0.001f32..0.2, 1e-4f32..0.5), 1..40),
            factor in 0.01f32..2.0,
        ) {
            let mut t: Vec<f32> = samples.iter().map(|(gap, _)| *gap).collect();
            (1..t.len()).for_each(|i| t[i] += t[i - 1]);
            let weight: Vec<f32> = samples.iter().map(|(_, w)| *w).collect();
            let mut shade = vec![0.0; t.len()];
            add_distortion_gradients(&t, &weight, 0.003, factor, &mut shade);
            let exact = |i: usize| -> f64 {
                let apart: f64 = (0..t.len()).map(|j| f64::from(weight[j]) * (f64::from(t[i]) - f64::from(t[j])).abs()).sum();
                2.0 * f64::from(factor) * (apart + 0.003 / 3.0 * f64::from(weight[i]))
            };
            // Distances are differences of f32 numbers: known to a few parts in 10^7 of how far
            // along the ray they lie.
            let whole: f32 = weight.iter().sum();
            let rounding = 4e-7 * f64::from(factor * whole * t[t.len() - 1]);
            let largest = (0..t.len()).map(exact).fold(1e-3, f64::max);
            for i in 0..t.len() {
                let error = (f64::from(shade[i]) - exact(i)).abs();
                prop_assert!(error < 1e-5 * largest + rounding, "{i}: {} {}", shade[i], exact(i));
            }
        }
    }

    #[test]
    fn overflowing_density_is_opaque() {
        let mut tau = vec![0.0; 3];
        optical_depths(&[f32::MAX, f32::NEG_INFINITY, 400.0], 0.003, &mut tau);
        let (_, weight, end) = composite(&tau);
        assert_eq!((weight[0], end), (1.0, exp(-87.0)));
        assert!(tau.iter().all(|t| t.is_finite()));
    }
}

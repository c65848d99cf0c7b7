//! Volume rendering in optical depth: T = e^(-Σ τ) and w = T·(1 - e^(-τ)), so that no product of
//! (1-α) can round to 0.

use crate::math::{exp, one_minus_exp_neg};
use crate::spec::MAX_RAW_DENSITY;
use numerics::kernel;

kernel! {
    /// Computes each sample's optical depth τ: density e^raw times the step.
    pub(crate) fn optical_depths<L>(raw: &[f32], step: f32, tau: &mut [f32]) {
        for (tau, &raw) in tau.iter_mut().zip(raw) {
            *tau = exp(raw.min(MAX_RAW_DENSITY)) * step;
        }
    }
}

kernel! {
    /// Computes each sample's transmittance and weight from the optical depth `before` it and its
    /// own, `tau`.
    pub(crate) fn weights<L>(before: &[f32], tau: &[f32], transmittance: &mut [f32],
        weight: &mut [f32]) {
        for i in 0..before.len().min(tau.len()).min(transmittance.len()).min(weight.len()) {
            let t = exp(-before[i]);
            transmittance[i] = t;
            weight[i] = t * one_minus_exp_neg(tau[i]);
        }
    }
}

kernel! {
    /// Computes the gradient of a loss with respect to each sample's optical depth, along one ray.
    ///
    /// With C = Σ w c + T_end·b, g = dL/dC and `by_weight` s_i = dL/dw_i, which is g·c_i without
    /// regularisers: dL/dτ_i = T_{i+1}·s_i - Σ_{j>i} w_j·s_j - T_end·(g·b). Here T_{i+1} is
    /// T_i - w_i, and `behind` is T_end·(g·b).
    pub(crate) fn optical_depth_gradients<L>(by_weight: &[f32], transmittance: &[f32],
        weight: &[f32], behind: f32, gradient: &mut [f32]) {
        let mut suffix = behind;
        for i in (0..by_weight.len()).rev() {
            gradient[i] = (transmittance[i] - weight[i]).mul_add(by_weight[i], -suffix);
            suffix = weight[i].mul_add(by_weight[i], suffix);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Returns transmittances, weights and the light left behind the last sample.
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

    /// Computes a ray's composited shade in f64.
    fn loss(shade: &[f32], behind: f32, tau: &[f64]) -> f64 {
        let (mut optical_depth, mut sum) = (0.0f64, 0.0f64);
        for (t, s) in tau.iter().zip(shade) {
            sum += (-optical_depth).exp() * -(-t).exp_m1() * f64::from(*s);
            optical_depth += t;
        }
        sum + (-optical_depth).exp() * f64::from(behind)
    }

    proptest! {
        /// Optical depths range from almost zero to far beyond opaque.
        #[test]
        fn weights_sum_to_stopped_light(
            exponents in prop::collection::vec(-40.0f32..16.0, 1..200),
        ) {
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
            for i in 0..tau.len() {
                let mut shifted: Vec<f64> = tau.iter().map(|&t| f64::from(t)).collect();
                let h = 1e-5;
                shifted[i] += h;
                let up = loss(&shade, behind, &shifted);
                shifted[i] -= 2.0 * h;
                let numeric = (up - loss(&shade, behind, &shifted)) / (2.0 * h);
                prop_assert!((f64::from(gradient[i]) - numeric).abs() < 3e-6, "{i}: {} {numeric}",
                    gradient[i]);
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

//! Regularisers: losses on a ray other than the error of its colour. Each has a weight and a
//! function that adds the loss's gradient with respect to each sample's weight. `torch-field`
//! computes the losses for autograd. The distortion loss is checked in f64 here, the floater loss
//! in `reference.rs`.

use crate::spec::MAX_FLOATER_COLOUR_DISTANCE;

/// Weights of the regularisers; 0 disables one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Regularisers {
    /// Weight of the distortion loss (Barron et al. 2022, "Mip-NeRF 360", eq. 15), a mean over rays
    /// (docs/design/012).
    pub distortion: f64,
    /// Weight of the floater loss on opacity of the background's colour, a mean over rays
    /// (docs/design/013).
    pub floater_loss: f64,
}

/// One ray's samples from front to back, its transmittance and its background.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ShadedRay<'a> {
    /// Parameter t of each sample, ascending.
    pub(crate) t: &'a [f32],
    pub(crate) weight: &'a [f32],
    /// Length of a step in t.
    pub(crate) step: f32,
    /// Red, green and blue of many rays' samples.
    pub(crate) channels: [&'a [f32]; 3],
    /// Indices of this ray's samples in `channels`.
    pub(crate) indices: &'a [u32],
    /// Transmittance T of the whole ray.
    pub(crate) transmittance: f32,
    pub(crate) background: [f32; 3],
}

impl Regularisers {
    /// Returns the weights for one ray, if each bundle of `bundle` rays has weight `scale`.
    pub(crate) fn per_ray(&self, scale: f32, bundle: usize) -> Self {
        let per_ray = |weight: f64| f64::from(weight as f32 * scale / bundle as f32);
        Self { distortion: per_ray(self.distortion), floater_loss: per_ray(self.floater_loss) }
    }

    /// Adds the losses' gradients with respect to each sample's weight. `self` has the weights for
    /// one ray.
    #[inline]
    pub(crate) fn add_gradients(&self, ray: &ShadedRay<'_>, by_weight: &mut [f32]) {
        let Self { distortion, floater_loss } = *self;
        let floater = floater_loss as f32 * ray.transmittance;
        if floater > 0.0 {
            add_floater_gradients(ray, floater, by_weight);
        }
        if distortion > 0.0 {
            add_distortion_gradients(ray, distortion as f32, by_weight);
        }
    }
}

impl ShadedRay<'_> {
    /// Returns the samples' colours.
    #[inline]
    fn colours(&self) -> impl Iterator<Item = [f32; 3]> {
        self.indices.iter().map(move |&k| self.channels.map(|channel| channel[k as usize]))
    }
}

/// Returns the likeness of a sample's colour to the background's: 1 if equal, 0 from
/// [`MAX_FLOATER_COLOUR_DISTANCE`] on. A sample of the background's colour is indistinguishable
/// from the background.
#[inline]
pub(crate) fn background_likeness(colour: [f32; 3], background: [f32; 3]) -> f32 {
    let squared: f32 = colour.iter().zip(background).map(|(c, b)| (c - b) * (c - b)).sum();
    (1.0 - squared / (MAX_FLOATER_COLOUR_DISTANCE * MAX_FLOATER_COLOUR_DISTANCE)).max(0.0)
}

/// Adds the gradient of the floater loss T·Σ_i w_i·[`background_likeness`]_i with respect to each
/// weight w_i; `factor` is the loss's weight times T. Gradients with respect to the ray's
/// transmittance T and to the colours are left out: the latter would recolour floaters instead of
/// thinning them. The factor T spares opaque surfaces of the background's colour.
#[inline]
fn add_floater_gradients(ray: &ShadedRay<'_>, factor: f32, by_weight: &mut [f32]) {
    for (by_weight, colour) in by_weight.iter_mut().zip(ray.colours()) {
        *by_weight = factor.mul_add(background_likeness(colour, ray.background), *by_weight);
    }
}

/// Adds the gradient of the distortion loss with respect to each weight, times `factor`. The loss
/// Σ_ij w_i·w_j·|t_i - t_j| + ⅓·step·Σ_i w_i² concentrates a ray's weights. Unlike in eq. 15, a
/// sample of a double stride counts as one step long, too.
#[inline]
fn add_distortion_gradients(ray: &ShadedRay<'_>, factor: f32, by_weight: &mut [f32]) {
    let ShadedRay { t, weight, step, .. } = *ray;
    let total: f32 = weight.iter().sum();
    // Large t would cancel in the sums, so t is measured from the weighted mean.
    let mean = weight.iter().zip(t).map(|(w, t)| w * t).sum::<f32>() / total.max(f32::MIN_POSITIVE);
    let (mut before, mut moment) = (0.0, 0.0);
    for ((by_weight, &w), &t) in by_weight.iter_mut().zip(weight).zip(t) {
        let t = t - mean;
        // Σ_j w_j·|t - t_j|: samples before with +, samples behind with -. The ray's moments sum to
        // 0, so those behind sum to -(moment + w·t).
        let spread = t * (2.0 * before + w - total) - (2.0 * moment + w * t);
        *by_weight += 2.0 * factor * (spread + step * w / 3.0);
        before += w;
        moment += w * t;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn exact_gradient(t: &[f32], weight: &[f32], factor: f32, i: usize) -> f64 {
        let weighted_distance: f64 = (0..t.len())
            .map(|j| f64::from(weight[j]) * (f64::from(t[i]) - f64::from(t[j])).abs())
            .sum();
        2.0 * f64::from(factor) * (weighted_distance + 0.003 / 3.0 * f64::from(weight[i]))
    }

    proptest! {
        #[test]
        fn distortion_gradients_equal_f64_sums(
            samples in prop::collection::vec((0.001f32..0.2, 1e-4f32..0.5), 1..40),
            factor in 0.01f32..2.0,
        ) {
            let mut t: Vec<f32> = samples.iter().map(|(gap, _)| *gap).collect();
            (1..t.len()).for_each(|i| t[i] += t[i - 1]);
            let weight: Vec<f32> = samples.iter().map(|(_, w)| *w).collect();
            let ray = ShadedRay {
                t: &t,
                weight: &weight,
                step: 0.003,
                channels: [&[]; 3],
                indices: &[],
                transmittance: 1.0,
                background: [0.0; 3],
            };
            let mut by_weight = vec![0.0; t.len()];
            let distortion = f64::from(factor);
            let regularisers = Regularisers { distortion, ..Regularisers::default() };
            regularisers.add_gradients(&ray, &mut by_weight);
            // Distances are differences of f32 depths: their error is a few parts in 10^7 of the
            // depth.
            let total_weight: f32 = weight.iter().sum();
            let rounding = 4e-7 * f64::from(factor * total_weight * t[t.len() - 1]);
            let exact = |i| exact_gradient(&t, &weight, factor, i);
            let largest = (0..t.len()).map(exact).fold(1e-3, f64::max);
            for i in 0..t.len() {
                let error = (f64::from(by_weight[i]) - exact(i)).abs();
                prop_assert!(error < 1e-5 * largest + rounding, "{i}: {} {}", by_weight[i],
                    exact(i));
            }
        }
    }
}

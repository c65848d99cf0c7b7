//! Regularisers: losses on a ray besides the squared error of its colour. Each has a weight and a
//! function that adds the loss's gradient to the ray's gradients. `torch-field` computes the losses
//! for autograd. The distortion loss is checked in f64 here, the floater loss in `reference.rs`.

use crate::spec::LIKE_BACKGROUND;

/// Weights of what is asked of rays beside their colours; 0 asks for nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Regularisers {
    /// Weight of the distortion loss (Barron et al. 2022, "Mip-NeRF 360", eq. 15), the mean over
    /// all rays, beside the loss that supervision gives.
    pub distortion: f32,
    /// Weight of the floater loss (ours), the mean over all rays: opacity that has the background's
    /// colour.
    pub floater_loss: f32,
}

/// One ray's samples from front to back, and what is seen through them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ShadedRay<'a> {
    /// Where along the ray the samples lie: it rises.
    pub(crate) t: &'a [f32],
    pub(crate) weight: &'a [f32],
    /// Length of a step in t.
    pub(crate) step: f32,
    /// Red, green and blue of many rays' samples, and the places of this ray's among them.
    pub(crate) channels: [&'a [f32]; 3],
    pub(crate) places: &'a [u32],
    /// Light that comes through the whole ray, T.
    pub(crate) transmittance: f32,
    pub(crate) background: [f32; 3],
}

/// Gradients of a ray's loss.
#[derive(Debug)]
pub(crate) struct LossGradients<'a> {
    /// By each sample's weight.
    pub(crate) by_weight: &'a mut [f32],
    /// By the ray's transmittance T, times T.
    pub(crate) behind: f32,
}

impl Regularisers {
    /// Weights for one ray of a step, where bundles of so many rays count `scale` each.
    pub(crate) fn of_ray(&self, scale: f32, bundle: usize) -> Self {
        let of_ray = |weight: f32| weight * scale / bundle as f32;
        Self { distortion: of_ray(self.distortion), floater_loss: of_ray(self.floater_loss) }
    }

    /// Adds to the gradients of a ray's loss, where these are the weights for one ray.
    #[inline]
    pub(crate) fn add_gradients(&self, ray: &ShadedRay<'_>, gradients: &mut LossGradients<'_>) {
        let Self { distortion, floater_loss } = *self;
        let floater = floater_loss * ray.transmittance;
        if floater > 0.0 {
            add_floater_gradients(ray, floater, gradients.by_weight);
        }
        if distortion > 0.0 {
            add_distortion_gradients(ray, distortion, gradients.by_weight);
        }
    }
}

impl ShadedRay<'_> {
    /// The samples' colours.
    #[inline]
    fn colours(&self) -> impl Iterator<Item = [f32; 3]> {
        self.places.iter().map(move |&k| self.channels.map(|channel| channel[k as usize]))
    }
}

/// How much matter passes for the background it lies before: 1 where it has its colour, 0 from
/// [`LIKE_BACKGROUND`] on. Whether it is there no image tells that sees it before the background
/// alone.
#[inline]
pub(crate) fn likeness(colour: [f32; 3], background: [f32; 3]) -> f32 {
    let squared: f32 = colour.iter().zip(background).map(|(c, b)| (c - b) * (c - b)).sum();
    (1.0 - squared / (LIKE_BACKGROUND * LIKE_BACKGROUND)).max(0.0)
}

/// Adds the gradient by each weight w_i of the floater loss T·Σ_i w_i·[`likeness`]_i; `factor` is
/// the loss's weight times T. There is no gradient by the colours, which would make floaters darker
/// instead of thinner, or by the ray's transmittance T. What stops a ray is paint of the
/// background's colour, no floater: it would become thin and darker, and look the same.
#[inline]
fn add_floater_gradients(ray: &ShadedRay<'_>, factor: f32, by_weight: &mut [f32]) {
    for (by_weight, colour) in by_weight.iter_mut().zip(ray.colours()) {
        *by_weight = factor.mul_add(likeness(colour, ray.background), *by_weight);
    }
}

/// Adds the gradient by each weight of the distortion loss times `factor`: of Σ_ij w_i·w_j·|t_i -
/// t_j| + ⅓·step·Σ_i w_i². It draws a ray's weights together.
#[inline]
fn add_distortion_gradients(ray: &ShadedRay<'_>, factor: f32, by_weight: &mut [f32]) {
    let ShadedRay { t, weight, step, .. } = *ray;
    let whole: f32 = weight.iter().sum();
    // Measured from the mean, so that nothing cancels.
    let mean = weight.iter().zip(t).map(|(w, t)| w * t).sum::<f32>() / whole.max(f32::MIN_POSITIVE);
    let (mut before, mut moment) = (0.0, 0.0);
    for ((by_weight, &w), &t) in by_weight.iter_mut().zip(weight).zip(t) {
        let t = t - mean;
        // Σ_j w_j·|t - t_j|: what lies before with +, what lies behind with -; all moments add up
        // to 0.
        let apart = t * (2.0 * before + w - whole) - (2.0 * moment + w * t);
        *by_weight += 2.0 * factor * (apart + step * w / 3.0);
        before += w;
        moment += w * t;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn exact(t: &[f32], weight: &[f32], factor: f32, i: usize) -> f64 {
        let apart: f64 = (0..t.len())
            .map(|j| f64::from(weight[j]) * (f64::from(t[i]) - f64::from(t[j])).abs())
            .sum();
        2.0 * f64::from(factor) * (apart + 0.003 / 3.0 * f64::from(weight[i]))
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
            let ray = ShadedRay {
                t: &t,
                weight: &weight,
                step: 0.003,
                channels: [&[]; 3],
                places: &[],
                transmittance: 1.0,
                background: [0.0; 3],
            };
            let mut by_weight = vec![0.0; t.len()];
            let mut gradients = LossGradients { by_weight: &mut by_weight, behind: 0.0 };
            let regularisers = Regularisers { distortion: factor, ..Regularisers::default() };
            regularisers.add_gradients(&ray, &mut gradients);
            prop_assert_eq!(gradients.behind, 0.0);
            // Distances are differences of f32 numbers: known to a few parts in 10^7 of how far
            // along the ray they lie.
            let whole: f32 = weight.iter().sum();
            let rounding = 4e-7 * f64::from(factor * whole * t[t.len() - 1]);
            let largest = (0..t.len()).map(|i| exact(&t, &weight, factor, i)).fold(1e-3, f64::max);
            for i in 0..t.len() {
                let error = (f64::from(by_weight[i]) - exact(&t, &weight, factor, i)).abs();
                prop_assert!(error < 1e-5 * largest + rounding, "{i}: {} {}", by_weight[i],
                    exact(&t, &weight, factor, i));
            }
        }
    }
}

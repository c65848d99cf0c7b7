use std::ops::Range;

use radiance::{Step, Supervisor};
use tch::{TchError, Tensor};

use crate::error::TorchFieldError;
use crate::ray_tensors::{matrix, to_host};

/// Number of final epochs during which the learning rate decays.
const FALLING_EPOCHS: u64 = 10;

/// Returns the learning rate when a fraction `done` of a training run of `epochs` is over, as in
/// the reference implementation: constant until the last ten epochs, each of which multiplies the
/// rate by the eleventh root of the decay. The final rate is never quite reached. Fewer than twenty
/// epochs pass through the same schedule faster.
pub(crate) fn learning_rate(highest: f64, decay: f64, epochs: u64, done: f64) -> f64 {
    let epochs = epochs.max(2 * FALLING_EPOCHS);
    let epoch = ((done * epochs as f64) as u64).min(epochs - 1);
    let progress =
        (epoch + 1 + FALLING_EPOCHS).saturating_sub(epochs) as f64 / (FALLING_EPOCHS + 1) as f64;
    highest * libm::pow(decay, progress)
}

/// Loss of some of a step's bundles.
pub(crate) struct StepLoss {
    /// Sum of the bundles' losses.
    pub(crate) sum: f64,
    /// Colours of the rays.
    pub(crate) colours: Vec<[f32; 3]>,
    /// Scalar whose gradient is these bundles' part of the gradient of the step's mean loss.
    pub(crate) surrogate: Tensor,
}

/// Computes the loss of the colours (n × 3) of a range of a step's bundles.
pub(crate) fn loss_of_bundles(
    step: Step,
    supervisor: &impl Supervisor,
    range: &Range<usize>,
    colour: &Tensor,
) -> Result<StepLoss, TchError> {
    let colours = to_host(colour)?.as_chunks::<3>().0.to_vec();
    let mut gradients = vec![[0.0f32; 3]; colours.len()];
    let bundles = colours
        .chunks_exact(step.rays_per_bundle)
        .zip(gradients.chunks_exact_mut(step.rays_per_bundle));
    let sum = (step.first_bundle_of(range)..)
        .zip(bundles)
        .map(|(bundle, (colours, gradients))| {
            supervisor.loss_and_gradient(bundle, colours, gradients)
        })
        .sum();
    let scaled: Vec<f32> =
        gradients.as_flattened().iter().map(|g| g / step.bundles as f32).collect();
    let gradients = matrix(&scaled, [colours.len() as i64, 3], colour.device())?;
    let surrogate = colour.f_mul(&gradients)?.f_sum(None::<tch::Kind>)?;
    Ok(StepLoss { sum, colours, surrogate })
}

/// Runs `0..count` in pieces of `size`; after running out of memory, in pieces of half that size,
/// down to `min_size`.
pub(crate) fn run_in_pieces<T>(
    count: usize,
    mut size: usize,
    min_size: usize,
    mut run: impl FnMut(Range<usize>) -> Result<T, TchError>,
) -> Result<Vec<T>, TorchFieldError> {
    let mut pieces = Vec::new();
    let mut next = 0;
    while next < count {
        let range = next..(next + size).min(count);
        match run(range.clone()) {
            Ok(piece) => {
                pieces.push(piece);
                next = range.end;
            }
            Err(error) if size > min_size && nets::is_out_of_memory(&error) => {
                size = size.div_ceil(2).max(min_size);
            }
            Err(error) => return Err(error.into()),
        }
    }
    Ok(pieces)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns CUDA's out-of-memory error for more than three bundles.
    fn run_at_most_three(range: Range<usize>) -> Result<Range<usize>, TchError> {
        if range.len() > 3 {
            Err(TchError::Torch("CUDA out of memory. Tried".to_owned()))
        } else {
            Ok(range)
        }
    }

    /// With memory for three bundles, each bundle is processed exactly once.
    #[test]
    fn pieces_get_smaller_until_they_fit() {
        let pieces = run_in_pieces(17, 17, 1, run_at_most_three).unwrap();
        assert!(pieces.iter().all(|p| p.len() <= 3) && pieces.len() < 10);
        assert_eq!(pieces.into_iter().flatten().collect::<Vec<_>>(), (0..17).collect::<Vec<_>>());
        let always_fails =
            |_| -> Result<(), _> { Err(TchError::Torch("CUDA out of memory".to_owned())) };
        assert!(run_in_pieces(17, 17, 1, always_fails).is_err());
    }

    /// Expected rates are from the reference implementation's log of 20 epochs.
    #[test]
    fn learning_rates_equal_the_reference_implementation() {
        let rate = |epoch: u64| learning_rate(5e-4, 1e-2, 20, (epoch as f64 + 0.5) / 20.0);
        assert!((0..10).all(|e| rate(e) == 5e-4));
        let falling = [
            3.29e-4, 2.16e-4, 1.42e-4, 9.37e-5, 6.16e-5, 4.06e-5, 2.67e-5, 1.76e-5, 1.16e-5,
            7.60e-6,
        ];
        for (e, expected) in (10..).zip(falling) {
            assert!((rate(e) / expected - 1.0).abs() < 5e-3, "{e}: {}", rate(e));
        }
        assert_eq!(learning_rate(5e-4, 1e-2, 20, 1.0), rate(19));
        assert!((0u32..20).all(
            |e| learning_rate(5e-4, 1e-2, 3, (f64::from(e) + 0.5) / 20.0) == rate(u64::from(e))
        ));
    }
}

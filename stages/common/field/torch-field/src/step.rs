use std::ops::Range;

use radiance::{PhaseClock, Ray, RenderedBundles, Supervisor, TrainingState};
use tch::{TchError, Tensor};

use crate::error::TorchFieldError;
use crate::ray_tensors::to_host;

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
    highest * decay.powf(progress)
}

/// One training step of `bundles` bundles of rays. Bundles are numbered through the training.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Step {
    first_bundle: u64,
    first_ray: u64,
    pub(crate) bundles: usize,
    pub(crate) rays_per_bundle: usize,
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

impl Step {
    /// Creates the step that follows those counted in `state`.
    pub(crate) fn new(state: &TrainingState, bundles: usize, rays_per_bundle: usize) -> Self {
        Self { first_bundle: state.bundles, first_ray: state.rays, bundles, rays_per_bundle }
    }

    /// Returns the number of rays of the step.
    pub(crate) fn rays(self) -> usize {
        self.bundles * self.rays_per_bundle
    }

    /// Returns the index, over the training run, of the first ray of a range of the step's bundles.
    pub(crate) fn first_ray_of(self, range: &Range<usize>) -> u64 {
        self.first_ray + (range.start * self.rays_per_bundle) as u64
    }

    /// Samples the rays of a range of the step's bundles.
    pub(crate) fn sample_rays(
        self,
        supervisor: &impl Supervisor,
        range: &Range<usize>,
    ) -> Vec<Ray> {
        let mut rays = vec![Ray::default(); range.len() * self.rays_per_bundle];
        for (i, rays) in rays.chunks_exact_mut(self.rays_per_bundle).enumerate() {
            supervisor.sample_rays(self.first_bundle + (range.start + i) as u64, rays);
        }
        rays
    }

    /// Computes the loss of the colours (n × 3) of a range of the step's bundles.
    pub(crate) fn loss(
        self,
        supervisor: &impl Supervisor,
        range: &Range<usize>,
        colour: &Tensor,
    ) -> Result<StepLoss, TchError> {
        let colours = to_host(colour)?.as_chunks::<3>().0.to_vec();
        let mut gradients = vec![[0.0f32; 3]; colours.len()];
        let chunks = gradients.chunks_exact_mut(self.rays_per_bundle).enumerate();
        let sum = chunks
            .map(|(i, gradients)| {
                let colours = &colours[i * self.rays_per_bundle..][..self.rays_per_bundle];
                let bundle = self.first_bundle + (range.start + i) as u64;
                supervisor.loss_and_gradient(bundle, colours, gradients)
            })
            .sum();
        let scaled: Vec<f32> =
            gradients.as_flattened().iter().map(|g| g / self.bundles as f32).collect();
        let gradients = Tensor::f_from_slice(&scaled)?
            .f_reshape([colours.len() as i64, 3])?
            .f_to_device(colour.device())?;
        let surrogate = colour.f_mul(&gradients)?.f_sum(None::<tch::Kind>)?;
        Ok(StepLoss { sum, colours, surrogate })
    }

    /// Passes the rendered colours of all pieces, in order, to the supervisor.
    pub(crate) fn record_colours(self, supervisor: &mut impl Supervisor, pieces: &[Vec<[f32; 3]>]) {
        let mut first_bundle = self.first_bundle;
        let mut rendered = Vec::with_capacity(pieces.len());
        for colours in pieces {
            rendered.push(RenderedBundles { first_bundle, colours });
            first_bundle += (colours.len() / self.rays_per_bundle) as u64;
        }
        // Nobody reads this clock.
        supervisor.record_colours(&rendered, &PhaseClock::start());
    }

    /// Runs the step's bundles in pieces, whose size is halved after running out of memory.
    pub(crate) fn run_in_pieces<T>(
        self,
        run: impl FnMut(Range<usize>) -> Result<T, TchError>,
    ) -> Result<Vec<T>, TorchFieldError> {
        run_in_pieces(self.bundles, self.bundles, 1, run)
    }
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
        let step = Step::new(&TrainingState::default(), 17, 4);
        let pieces = step.run_in_pieces(run_at_most_three).unwrap();
        assert!(pieces.iter().all(|p| p.len() <= 3) && pieces.len() < 10);
        assert_eq!(pieces.into_iter().flatten().collect::<Vec<_>>(), (0..17).collect::<Vec<_>>());
        let always_fails =
            |_| -> Result<(), _> { Err(TchError::Torch("CUDA out of memory".to_owned())) };
        assert!(step.run_in_pieces(always_fails).is_err());
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

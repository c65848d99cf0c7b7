use std::ops::Range;

use radiance::{Ray, Supervisor, Tally};
use tch::{TchError, Tensor};

use crate::error::TorchFieldError;
use crate::transfer::host;

/// A step of a training: so many bundles of rays, counted on from what was cast before.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Step {
    first_bundle: u64,
    first_ray: u64,
    pub(crate) bundles: usize,
    /// Rays in a bundle.
    pub(crate) bundle: usize,
}

/// What a colour image adds to a step.
pub(crate) struct Judged {
    /// Sum over its bundles.
    pub(crate) loss: f64,
    pub(crate) colours: Vec<[f32; 3]>,
    /// A number whose gradient is that of the step's mean loss.
    pub(crate) towards: Tensor,
}

impl Step {
    pub(crate) fn new(tally: &Tally, bundles: usize, bundle: usize) -> Self {
        Self { first_bundle: tally.bundles, first_ray: tally.rays, bundles, bundle }
    }

    /// Number of the first ray of some of its bundles, over the whole training.
    pub(crate) fn first_ray(self, range: &Range<usize>) -> u64 {
        self.first_ray + (range.start * self.bundle) as u64
    }

    /// The rays of some of its bundles.
    pub(crate) fn sample_rays(
        self,
        supervision: &impl Supervisor,
        range: &Range<usize>,
    ) -> Vec<Ray> {
        let mut rays = vec![Ray::default(); range.len() * self.bundle];
        for (g, rays) in range.clone().zip(rays.chunks_exact_mut(self.bundle)) {
            supervision.sample_rays(self.first_bundle + g as u64, rays);
        }
        rays
    }

    /// Judges their colours (n × 3).
    pub(crate) fn loss_and_gradient(
        self,
        supervision: &impl Supervisor,
        range: &Range<usize>,
        colour: &Tensor,
    ) -> Result<Judged, TchError> {
        let colours = host(colour)?.as_chunks::<3>().0.to_vec();
        let mut gradients = vec![[0.0f32; 3]; colours.len()];
        let pairs = colours.chunks_exact(self.bundle).zip(gradients.chunks_exact_mut(self.bundle));
        let losses = range.clone().zip(pairs).map(|(g, (colours, gradients))| {
            supervision.loss_and_gradient(self.first_bundle + g as u64, colours, gradients)
        });
        let loss = losses.sum();
        let scaled: Vec<f32> =
            gradients.as_flattened().iter().map(|g| g / self.bundles as f32).collect();
        let gradients = Tensor::f_from_slice(&scaled)?
            .f_reshape([colours.len() as i64, 3])?
            .f_to_device(colour.device())?;
        Ok(Judged { loss, colours, towards: colour.f_mul(&gradients)?.f_sum(None::<tch::Kind>)? })
    }

    /// Lets supervision keep what was seen.
    pub(crate) fn remember<'a>(
        self,
        supervision: &mut impl Supervisor,
        colours: impl Iterator<Item = &'a [[f32; 3]]>,
    ) {
        let bundles = colours.flat_map(|c| c.chunks_exact(self.bundle));
        (self.first_bundle..)
            .zip(bundles)
            .for_each(|(bundle, colours)| supervision.remember(bundle, colours));
    }

    /// Goes through its bundles in as few pieces as memory allows: where there isn't enough, the
    /// next ones are smaller.
    pub(crate) fn in_pieces<T>(
        self,
        mut run: impl FnMut(Range<usize>) -> Result<T, TchError>,
    ) -> Result<Vec<T>, TorchFieldError> {
        let (mut pieces, mut next, mut size) = (Vec::new(), 0, self.bundles);
        while next < self.bundles {
            let range = next..(next + size).min(self.bundles);
            match run(range.clone()) {
                Ok(piece) => {
                    pieces.push(piece);
                    next = range.end;
                }
                Err(error) if size > 1 && nets::is_out_of_memory(&error) => size = size.div_ceil(2),
                Err(error) => return Err(error.into()),
            }
        }
        Ok(pieces)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn three_at_most(range: Range<usize>) -> Result<Range<usize>, TchError> {
        if range.len() > 3 {
            Err(TchError::Torch("CUDA out of memory. Tried".to_owned()))
        } else {
            Ok(range)
        }
    }

    /// Memory that holds three bundles at most: nothing is lost, nothing done twice.
    #[test]
    fn pieces_get_smaller_until_they_fit() {
        let step = Step::new(&Tally::default(), 17, 4);
        let pieces = step.in_pieces(three_at_most).unwrap();
        assert!(pieces.iter().all(|p| p.len() <= 3) && pieces.len() < 10);
        assert_eq!(pieces.into_iter().flatten().collect::<Vec<_>>(), (0..17).collect::<Vec<_>>());
        let never = |_| -> Result<(), _> { Err(TchError::Torch("CUDA out of memory".to_owned())) };
        assert!(step.in_pieces(never).is_err());
    }
}

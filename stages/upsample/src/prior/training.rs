use std::path::Path;

use nets::{Adam, Weights, WeightsError};
use numerics::CounterRng;
use pixels::{Filter, Image, Rgba8, psnr_of, resize_pillow};
use rayon::prelude::*;
use tch::{Kind, TchError, Tensor, no_grad};

use super::{Prior, WIDTH, enlarge_bicubic, leaves};
use crate::network::Network as _;

/// Number of residual blocks (design note 051).
const BLOCKS: usize = 6;
/// Side of an image in HR pixels.
const IMAGE_SIDE: usize = 256;
/// Side of a patch in LR pixels.
const PATCH_SIDE: usize = 32;
/// Number of patches per step.
const BATCH: u64 = 16;
/// Number of shards of a step: fixed, so that sums have one order at any thread count.
const SHARDS: u64 = 4;
/// One image in this many is left out of training.
const HOLD_OUT_EVERY: usize = 64;
/// Highest learning rate; chosen by hand.
const LEARNING_RATE: f64 = 5e-4;
/// Number of steps over which the learning rate rises; chosen by hand.
const WARM_UP_STEPS: u64 = 200;
/// Fraction of the steps that minimise the absolute error; the last ones minimise the squared
/// error, which PSNR counts.
const ABSOLUTE_FRACTION: f64 = 0.6;
/// Factor of the squared error, which makes both losses similar in size.
const SQUARED_FACTOR: f64 = 10.0;
/// One image in this many is shrunk by averaging, the others by Lanczos' filter.
const AVERAGED_EVERY: u64 = 4;
/// Minimum contrast of a patch; flatter ones are drawn again, since they teach nothing. Chosen by
/// hand.
const MIN_CONTRAST: f32 = 0.1;
/// Maximum number of times that a patch is drawn again; chosen by hand.
const MAX_REDRAWS: usize = 8;
/// Streams of random numbers.
const WEIGHTS_STREAM: u64 = 341;
const PATCHES: u64 = 342;

/// Error of training.
#[derive(Debug, thiserror::Error)]
pub(super) enum TrainingError {
    /// libtorch failed.
    #[error(transparent)]
    Torch(#[from] TchError),
    /// A checkpoint or file of weights can't be read or written.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// A loss or gradient isn't finite.
    #[error("training diverged at step {step}: its gradients aren't finite")]
    NotFinite {
        /// Number of the step.
        step: u64,
    },
}

/// Image at both sizes.
pub(super) struct ImagePair {
    lr: Image,
    hr: Image,
}

impl ImagePair {
    /// Draws the `number`-th image.
    fn draw(seed: u64, number: u64, scale: usize) -> Self {
        let hr = leaves::draw(seed, number, IMAGE_SIDE);
        let filter =
            if number.is_multiple_of(AVERAGED_EVERY) { Filter::Box } else { Filter::Lanczos };
        let lr = resize_pillow(&hr, IMAGE_SIDE / scale, IMAGE_SIDE / scale, filter);
        let opaque = |image: &Rgba8| Image::premultiplied(image).over(0.0);
        Self { lr: opaque(&lr), hr: opaque(&hr) }
    }
}

/// Images to train on, and images that are left out.
pub(super) struct TrainingImages {
    training: Vec<ImagePair>,
    left_out: Vec<ImagePair>,
}

impl TrainingImages {
    /// Draws images, in parallel. Calls `check` before each image and stops at its first error.
    pub(super) fn draw<E: Send>(
        seed: u64,
        count: u64,
        scale: usize,
        check: impl Fn() -> Result<(), E> + Sync,
    ) -> Result<Self, E> {
        let pairs = (0..count).into_par_iter().map(|number| {
            check()?;
            Ok(ImagePair::draw(seed, number, scale))
        });
        let pairs: Vec<ImagePair> = pairs.collect::<Result<_, E>>()?;
        let mut images = Self { training: Vec::new(), left_out: Vec::new() };
        for (i, pair) in pairs.into_iter().enumerate() {
            let is_left_out = i % HOLD_OUT_EVERY == 1;
            if is_left_out { &mut images.left_out } else { &mut images.training }.push(pair);
        }
        Ok(images)
    }
}

/// Trains a [`Prior`] with Adam.
pub(super) struct PriorTrainer {
    tensors: Vec<(String, Tensor)>,
    shards: Vec<Shard>,
    adam: Adam,
    steps: u64,
    scale: usize,
    seed: u64,
}

/// Network and parameters of a thread; the tensors are shared.
struct Shard {
    network: Prior,
    parameters: Vec<Tensor>,
}

impl PriorTrainer {
    /// Creates a trainer of an untrained network for `steps` steps.
    pub(super) fn new(scale: usize, steps: u64, seed: u64) -> Result<Self, TrainingError> {
        let tensors = initial_tensors(scale as i64, seed);
        let weights = Weights::share(&tensors);
        let shards = (0..SHARDS).map(|_| {
            let parameters = tensors.iter().map(|(_, tensor)| tensor.shallow_clone()).collect();
            Ok(Shard { network: Prior::read(&weights)?, parameters })
        });
        let shards = shards.collect::<Result<_, WeightsError>>()?;
        let adam = Adam::new(tensors.iter().map(|(_, tensor)| tensor.shallow_clone()))?;
        Ok(Self { tensors, shards, adam, steps, scale, seed })
    }

    /// Returns the number of steps taken.
    pub(super) fn steps(&self) -> u64 {
        self.adam.steps_taken()
    }

    /// Takes a step. Returns the mean squared error of its patches, or `None` after the last step.
    pub(super) fn step(&mut self, images: &TrainingImages) -> Result<Option<f64>, TrainingError> {
        let (step, steps) = (self.steps(), self.steps);
        if step >= steps {
            return Ok(None);
        }
        let is_absolute = (step as f64) < ABSOLUTE_FRACTION * steps as f64;
        let (scale, seed) = (self.scale, self.seed);
        let shards = self.shards.par_iter_mut().enumerate().map(|(i, shard)| {
            let first = step * BATCH + i as u64 * (BATCH / SHARDS);
            let patches = (first..first + BATCH / SHARDS)
                .map(|number| Patch::draw(seed, number, &images.training, scale));
            shard.gradients(&Patches::new(patches, scale), is_absolute)
        });
        let shards = shards.collect::<Result<Vec<_>, TchError>>()?;
        let mut error = 0.0;
        let mut gradients: Vec<Tensor> = Vec::new();
        for (squared, shard) in shards {
            error += squared / SHARDS as f64;
            if gradients.is_empty() {
                gradients = shard;
            } else {
                nets::add_gradients(&mut gradients, &shard)?;
            }
        }
        if !error.is_finite() || !nets::all_finite(&gradients)? {
            return Err(TrainingError::NotFinite { step });
        }
        let rate = nets::cosine_rate(LEARNING_RATE, step, steps, WARM_UP_STEPS);
        let parameters = self.tensors.iter().map(|(_, tensor)| tensor.shallow_clone());
        self.adam.step(parameters, &gradients, rate)?;
        Ok(Some(error))
    }

    /// Returns the mean PSNR of the images that were left out, enlarged by the bicubic filter and
    /// by the network.
    pub(super) fn score(&self, images: &TrainingImages) -> Result<[f64; 2], TrainingError> {
        let mut sums = [0.0; 2];
        for ImagePair { lr, hr } in &images.left_out {
            let (lr, hr) = (nets::tensor_of(lr)?, nets::tensor_of(hr)?);
            let enlarged = no_grad(|| self.shards[0].network.enlarge(&lr, [0, 0]))?;
            let bicubic = enlarge_bicubic(&lr, self.scale as i64)?;
            for (sum, image) in sums.iter_mut().zip([bicubic, enlarged]) {
                let error = image.f_clamp(0.0, 1.0)?.f_sub(&hr)?.f_square()?;
                *sum += psnr_of(error.f_mean(Kind::Double)?.f_double_value(&[])?);
            }
        }
        Ok(sums.map(|sum| sum / images.left_out.len().max(1) as f64))
    }

    /// Writes the network in half precision.
    pub(super) fn write(&self, path: &Path) -> Result<(), TrainingError> {
        let halves = self
            .tensors
            .iter()
            .map(|(name, tensor)| Ok((name.clone(), tensor.f_detach()?.f_to_kind(Kind::Half)?)));
        Ok(nets::write(path, &halves.collect::<Result<Vec<_>, TchError>>()?)?)
    }

    /// Writes a checkpoint, from which the training resumes. The caller makes the write atomic.
    pub(super) fn write_checkpoint(&self, path: &Path) -> Result<(), TrainingError> {
        let tensors =
            self.tensors.iter().map(|(name, tensor)| (name.clone(), tensor.shallow_clone()));
        Ok(self.adam.write_checkpoint(path, tensors.collect(), &[])?)
    }

    /// Resumes from a checkpoint of a training with the same parameters.
    pub(super) fn resume(&mut self, path: &Path) -> Result<(), TrainingError> {
        (self.adam, []) = Adam::resume(path, &self.tensors)?;
        Ok(())
    }
}

/// Returns the tensors of an untrained network, which adds nothing to the bicubic enlargement: each
/// block's second layer and the last layer are 0.
fn initial_tensors(scale: i64, seed: u64) -> Vec<(String, Tensor)> {
    let mut layers = vec![("first".to_owned(), 3, WIDTH, true)];
    for i in 0..BLOCKS {
        layers.push((format!("block.{i}.0"), WIDTH, WIDTH, true));
        layers.push((format!("block.{i}.1"), WIDTH, WIDTH, false));
    }
    layers.push(("last".to_owned(), WIDTH, 3 * scale * scale, false));
    let mut tensors = Vec::new();
    for (number, (name, inputs, outputs, is_random)) in layers.into_iter().enumerate() {
        let mut rng = CounterRng::new(seed, WEIGHTS_STREAM, number as u64);
        // He et al. 2015.
        let deviation = if is_random { (2.0 / (9 * inputs) as f64).sqrt() } else { 0.0 };
        let values: Vec<f32> =
            (0..outputs * inputs * 9).map(|_| (deviation * rng.normal()) as f32).collect();
        let kernel = Tensor::from_slice(&values).reshape([outputs, inputs, 3, 3]);
        let bias = Tensor::zeros([outputs], (Kind::Float, tch::Device::Cpu));
        tensors.push((format!("{name}.weight"), kernel.set_requires_grad(true)));
        tensors.push((format!("{name}.bias"), bias.set_requires_grad(true)));
    }
    tensors
}

impl Shard {
    /// Returns the mean squared error of patches, and the gradients of the loss.
    fn gradients(
        &mut self,
        patches: &Patches,
        is_absolute: bool,
    ) -> Result<(f64, Vec<Tensor>), TchError> {
        let (lr, hr) = patches.tensors()?;
        let difference = self.network.forward(&lr)?.f_sub(&hr)?;
        let squared = difference.f_square()?.f_mean(Kind::Float)?;
        let loss = if is_absolute {
            difference.f_abs()?.f_mean(Kind::Float)?
        } else {
            squared.f_mul_scalar(SQUARED_FACTOR)?
        };
        let loss = loss.f_div_scalar(SHARDS as i64)?;
        let gradients = Tensor::f_run_backward(&[&loss], &self.parameters, false, false)?;
        Ok((squared.f_detach()?.f_double_value(&[])?, gradients))
    }
}

/// Colours of patches at both sizes: patch by patch, channel by channel, row by row.
struct Patches {
    lr: Vec<f32>,
    hr: Vec<f32>,
    scale: usize,
}

impl Patches {
    fn new<'a>(patches: impl Iterator<Item = Patch<'a>>, scale: usize) -> Self {
        let mut all = Self { lr: Vec::new(), hr: Vec::new(), scale };
        for patch in patches {
            patch.append(&patch.pair.lr, 1, &mut all.lr);
            patch.append(&patch.pair.hr, scale, &mut all.hr);
        }
        all
    }

    fn tensors(&self) -> Result<(Tensor, Tensor), TchError> {
        let tensor = |samples: &[f32], side: usize| {
            Tensor::f_from_slice(samples)?.f_reshape([-1, 3, side as i64, side as i64])
        };
        Ok((tensor(&self.lr, PATCH_SIDE)?, tensor(&self.hr, PATCH_SIDE * self.scale)?))
    }
}

/// Patch of an image, mirrored or transposed, with other colours.
struct Patch<'a> {
    pair: &'a ImagePair,
    /// First column and row in LR pixels.
    corner: [usize; 2],
    /// True for the axes that are mirrored.
    is_mirrored: [bool; 2],
    is_transposed: bool,
    /// Permutation of the colour channels.
    order: [usize; 3],
    /// Factor on colours; negative for a negative image.
    gain: f32,
    offset: f32,
}

impl<'a> Patch<'a> {
    /// Draws the `number`-th patch of the training run.
    fn draw(seed: u64, number: u64, images: &'a [ImagePair], scale: usize) -> Self {
        let mut rng = CounterRng::new(seed, PATCHES, number);
        let positions = (IMAGE_SIDE / scale - PATCH_SIDE + 1) as u64;
        let mut draw = || {
            let pair = &images[rng.below(images.len() as u64) as usize];
            (pair, [rng.below(positions) as usize, rng.below(positions) as usize])
        };
        let (mut pair, mut corner) = draw();
        for _ in 0..MAX_REDRAWS {
            if contrast(&pair.lr, corner) >= MIN_CONTRAST {
                break;
            }
            (pair, corner) = draw();
        }
        let mut order = [0, 1, 2];
        for i in 1..3 {
            order.swap(i, rng.below(i as u64 + 1) as usize);
        }
        let gain = 0.6 + 0.4 * rng.uniform();
        let offset = (1.0 - gain) * rng.uniform();
        let is_negative = rng.below(3) == 0;
        Self {
            pair,
            corner,
            is_mirrored: [rng.below(2) == 1, rng.below(2) == 1],
            is_transposed: rng.below(2) == 1,
            order,
            gain: if is_negative { -gain } else { gain },
            offset: if is_negative { gain + offset } else { offset },
        }
    }

    /// Appends the patch of the image that is `scale` times as large as the LR image.
    fn append(&self, image: &Image, scale: usize, samples: &mut Vec<f32>) {
        let side = PATCH_SIDE * scale;
        let [left, top] = self.corner.map(|start| start * scale);
        for c in self.order {
            for (y, x) in (0..side).flat_map(|y| (0..side).map(move |x| (y, x))) {
                let (x, y) = if self.is_transposed { (y, x) } else { (x, y) };
                let x = if self.is_mirrored[0] { side - 1 - x } else { x };
                let y = if self.is_mirrored[1] { side - 1 - y } else { y };
                let sample = image.data[((top + y) * image.width + left + x) * 3 + c];
                samples.push(self.gain * sample + self.offset);
            }
        }
    }
}

/// Returns the standard deviation of the green channel in a patch of an LR image.
fn contrast(lr: &Image, [left, top]: [usize; 2]) -> f32 {
    let (mut sum, mut squares) = (0.0, 0.0);
    for (y, x) in (0..PATCH_SIDE).flat_map(|y| (0..PATCH_SIDE).map(move |x| (y, x))) {
        let sample = lr.data[((top + y) * lr.width + left + x) * 3 + 1];
        sum += sample;
        squares += sample * sample;
    }
    let count = (PATCH_SIDE * PATCH_SIDE) as f32;
    (squares / count - (sum / count).powi(2)).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use super::*;

    fn images() -> TrainingImages {
        TrainingImages::draw(7, 6, 4, || Ok::<(), Infallible>(())).unwrap()
    }

    /// Trains until `last` of four steps, from a checkpoint if one is given.
    fn trained(last: u64, checkpoint: Option<&Path>) -> PriorTrainer {
        nets::deterministic();
        let mut trainer = PriorTrainer::new(4, 4, 7).unwrap();
        if let Some(path) = checkpoint {
            trainer.resume(path).unwrap();
        }
        let images = images();
        while trainer.steps() < last {
            trainer.step(&images).unwrap();
        }
        trainer
    }

    #[test]
    fn a_resumed_training_gives_the_same_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name| folder.path().join(name);
        trained(4, None).write(&path("whole")).unwrap();
        trained(2, None).write_checkpoint(&path("checkpoint")).unwrap();
        trained(4, Some(&path("checkpoint"))).write(&path("resumed")).unwrap();
        let bytes = |name| std::fs::read(path(name)).unwrap();
        assert_eq!(bytes("whole"), bytes("resumed"));
        trained(3, None).write(&path("shorter")).unwrap();
        assert_ne!(bytes("whole"), bytes("shorter"));
    }

    /// Before the first step, the network is the bicubic filter.
    #[test]
    fn an_untrained_network_adds_nothing() {
        let [bicubic, enlarged] = trained(0, None).score(&images()).unwrap();
        assert!((bicubic - enlarged).abs() < 1e-3, "{bicubic} and {enlarged} dB");
    }

    /// LR and HR patches display the same part of an image in the same colours.
    #[test]
    fn patches_of_both_sizes_match() {
        let images = images();
        for number in 0..20 {
            let patch = Patch::draw(1, number, &images.training, 4);
            let (mut lr, mut hr) = (Vec::new(), Vec::new());
            patch.append(&patch.pair.lr, 1, &mut lr);
            patch.append(&patch.pair.hr, 4, &mut hr);
            let (mut error, mut shifted) = (0.0, 0.0);
            for c in 0..3 {
                for y in 1..PATCH_SIDE - 1 {
                    for x in 1..PATCH_SIDE - 1 {
                        let mean = |left: usize| {
                            let rows = 4 * y..4 * y + 4;
                            let samples = rows.flat_map(|row| (0..4).map(move |i| (row, left + i)));
                            let side = 4 * PATCH_SIDE;
                            samples.map(|(y, x)| hr[(c * side + y) * side + x]).sum::<f32>() / 16.0
                        };
                        let sample = lr[(c * PATCH_SIDE + y) * PATCH_SIDE + x];
                        assert!((0.0..=1.0).contains(&sample), "{sample}");
                        error += (sample - mean(4 * x)).powi(2);
                        shifted += (sample - mean(4 * x + 2)).powi(2);
                    }
                }
            }
            assert!(error < 0.6 * shifted || shifted < 0.1, "{number}: {error} and {shifted}");
        }
    }
}

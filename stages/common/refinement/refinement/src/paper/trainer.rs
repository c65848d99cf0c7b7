use std::path::Path;

use crate::{KnownView, RefinementError, Training, TrainingOptions};
use nets::Adam;
use numerics::CounterRng;
use pixels::Image;
use tch::{Kind, TchError, Tensor};

use super::loss::PerceptualLoss;
use super::network::{PATCH_MULTIPLE, PaperRefiner, patch_tensor};
use super::patches::PATCH_PIXELS;
use super::perspective::Perspective;

/// Trains a [`PaperRefiner`] on references and their rendered views. A patch is cut from both after
/// a warp by one of 200 random perspectives. Its reference patches come from a window of fixed size
/// around the patch in the unwarped reference. The reported loss is the mean absolute error of
/// colours in -1..1. As published, each of 46,875 steps has 32 patches of 64×64 pixels, each patch
/// has 8 reference patches, and the learning rate is 5e-4.
pub struct PaperTrainer {
    network: PaperRefiner,
    options: TrainingOptions,
    perceptual: Option<PerceptualLoss>,
    adam: Adam,
}

/// Number of perspectives per image, including the identity; source not recorded.
const PERSPECTIVES_PER_IMAGE: u64 = 200;
/// Maximum offset in pixels of a reference patch along each axis; source not recorded.
const MAX_REFERENCE_OFFSET_PIXELS: usize = 64;
/// Streams of random numbers.
const WARPS: u64 = 321;
const PATCHES: u64 = 322;

impl PaperTrainer {
    /// Creates a trainer of `network`.
    pub fn new(
        network: PaperRefiner,
        options: TrainingOptions,
        perceptual: Option<PerceptualLoss>,
    ) -> Result<Self, RefinementError> {
        let adam = Adam::new(network.parameters())?;
        Ok(Self { network, options, perceptual, adam })
    }

    /// Fails if the network can't halve patches three times, if a batch is too small to be
    /// normalised, or if an example is smaller than a patch, in training or in
    /// [`PaperRefiner::refine`].
    pub fn check(options: &TrainingOptions, examples: &[KnownView]) -> Result<(), RefinementError> {
        let size = options.patch_size;
        if size == 0 || !size.is_multiple_of(PATCH_MULTIPLE) {
            return Err(RefinementError::Unusable(format!(
                "a patch size of {size} pixels is not a multiple of {PATCH_MULTIPLE}"
            )));
        }
        // The variance of a single value isn't defined.
        if options.batch_size * (size / PATCH_MULTIPLE).pow(2) < 2 {
            return Err(RefinementError::Unusable(format!(
                "a batch of one patch of {size}×{size} pixels has a single value per channel, \
                which batch normalisation does not allow; raise batch_size or patch_size"
            )));
        }
        let size = size.max(PATCH_PIXELS);
        for KnownView { rendered, truth } in examples {
            if truth.width < size || truth.height < size {
                let reason = format!("smaller than a patch of {size}×{size} pixels");
                return Err(RefinementError::view(&rendered.camera.name, reason));
            }
        }
        Ok(())
    }

    /// Returns the network in its current state.
    pub fn network(&self) -> &PaperRefiner {
        &self.network
    }
}

impl Training for PaperTrainer {
    fn steps(&self) -> u64 {
        self.adam.steps_taken()
    }

    fn step(&mut self, examples: &[KnownView]) -> Result<Option<f64>, RefinementError> {
        let TrainingOptions { steps, batch_size, patch_size, references, learning_rate, .. } =
            self.options;
        if self.steps() >= steps {
            return Ok(None);
        }
        let mut batch = Batch::default();
        for i in 0..batch_size as u64 {
            batch.add_patch(self.steps() * batch_size as u64 + i, &self.options, examples);
        }
        let tensor =
            |samples: &[f32], patches| patch_tensor(samples, patches, patch_size)?.f_contiguous();
        let rendered = tensor(&batch.rendered, batch_size)?;
        let truth = tensor(&batch.truth, batch_size)?;
        let references = tensor(&batch.references, batch_size * references)?;
        let redrawn = self.network.forward(&rendered, &references, true)?;
        let (loss, error) = loss(&redrawn, &truth, self.perceptual.as_ref())?;
        let parameters: Vec<Tensor> = self.network.parameters().collect();
        let gradients = Tensor::f_run_backward(&[&loss], &parameters, false, false)?;
        if !error.is_finite() || !nets::all_finite(&gradients)? {
            return Err(RefinementError::NotFinite { step: self.steps() });
        }
        self.adam.step(self.network.parameters(), &gradients, learning_rate)?;
        Ok(Some(error))
    }

    fn write_checkpoint(&self, path: &Path) -> Result<(), RefinementError> {
        Ok(self.adam.write_checkpoint(path, self.network.named_tensors(), &[])?)
    }

    fn resume(&mut self, path: &Path) -> Result<(), RefinementError> {
        (self.adam, []) = Adam::resume(path, &self.network.named_tensors())?;
        Ok(())
    }
}

/// Computes the loss of patches in -1..1: L1, plus the perceptual loss if enabled. Returns the loss
/// and L1 alone.
pub(crate) fn loss(
    redrawn: &Tensor,
    truth: &Tensor,
    perceptual: Option<&PerceptualLoss>,
) -> Result<(Tensor, f64), TchError> {
    let l1 = redrawn.f_sub(truth)?.f_abs()?.f_mean(Kind::Float)?;
    let error = l1.f_double_value(&[])?;
    let loss = match perceptual {
        Some(perceptual) => perceptual.distance(redrawn, truth)?.f_add(&l1)?,
        None => l1,
    };
    Ok((loss, error))
}

/// Colours of a batch's patches in -1..1: as rendered, ground truth, and reference patches.
#[derive(Default)]
struct Batch {
    rendered: Vec<f32>,
    truth: Vec<f32>,
    references: Vec<f32>,
}

impl Batch {
    /// Draws the `number`-th patch of the training run, with its reference patches.
    fn add_patch(&mut self, number: u64, options: &TrainingOptions, examples: &[KnownView]) {
        let mut rng = CounterRng::new(options.seed, PATCHES, number);
        let index = rng.below(examples.len() as u64);
        let KnownView { rendered, truth } = &examples[index as usize];
        let (width, height) = (truth.width, truth.height);
        let identity = Perspective::identity(width, height);
        let perspective = rng.below(PERSPECTIVES_PER_IMAGE);
        // The generator depends only on the perspective's number, so an image always has the same
        // 200.
        let number = index * PERSPECTIVES_PER_IMAGE + perspective;
        let warp = if perspective == 0 {
            identity
        } else {
            Perspective::draw(width, height, &mut CounterRng::new(options.seed, WARPS, number))
        };
        let size = options.patch_size;
        let [left, top, right, bottom] = warp.filled;
        let (right, bottom) = (right.saturating_sub(size), bottom.saturating_sub(size));
        // A patch that is larger than the warped content also covers black pixels around it.
        let (x, y) = (
            draw_between(left.min(right), right, &mut rng),
            draw_between(top.min(bottom), bottom, &mut rng),
        );
        append_patch(&rendered.view, warp, (x, y), size, &mut self.rendered);
        append_patch(truth, warp, (x, y), size, &mut self.truth);
        let (right, bottom) = (width.saturating_sub(size), height.saturating_sub(size));
        for _ in 0..options.references {
            let corner = (draw_near(x, right, &mut rng), draw_near(y, bottom, &mut rng));
            append_patch(truth, identity, corner, size, &mut self.references);
        }
    }
}

/// Warps an image and appends its patch with corner (x, y), row by row, in -1..1.
fn append_patch(
    image: &Image,
    warp: Perspective,
    (x, y): (usize, usize),
    size: usize,
    samples: &mut Vec<f32>,
) {
    for row in y..y + size {
        for column in x..x + size {
            samples.extend(warp.colour(image, column, row).map(|v| 2.0 * v - 1.0));
        }
    }
}

/// Draws an integer from `low` to `high`, both included; `low` is at most `high`.
fn draw_between(low: usize, high: usize, rng: &mut CounterRng) -> usize {
    low + rng.below((high - low + 1) as u64) as usize
}

/// Draws the start of a reference patch near `start`, at most `last`.
fn draw_near(start: usize, last: usize, rng: &mut CounterRng) -> usize {
    let low = start.saturating_sub(MAX_REFERENCE_OFFSET_PIXELS).min(last);
    draw_between(low, (start + MAX_REFERENCE_OFFSET_PIXELS).min(last), rng)
}

#[cfg(test)]
mod tests {
    use crate::Rendered;
    use scene::{Camera, Intrinsics};

    use super::*;

    /// Returns a striped example whose render has less contrast.
    fn example() -> KnownView {
        let level = |i: usize| if (i % 48 / 6).is_multiple_of(2) { 0.2f32 } else { 0.8 };
        let view = (0..48 * 40)
            .flat_map(|i| [0.5 * level(i) + 0.25; 3].into_iter().chain([1.0]))
            .collect();
        let truth = (0..48 * 40).flat_map(|i| [level(i); 3]).collect();
        let camera = Camera {
            name: "stripes".into(),
            intrinsics: Intrinsics {
                width: 48,
                height: 40,
                fx: 48.0,
                fy: 48.0,
                cx: 24.0,
                cy: 20.0,
                distortion: Default::default(),
            },
            camera_to_world: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0]],
        };
        let view = Image::new(48, 40, 4, view);
        let rendered =
            Rendered { camera, view, depth: vec![2.0; 48 * 40], opacity: vec![1.0; 48 * 40] };
        KnownView { rendered, truth: Image::new(48, 40, 3, truth) }
    }

    const OPTIONS: TrainingOptions = TrainingOptions {
        steps: 60,
        batch_size: 4,
        patch_size: 16,
        references: 2,
        learning_rate: 3e-3,
        seed: 5,
    };

    #[test]
    fn training_reduces_the_error_and_resumes_exactly() {
        nets::deterministic();
        let examples = [example()];
        let start = || PaperTrainer::new(PaperRefiner::new(4, 2).unwrap(), OPTIONS, None).unwrap();
        let mut trainer = start();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        let mut errors = Vec::new();
        while let Some(error) = trainer.step(&examples).unwrap() {
            errors.push(error);
            if trainer.steps() == 30 {
                trainer.write_checkpoint(&path).unwrap();
            }
        }
        let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
        assert!(mean(&errors[50..]) < 0.6 * mean(&errors[..5]), "{errors:?}");
        let mut resumed = start();
        resumed.resume(&path).unwrap();
        while resumed.step(&examples).unwrap().is_some() {}
        let is_equal = trainer
            .network()
            .named_tensors()
            .iter()
            .zip(resumed.network().named_tensors())
            .all(|((_, a), (_, b))| *a == b);
        assert!(is_equal, "a resumed training must end with equal weights");
    }

    #[test]
    fn patches_must_fit() {
        let error = |batch_size, patch_size| {
            let options = TrainingOptions { batch_size, patch_size, ..OPTIONS };
            PaperTrainer::check(&options, &[example()]).unwrap_err().to_string()
        };
        assert!(error(4, 72).contains("72×72") && error(4, 20).contains("multiple of 8"));
        assert!(error(1, 8).contains("single value"));
        // Scoring the trained network needs views of 64×64 pixels, whatever the patches are.
        assert!(error(2, 8).contains("64×64") && error(1, 16).contains("64×64"));
        PaperTrainer::check(&OPTIONS, &[]).unwrap();
    }
}

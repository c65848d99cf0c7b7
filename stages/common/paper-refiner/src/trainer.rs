use std::path::Path;

use counter_rng::CounterRng;
use nets::Adam;
use refinement::{KnownView, RefinementError, Training};
use tch::{Kind, TchError, Tensor};

use crate::loss::PerceptualLoss;
use crate::network::{COLOURS, PATCH_MULTIPLE, PaperRefiner};
use crate::perspective::Perspective;

/// How to train a [`PaperRefiner`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaperTraining {
    /// Steps in all; 46,875 are published.
    pub steps: u64,
    /// Patches in a step; 32 are published.
    pub batch: usize,
    /// Pixels along a patch's side, a multiple of 8; 64 are published.
    pub patch: usize,
    /// Reference patches that each gets; 8 are published.
    pub references: usize,
    /// Learning rate; 5e-4 is published.
    pub rate: f64,
    /// Seed of what is drawn.
    pub seed: u64,
}

/// Trains a [`PaperRefiner`] on rendered views of references beside the references themselves: a
/// patch of both, warped by one of 200 random perspectives, with reference patches that lie within
/// a fixed window around it in the image that isn't warped. Its error is the mean absolute one, of
/// -1..1.
pub struct PaperTrainer {
    network: PaperRefiner,
    options: PaperTraining,
    perceptual: Option<PerceptualLoss>,
    adam: Adam,
}

/// Perspectives of an image, the one that changes nothing among them.
const PERSPECTIVES_PER_IMAGE: u64 = 200;
/// Pixels that a reference patch lies away at most.
const REFERENCE_REACH: usize = 64;
/// Purposes of draws.
const WARPS: u64 = 321;
const PATCHES: u64 = 322;

impl PaperTrainer {
    /// Starts from a network.
    pub fn new(
        network: PaperRefiner,
        options: PaperTraining,
        perceptual: Option<PerceptualLoss>,
    ) -> Result<Self, RefinementError> {
        let adam = Adam::new(network.parameters())?;
        Ok(Self { network, options, perceptual, adam })
    }

    /// The network as it is now.
    pub fn network(&self) -> &PaperRefiner {
        &self.network
    }
}

impl Training for PaperTrainer {
    fn steps(&self) -> u64 {
        self.adam.updates()
    }

    fn step(&mut self, examples: &[KnownView]) -> Result<Option<f64>, RefinementError> {
        let PaperTraining { steps, batch, patch, references, rate, seed } = self.options;
        if self.steps() >= steps {
            return Ok(None);
        }
        let (mut rendered, mut truth, mut others) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..batch {
            let mut rng = CounterRng::new(seed, PATCHES, self.steps() * batch as u64 + i as u64);
            let number = rng.below(examples.len() as u64);
            let drawn =
                TrainingPatch::new(&examples[number as usize], number, &self.options, &mut rng);
            drawn.append(&mut rendered, &mut truth, &mut others);
        }
        let tensor = |samples: &[f32], count: usize| tensor(samples, count, patch);
        let (rendered, truth) = (tensor(&rendered, batch)?, tensor(&truth, batch)?);
        let found = self.network.forward(&rendered, &tensor(&others, batch * references)?, true)?;
        let (loss, error) = loss(&found, &truth, self.perceptual.as_ref())?;
        let parameters: Vec<Tensor> = self.network.parameters().collect();
        let gradients = Tensor::f_run_backward(&[&loss], &parameters, false, false)?;
        if !error.is_finite() || !nets::all_finite(&gradients)? {
            return Err(RefinementError::NotFinite { step: self.steps() });
        }
        self.adam.step(self.network.parameters(), &gradients, rate)?;
        Ok(Some(error))
    }

    fn write_checkpoint(&self, path: &Path) -> Result<(), RefinementError> {
        Ok(self.adam.write_checkpoint(path, self.network.named(), &[])?)
    }

    fn resume(&mut self, path: &Path) -> Result<(), RefinementError> {
        (self.adam, []) = Adam::resume(path, &self.network.named())?;
        Ok(())
    }
}

/// Square patches as a network takes them: count × 3 × rows × columns.
fn tensor(samples: &[f32], count: usize, side: usize) -> Result<Tensor, TchError> {
    let (count, side) = (count as i64, side as i64);
    Tensor::f_from_slice(samples)?
        .f_reshape([count, side, side, COLOURS])?
        .f_permute([0, 3, 1, 2])?
        .f_contiguous()
}

/// L1 of images in -1..1 and, where there is one, the perceptual loss; and the L1 alone.
pub(crate) fn loss(
    found: &Tensor,
    truth: &Tensor,
    perceptual: Option<&PerceptualLoss>,
) -> Result<(Tensor, f64), TchError> {
    let first = found.f_sub(truth)?.f_abs()?.f_mean(Kind::Float)?;
    let error = first.f_double_value(&[])?;
    Ok((
        perceptual.map_or_else(
            || Ok(first.shallow_clone()),
            |p| p.distance(found, truth)?.f_add(&first),
        )?,
        error,
    ))
}

/// A patch to learn from.
struct TrainingPatch<'a> {
    example: &'a KnownView,
    warp: Perspective,
    patch: usize,
    corner: (usize, usize),
    /// Corners in the image that isn't warped.
    references: Vec<(usize, usize)>,
}

impl<'a> TrainingPatch<'a> {
    fn new(
        example: &'a KnownView,
        number: u64,
        options: &PaperTraining,
        rng: &mut CounterRng,
    ) -> Self {
        let (width, height) = (example.truth.width, example.truth.height);
        let which = rng.below(PERSPECTIVES_PER_IMAGE);
        // The same 200 throughout.
        let mut shape =
            CounterRng::new(options.seed, WARPS, number * PERSPECTIVES_PER_IMAGE + which);
        let warp = if which == 0 {
            Perspective::identity(width, height)
        } else {
            Perspective::draw(width, height, &mut shape)
        };
        let [left, top, right, bottom] = warp.filled;
        let last = |end: usize| end.saturating_sub(options.patch);
        let corner = (
            within(left.min(last(right)), last(right), rng),
            within(top.min(last(bottom)), last(bottom), rng),
        );
        let references = (0..options.references)
            .map(|_| (near(corner.0, last(width), rng), near(corner.1, last(height), rng)))
            .collect();
        Self { example, warp, patch: options.patch, corner, references }
    }

    /// Appends the patch as rendered, as it should be, and its references, in -1..1.
    fn append(&self, rendered: &mut Vec<f32>, truth: &mut Vec<f32>, others: &mut Vec<f32>) {
        let signed = |colour: [f32; 3]| colour.map(|v| 2.0 * v - 1.0);
        for (x, y) in self.pixels(self.corner) {
            rendered.extend(signed(self.warp.colour(&self.example.rendered.view, x, y)));
            truth.extend(signed(self.warp.colour(&self.example.truth, x, y)));
        }
        let whole = Perspective::identity(self.example.truth.width, self.example.truth.height);
        for &corner in &self.references {
            let reference = self.pixels(corner);
            others.extend(
                reference.flat_map(|(x, y)| signed(whole.colour(&self.example.truth, x, y))),
            );
        }
    }

    /// Pixels of the patch at a corner, row by row.
    fn pixels(&self, (x, y): (usize, usize)) -> impl Iterator<Item = (usize, usize)> {
        let patch = self.patch;
        (y..y + patch).flat_map(move |row| (x..x + patch).map(move |column| (column, row)))
    }
}

/// A draw from `low` to `high`, both included.
fn within(low: usize, high: usize, rng: &mut CounterRng) -> usize {
    low + rng.below((high.max(low) - low + 1) as u64) as usize
}

/// A draw from the window around a place, which ends at `last`.
fn near(at: usize, last: usize, rng: &mut CounterRng) -> usize {
    within(at.saturating_sub(REFERENCE_REACH).min(last), (at + REFERENCE_REACH).min(last), rng)
}

impl PaperTraining {
    /// Checks that patches have a side that the network can halve, and fit into every example.
    pub fn check(&self, examples: &[KnownView]) -> Result<(), RefinementError> {
        let too_small = |e: &&KnownView| e.truth.width < self.patch || e.truth.height < self.patch;
        let (name, reason) = match examples.iter().find(too_small) {
            Some(small) => (
                small.rendered.camera.name.clone(),
                format!("smaller than a patch of {0}×{0} pixels", self.patch),
            ),
            None if self.patch == 0 || !self.patch.is_multiple_of(PATCH_MULTIPLE) => (
                "any".to_owned(),
                format!(
                    "patches of {} pixels: a multiple of {PATCH_MULTIPLE} is expected",
                    self.patch
                ),
            ),
            None => return Ok(()),
        };
        Err(RefinementError::View { name, reason })
    }
}

#[cfg(test)]
mod tests {
    use pixels::Image;
    use refinement::Rendered;
    use scene::{Camera, Intrinsics};

    use super::*;

    /// Stripes beside the same with less contrast.
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

    const OPTIONS: PaperTraining =
        PaperTraining { steps: 60, batch: 4, patch: 16, references: 2, rate: 3e-3, seed: 5 };

    #[test]
    fn training_learns_and_goes_on_where_it_was() {
        nets::deterministic();
        let examples = [example()];
        OPTIONS.check(&examples).unwrap();
        let start = || PaperTrainer::new(PaperRefiner::new(4, 2).unwrap(), OPTIONS, None).unwrap();
        let mut trainer = start();
        let path = tempfile::tempdir().unwrap().keep().join("checkpoint.safetensors");
        let mut errors = Vec::new();
        while let Some(error) = trainer.step(&examples).unwrap() {
            errors.push(error);
            if trainer.steps() == 30 {
                trainer.write_checkpoint(&path).unwrap();
            }
        }
        let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
        assert!(mean(&errors[50..]) < 0.6 * mean(&errors[..5]), "{errors:?}");
        let mut again = start();
        again.resume(&path).unwrap();
        while again.step(&examples).unwrap().is_some() {}
        let same = trainer
            .network()
            .named()
            .iter()
            .zip(again.network().named())
            .all(|((_, a), (_, b))| *a == b);
        assert!(same, "a resumed training ends elsewhere");
    }

    #[test]
    fn patches_must_fit() {
        let said =
            |patch| PaperTraining { patch, ..OPTIONS }.check(&[example()]).unwrap_err().to_string();
        assert!(said(64).contains("64×64") && said(20).contains("multiple of 8"));
    }
}

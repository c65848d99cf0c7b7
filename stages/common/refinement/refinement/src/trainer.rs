use std::ops::Range;
use std::path::Path;

use numerics::CounterRng;
use pixels::{Image, psnr_of};
use rayon::prelude::*;

use crate::adam::Adam;
use crate::convolution::Convolution;
use crate::error::RefinementError;
use crate::folded::{FOLD, Orientation, Window};
use crate::network::Pass;
use crate::refiner::{Network, Refiner, RefinerArchitecture, RefinerFile, layer_sizes};
use crate::view::{KnownView, OUTPUTS, REFERENCE_INPUTS};
use crate::warped_reference::{ReferenceStatistics, WarpOptions, with_references};

/// Interruptible training, step by step.
pub trait Training {
    /// Returns the number of steps taken.
    fn steps(&self) -> u64;

    /// Takes one step on some of `examples`, which must not be empty. Returns the loss before the
    /// step, or `None` after the last step.
    fn step(&mut self, examples: &[KnownView]) -> Result<Option<f64>, RefinementError>;

    /// Writes a checkpoint, from which the training resumes. The caller makes the write atomic.
    fn write_checkpoint(&self, path: &Path) -> Result<(), RefinementError>;

    /// Resumes from a checkpoint of a training run with the same network and options.
    fn resume(&mut self, path: &Path) -> Result<(), RefinementError>;
}

/// Options for training a [`Refiner`] or a [`PaperRefiner`](crate::paper::PaperRefiner).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainingOptions {
    /// Total number of steps.
    pub steps: u64,
    /// Number of patches per step.
    pub batch_size: usize,
    /// Side of a patch in pixels; an even number, for the paper's network a multiple of 8.
    pub patch_size: usize,
    /// Number of references per view for a reference-based network; of reference patches per patch
    /// for the paper's.
    pub references: usize,
    /// Highest learning rate, reached after a warm-up and followed by cosine decay to 0; for the
    /// paper's network the constant rate.
    pub learning_rate: f64,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// Trains a [`Refiner`] with Adam on the mean squared error of patches of examples. Each patch is
/// rotated and mirrored, and its colours are changed, so that the network learns edges instead of
/// the scene's colours and transfers to another size (design note 015).
pub struct RefinerTrainer {
    refiner: Refiner,
    options: TrainingOptions,
    adam: Adam,
    /// Current training views of a reference-based network.
    pool: Option<Pool>,
    shards: Vec<Shard>,
}

/// Random examples with random references. References are warped once for all patches of a view,
/// and memory is bounded by the size of the pool (design note 017).
struct Pool {
    /// Number of earlier pools.
    round: u64,
    /// Index of the example, and the view with reference features.
    views: Vec<(usize, Image)>,
}

/// Draws the `number`-th example of the training run, with random references.
fn draw_view(
    number: u64,
    options: &TrainingOptions,
    guidance: WarpOptions,
    examples: &[KnownView],
) -> (usize, Image) {
    let mut rng = CounterRng::new(options.seed, POOLS, number);
    let count = examples.len() as u64;
    let chosen = rng.below(count) as usize;
    let drawn: Vec<usize> = (0..options.references).map(|_| rng.below(count) as usize).collect();
    let is_alone = rng.below(NO_REFERENCE_EVERY) == 0;
    // A view can't be its own reference.
    let references: Vec<&KnownView> = drawn
        .into_iter()
        .filter(|other| !is_alone && *other != chosen)
        .map(|other| &examples[other])
        .collect();
    (chosen, with_references(&examples[chosen].rendered, &references, guidance).view)
}

/// Number of shards of a step: fixed, so that sums have one order at any thread count.
const SHARDS: usize = 8;
/// Number of steps over which the learning rate rises; chosen by hand.
const WARM_UP_STEPS: u64 = 50;
/// Minimum contrast of a patch; flatter ones are drawn again, since they teach nothing. Chosen by
/// hand.
const MIN_CONTRAST: f32 = 0.08;
/// Maximum number of times that a patch is drawn again; chosen by hand.
const MAX_REDRAWS: usize = 8;
/// One in this many views gets no reference, so that the network also works without; chosen by
/// hand.
const NO_REFERENCE_EVERY: u64 = 8;
/// Number of views in the pool of a reference-based network (design note 017).
const POOL_VIEWS: u64 = 32;
/// Number of steps before the pool is drawn again (design note 017).
const POOL_STEPS: u64 = 200;
/// Streams of random numbers.
const PATCHES: u64 = 301;
const SCORES: u64 = 302;
const POOLS: u64 = 303;

impl RefinerTrainer {
    /// Creates a trainer of `refiner`.
    pub fn new(refiner: Refiner, options: TrainingOptions) -> Self {
        let adam = Adam::new(&refiner);
        let shards = (0..SHARDS).map(|_| Shard::default()).collect();
        Self { refiner, options, adam, pool: None, shards }
    }

    /// Returns the refiner in its current state.
    pub fn refiner(&self) -> &Refiner {
        &self.refiner
    }

    /// Scores the refiner on `examples`, the validation views, with references drawn from
    /// `references`, the training views. Returns the refiner's description with these scores and
    /// the residual weight, from 0 to 1, that gives the smallest squared error. `data_consistent`
    /// is true if the views are consistent with their own LR photographs.
    pub fn score(
        &self,
        examples: &[KnownView],
        references: &[KnownView],
        data_consistent: bool,
    ) -> Result<RefinerFile, RefinementError> {
        let mut statistics = ReferenceStatistics::default();
        let mut views = Vec::with_capacity(examples.len());
        for (number, example) in examples.iter().enumerate() {
            views.push(self.network_input(number as u64, example, references, &mut statistics));
        }
        let (mut rendered, mut inner_product, mut power) = (0.0, 0.0, 0.0);
        for (i, view) in views.iter().enumerate() {
            let truth = &examples[i].truth;
            let refined = self.refiner.refine(view)?;
            let mut error = 0.0;
            for (p, pixel) in view.data.chunks_exact(view.channels).enumerate() {
                for c in 0..OUTPUTS {
                    let sample = p * OUTPUTS + c;
                    let residual = f64::from(refined.data[sample] - pixel[c]);
                    let true_residual = f64::from(truth.data[sample] - pixel[c]);
                    inner_product += residual * true_residual;
                    power += residual * residual;
                    error += true_residual * true_residual;
                }
            }
            rendered += psnr_of(error / truth.data.len() as f64);
        }
        let residual_weight =
            if power > 0.0 { (inner_product / power).clamp(0.0, 1.0) } else { 0.0 };
        let mut refined = 0.0;
        for (view, example) in views.iter().zip(examples) {
            let image = self.refiner.refine_weighted(view, residual_weight as f32, 1)?;
            refined += example.psnr(&image);
        }
        let count = examples.len().max(1) as f64;
        Ok(RefinerFile {
            network: Network::Compact(self.refiner.architecture()),
            rendered_psnr: rendered / count,
            refined_psnr: refined / count,
            residual_weight,
            confidence: (statistics.visible_pixels > 0).then(|| statistics.confidence_share()),
            data_consistent,
        })
    }

    /// Returns the network's input for a validation view, with references drawn by its number.
    fn network_input(
        &self,
        number: u64,
        example: &KnownView,
        references: &[KnownView],
        statistics: &mut ReferenceStatistics,
    ) -> Image {
        let Some(guidance) = self.refiner.architecture().guidance else {
            return example.rendered.view.clone();
        };
        let mut rng = CounterRng::new(self.options.seed, SCORES, number);
        let drawn: Vec<&KnownView> = (0..self.options.references)
            .map(|_| &references[rng.below(references.len() as u64) as usize])
            .collect();
        let conditioned = with_references(&example.rendered, &drawn, guidance);
        for reference in &conditioned.statistics {
            statistics.add(reference);
        }
        conditioned.view
    }

    /// Draws a new pool if the network takes references and a round begins.
    fn update_pool(&mut self, examples: &[KnownView]) {
        let round = self.steps() / POOL_STEPS;
        if let Some(guidance) = self.refiner.architecture().guidance
            && self.pool.as_ref().is_none_or(|pool| pool.round != round)
        {
            let numbers = round * POOL_VIEWS..(round + 1) * POOL_VIEWS;
            let views = numbers
                .map(|number| draw_view(number, &self.options, guidance, examples))
                .collect();
            self.pool = Some(Pool { round, views });
        }
    }

    /// Returns the views that patches are drawn from: the pool, or all examples.
    fn views<'a>(&'a self, examples: &'a [KnownView]) -> Vec<TrainingView<'a>> {
        let Some(pool) = &self.pool else {
            return examples
                .iter()
                .map(|known| TrainingView { view: &known.rendered.view, truth: &known.truth })
                .collect();
        };
        let views = pool.views.iter();
        views.map(|(i, view)| TrainingView { view, truth: &examples[*i].truth }).collect()
    }
}

impl Training for RefinerTrainer {
    fn steps(&self) -> u64 {
        self.adam.steps_taken()
    }

    fn step(&mut self, examples: &[KnownView]) -> Result<Option<f64>, RefinementError> {
        let options = self.options;
        let TrainingOptions { steps, batch_size, learning_rate, .. } = options;
        let step = self.steps();
        if step >= steps {
            return Ok(None);
        }
        self.update_pool(examples);
        let mut shards = std::mem::take(&mut self.shards);
        let views = self.views(examples);
        let layers = self.refiner.layers();
        let architecture = self.refiner.architecture();
        shards.par_iter_mut().enumerate().for_each(|(i, shard)| {
            let range = batch_size * i / SHARDS..batch_size * (i + 1) / SHARDS;
            shard.run(architecture, &layers, &options, step, range, &views);
        });
        let loss: f64 = shards.iter().map(|shard| shard.loss).sum();
        let gradients = merge_gradients(&mut shards, architecture);
        self.shards = shards;
        if !loss.is_finite() || !gradients.iter().flatten().all(|g| g.is_finite()) {
            return Err(RefinementError::NotFinite { step });
        }
        let rate = nets::cosine_rate(learning_rate, step, steps, WARM_UP_STEPS);
        self.adam.step(&mut self.refiner, &gradients, rate);
        Ok(Some(loss))
    }

    fn write_checkpoint(&self, path: &Path) -> Result<(), RefinementError> {
        self.adam.write_checkpoint(&self.refiner, path)
    }

    fn resume(&mut self, path: &Path) -> Result<(), RefinementError> {
        (self.refiner, self.adam) = Adam::resume(path, &self.refiner)?;
        Ok(())
    }
}

/// Memory and results of a range of a step's patches.
#[derive(Debug, Default)]
struct Shard {
    pass: Pass,
    /// Network's input for a patch.
    input: Vec<f32>,
    /// True residual of a patch, then the slope of the loss.
    residual: Vec<f32>,
    /// Predicted residual.
    predicted: Vec<f32>,
    /// Sum of the patches' losses.
    loss: f64,
}

impl Shard {
    /// Computes loss and gradients of a range of a step's patches.
    fn run(
        &mut self,
        architecture: RefinerArchitecture,
        layers: &[Convolution],
        options: &TrainingOptions,
        step: u64,
        range: Range<usize>,
        views: &[TrainingView<'_>],
    ) {
        let Self { pass, input, residual, predicted, loss } = self;
        let square = Window { x: 0, y: 0, size: (options.patch_size, options.patch_size) };
        let around = square.grown(architecture.receptive_radius());
        let patch_samples = options.patch_size * options.patch_size * OUTPUTS;
        let samples = (options.batch_size * patch_samples) as f64;
        pass.reset(layers);
        *loss = 0.0;
        for i in range {
            let number = step * options.batch_size as u64 + i as u64;
            let patch = TrainingPatch::draw(options, number, views);
            input.clear();
            residual.clear();
            patch.append(architecture, input, residual);
            let output = pass.forward(layers, around.folds(), input);
            output.copy_samples(OUTPUTS * FOLD * FOLD, predicted);
            let mut squares = 0.0;
            for (truth, predicted) in residual.iter_mut().zip(predicted.iter()) {
                let error = predicted - *truth;
                squares += f64::from(error).powi(2);
                // The loss's slope replaces the true residual.
                *truth = 2.0 * error / samples as f32;
            }
            *loss += squares / samples;
            pass.backward(layers, residual);
        }
    }
}

/// Adds the shards' gradients in order, and returns those of the parameters.
fn merge_gradients(shards: &mut [Shard], architecture: RefinerArchitecture) -> Vec<Vec<f32>> {
    let [first, others @ ..] = shards else { return Vec::new() };
    let layers = layer_sizes(architecture);
    let sums = first.pass.gradients.par_iter_mut().enumerate();
    let gradients = sums.map(|(i, sum)| {
        for other in &*others {
            sum.add(&other.pass.gradients[i]);
        }
        let (_, inputs, outputs) = layers[i];
        [sum.kernels(inputs, outputs), sum.bias(outputs)]
    });
    gradients.collect::<Vec<_>>().into_iter().flatten().collect()
}

/// View that patches are drawn from.
#[derive(Clone, Copy)]
struct TrainingView<'a> {
    /// Input of the network.
    view: &'a Image,
    /// Ground truth.
    truth: &'a Image,
}

/// Augmented patch of a view.
struct TrainingPatch<'a> {
    view: TrainingView<'a>,
    square: Window,
    orientation: Orientation,
    /// Permutation of the colour channels.
    order: [usize; OUTPUTS],
    /// Factor on colours; negative for a negative image.
    gain: f32,
    offset: f32,
}

impl<'a> TrainingPatch<'a> {
    /// Draws the `number`-th patch of the training run.
    fn draw(options: &TrainingOptions, number: u64, views: &[TrainingView<'a>]) -> Self {
        let mut rng = CounterRng::new(options.seed, PATCHES, number);
        let (mut view, mut square) = draw_square(views, options.patch_size, &mut rng);
        for _ in 0..MAX_REDRAWS {
            if contrast(view.truth, square) >= MIN_CONTRAST {
                break;
            }
            (view, square) = draw_square(views, options.patch_size, &mut rng);
        }
        let orientation = Orientation::ALL[rng.below(Orientation::ALL.len() as u64) as usize];
        let mut order = [0, 1, 2];
        for i in 1..OUTPUTS {
            order.swap(i, rng.below(i as u64 + 1) as usize);
        }
        // Ranges chosen by hand.
        let factor = 0.5 + 0.7 * rng.uniform();
        let shift = 0.4 * (rng.uniform() - 0.5);
        let sign = if rng.below(2) == 1 { -1.0 } else { 1.0 };
        // Scaled around mid-grey.
        let (gain, offset) = (sign * factor, 0.5 + sign * (shift - 0.5 * factor));
        Self { view, square, orientation, order, gain, offset }
    }

    /// Appends the network's input, which includes the receptive field around the patch, and the
    /// true residual.
    fn append(
        &self,
        architecture: RefinerArchitecture,
        inputs: &mut Vec<f32>,
        residuals: &mut Vec<f32>,
    ) {
        let TrainingView { view, truth } = self.view;
        let around = self.square.grown(architecture.receptive_radius());
        around.fold(|x, y| {
            let (x, y) = self.orientation.source(around, x, y);
            let pixel = around.pixel(view, x, y);
            inputs.extend(self.order.map(|c| self.gain * pixel[c] + self.offset));
            inputs.push(pixel[OUTPUTS]);
            if view.channels == REFERENCE_INPUTS {
                let [.., r, g, b, confidence, detail_r, detail_g, detail_b] = pixel else {
                    unreachable!("a view with reference features has 11 channels")
                };
                let (difference, detail) = ([r, g, b], [detail_r, detail_g, detail_b]);
                inputs.extend(self.order.map(|c| self.gain * difference[c]));
                inputs.push(*confidence);
                inputs.extend(self.order.map(|c| self.gain * detail[c]));
            }
        });
        self.square.fold(|x, y| {
            let (x, y) = self.orientation.source(self.square, x, y);
            let rendered = self.square.pixel(view, x, y);
            let truth = self.square.pixel(truth, x, y);
            residuals.extend(self.order.map(|c| self.gain * (truth[c] - rendered[c])));
        });
    }
}

/// Draws a view and a square of `side` pixels in it.
fn draw_square<'a>(
    views: &[TrainingView<'a>],
    side: usize,
    rng: &mut CounterRng,
) -> (TrainingView<'a>, Window) {
    let chosen = views[rng.below(views.len() as u64) as usize];
    // Starts at even pixels, aligned with the folds of whole views.
    let [x, y] = [chosen.view.width, chosen.view.height].map(|size| {
        (rng.below((size.saturating_sub(side) / FOLD + 1) as u64) as usize * FOLD) as isize
    });
    (chosen, Window { x, y, size: (side, side) })
}

/// Returns the range of the green channel in a square of the ground truth.
fn contrast(truth: &Image, square: Window) -> f32 {
    let (left, top) = (square.x as usize, square.y as usize);
    let (width, height) = square.size;
    let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
    for row in truth.data.chunks_exact(truth.width * truth.channels).skip(top).take(height) {
        for pixel in row.chunks_exact(truth.channels).skip(left).take(width) {
            (low, high) = (low.min(pixel[1]), high.max(pixel[1]));
        }
    }
    high - low
}

#[cfg(test)]
mod tests {
    use scene::{Camera, Intrinsics};

    use super::*;
    use crate::refiner::RefinerArchitecture;
    use crate::view::Rendered;

    fn level(phase: usize, i: usize, is_blurred: bool) -> f32 {
        let stripe = |x: usize| if ((x + phase) / 4).is_multiple_of(2) { 0.2 } else { 0.8f32 };
        let x = i % 32 + 1;
        if is_blurred { (stripe(x - 1) + stripe(x) + stripe(x + 1)) / 3.0 } else { stripe(x) }
    }

    /// Returns a view of stripes, whose render is blurred by a pixel.
    fn example(phase: usize) -> KnownView {
        let view = (0..32 * 32)
            .flat_map(|i| {
                [level(phase, i, true), level(phase, i, true), level(phase, i, true), 1.0]
            })
            .collect();
        let truth = (0..32 * 32).flat_map(|i| [level(phase, i, false); 3]).collect();
        let camera = Camera {
            name: phase.to_string(),
            intrinsics: Intrinsics {
                width: 32,
                height: 32,
                fx: 32.0,
                fy: 32.0,
                cx: 16.0,
                cy: 16.0,
                distortion: Default::default(),
            },
            // A wall at distance 2, along which the camera moves by one pixel per phase.
            camera_to_world: [
                [1.0, 0.0, 0.0, phase as f64 / 16.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 2.0],
            ],
        };
        let view = Image::new(32, 32, 4, view);
        let rendered =
            Rendered { camera, view, depth: vec![2.0; 32 * 32], opacity: vec![1.0; 32 * 32] };
        KnownView { rendered, truth: Image::new(32, 32, 3, truth) }
    }

    fn trained(guidance: Option<WarpOptions>) -> (RefinerTrainer, Vec<KnownView>) {
        nets::deterministic();
        let options = TrainingOptions {
            steps: 300,
            batch_size: 8,
            patch_size: 16,
            references: 1,
            learning_rate: 5e-3,
            seed: 3,
        };
        let refiner = Refiner::new(RefinerArchitecture { channels: 8, blocks: 1, guidance }, 3);
        let mut trainer = RefinerTrainer::new(refiner, options);
        let examples: Vec<KnownView> = (0..4).map(example).collect();
        while trainer.step(&examples).unwrap().is_some() {}
        (trainer, examples)
    }

    #[test]
    fn a_blur_is_removed() {
        for guidance in [None, Some(WarpOptions::default())] {
            let (trainer, examples) = trained(guidance);
            let scores = trainer.score(&[example(5)], &examples, false).unwrap();
            assert!(scores.refined_psnr > scores.rendered_psnr + 6.0, "{scores:?}");
            assert!(scores.residual_weight > 0.8, "{scores:?}");
        }
    }

    /// References of the same wall display the stripes unchanged and in place, with high
    /// confidence. Pixels that no reference observes have no features.
    #[test]
    fn warped_references_equal_the_truth() {
        let (view, other) = (example(5), example(2));
        let pixels = with_references(&view.rendered, &[&other], WarpOptions::default()).view;
        let (mut n_visible, mut max_error) = (0, 0.0f32);
        for (i, pixel) in pixels.data.chunks_exact(REFERENCE_INPUTS).enumerate() {
            let column = i % 32;
            if pixel[7] == 0.0 {
                // The last three columns are not visible from the other camera, which is three
                // pixels to the left.
                assert!(column >= 29 && pixel[4..7] == [0.0; 3], "column {column}");
                continue;
            }
            n_visible += 1;
            max_error = max_error.max((pixel[0] + pixel[4] - view.truth.data[i * 3]).abs());
            // The half stripe that is visible at the border isn't as dark as the blurred one.
            assert!(
                pixel[7] > if (5..20).contains(&column) { 0.8 } else { 0.5 },
                "column {column}: {}",
                pixel[7]
            );
        }
        assert!(
            n_visible >= 28 * 32 && max_error < 1e-3,
            "{n_visible} visible pixels, maximum error {max_error}"
        );
        assert!(
            with_references(&view.rendered, &[], WarpOptions::default())
                .view
                .data
                .chunks_exact(REFERENCE_INPUTS)
                .all(|p| p[4..] == [0.0; 7])
        );
    }
}

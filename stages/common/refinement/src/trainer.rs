use std::ops::Range;
use std::path::Path;

use counter_rng::CounterRng;
use nets::Adam;
use pixels::{Image, psnr_of};
use rayon::prelude::*;
use tch::{Kind, TchError, Tensor, no_grad};

use crate::channels::{OUTPUTS, REFERENCE_INPUTS};
use crate::error::RefinementError;
use crate::folded::{FOLD, Square, Turn};
use crate::guidance::Guidance;
use crate::refiner::Refiner;
use crate::view::KnownView;
use crate::warped_reference::{Use, with_references};

/// A training, step by step, that can be interrupted.
pub trait Training {
    /// Steps taken.
    fn steps(&self) -> u64;

    /// Takes a step on some of the examples, of which there is at least one; the error before it,
    /// `None` once all steps are taken.
    fn step(&mut self, examples: &[KnownView]) -> Result<Option<f64>, RefinementError>;

    /// Writes all that a resumed training needs. The caller makes it atomic.
    fn write_checkpoint(&self, path: &Path) -> Result<(), RefinementError>;

    /// Goes on from a checkpoint of a training that began with the same network and options.
    fn resume(&mut self, path: &Path) -> Result<(), RefinementError>;
}

/// How to train a [`Refiner`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefinerTraining {
    /// Steps in all.
    pub steps: u64,
    /// Squares in a step.
    pub batch: usize,
    /// Pixels along a square's side; an even number.
    pub square: usize,
    /// References that a reference-based network gets for a view.
    pub references: usize,
    /// Highest learning rate; it rises over the first steps and falls to nothing, as a cosine.
    pub rate: f64,
    /// Seed of what is drawn.
    pub seed: u64,
}

/// Trains a [`Refiner`] by Adam on the squared error of squares of examples, each turned, mirrored
/// and with its colours changed: what is learnt are edges, not the scene's own colours, and so it
/// holds at another size, too. Its error is the mean squared one.
pub struct RefinerTrainer {
    refiner: Refiner,
    options: RefinerTraining,
    adam: Adam,
    /// What a reference-based network is shown now.
    pool: Option<Pool>,
}

/// Examples with what drawn references know of them: where references show a view is looked up once
/// for all squares of it that are drawn, and no more views than these are kept.
struct Pool {
    round: u64,
    /// Which example, and as the network takes it.
    views: Vec<(usize, Image)>,
}

impl Pool {
    fn new(
        round: u64,
        options: &RefinerTraining,
        guidance: Guidance,
        examples: &[KnownView],
    ) -> Self {
        let view = |i: u64| drawn_view(round * POOL_VIEWS + i, options, guidance, examples);
        Self { round, views: (0..POOL_VIEWS).map(view).collect() }
    }
}

/// The drawn example of that number, with what drawn references know of it.
fn drawn_view(
    number: u64,
    options: &RefinerTraining,
    guidance: Guidance,
    examples: &[KnownView],
) -> (usize, Image) {
    let mut rng = CounterRng::new(options.seed, POOLS, number);
    let mut draw = || rng.below(examples.len() as u64) as usize;
    let (chosen, drawn): (usize, Vec<usize>) =
        (draw(), (0..options.references).map(|_| draw()).collect());
    let alone = rng.below(NO_REFERENCE_EVERY) == 0;
    // A view is no reference for itself.
    let others: Vec<&KnownView> = drawn
        .iter()
        .filter(|other| !alone && **other != chosen)
        .map(|other| &examples[*other])
        .collect();
    (chosen, with_references(&examples[chosen].rendered, &others, guidance).view)
}

/// Shards of a step: fixed, so that sums have one order at any thread count.
const SHARDS: usize = 8;
/// Steps over which the rate rises.
const WARM_UP_STEPS: u64 = 50;
/// Squares with less contrast than this are drawn anew: flat ones teach nothing.
const LEAST_CONTRAST: f32 = 0.08;
/// A square is drawn anew at most so many times.
const MOST_REDRAWS: usize = 8;
/// A reference-based network gets no reference once in so many times, so that it can do without.
const NO_REFERENCE_EVERY: u64 = 8;
/// Views that squares are drawn from at a time where there are references.
const POOL_VIEWS: u64 = 32;
/// Steps until those views are drawn anew.
const POOL_STEPS: u64 = 200;
/// Purposes of draws.
const SQUARES: u64 = 301;
const SCORES: u64 = 302;
const POOLS: u64 = 303;

/// How well views are rendered and refined.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RefinerScores {
    /// Mean PSNR as rendered, in dB.
    pub rendered_psnr: f64,
    /// Mean PSNR refined, with the best strength, in dB.
    pub refined_psnr: f64,
    /// Share of the prediction that has the least squared error, from 0 to 1.
    pub strength: f64,
    /// Confidence in references, a share of their visibility, where there were any.
    pub confidence: Option<f64>,
}

impl RefinerTrainer {
    /// Starts from a refiner.
    pub fn new(refiner: Refiner, options: RefinerTraining) -> Result<Self, RefinementError> {
        let adam = Adam::new(refiner.parameters())?;
        Ok(Self { refiner, options, adam, pool: None })
    }

    /// The refiner as it is now.
    pub fn refiner(&self) -> &Refiner {
        &self.refiner
    }

    /// Scores examples that training left out, with references drawn from those that it had, and
    /// finds the share of the prediction that serves them best.
    pub fn score(
        &self,
        examples: &[KnownView],
        references: &[KnownView],
    ) -> Result<RefinerScores, RefinementError> {
        let mut uses = Use::default();
        let views: Vec<Image> = (0u64..)
            .zip(examples)
            .map(|(number, example)| self.conditioned(number, example, references, &mut uses))
            .collect();
        let (mut rendered, mut inner_product, mut power) = (0.0, 0.0, 0.0);
        for (view, KnownView { truth, .. }) in views.iter().zip(examples) {
            let refined = self.refiner.refine(view)?;
            let colours = view.data.chunks_exact(view.channels).flat_map(|p| &p[..OUTPUTS]);
            let mut error = 0.0;
            for ((r, v), t) in refined.data.iter().zip(colours).zip(&truth.data) {
                let (added, lacks) = (f64::from(r - v), f64::from(t - v));
                inner_product += added * lacks;
                power += added * added;
                error += lacks * lacks;
            }
            rendered += psnr_of(error / truth.data.len() as f64);
        }
        let strength = if power > 0.0 { (inner_product / power).clamp(0.0, 1.0) } else { 0.0 };
        let mut refined = 0.0;
        for (view, KnownView { truth, .. }) in views.iter().zip(examples) {
            let by = self.refiner.refine_by(view, strength as f32, 1)?;
            let error: f64 =
                by.data.iter().zip(&truth.data).map(|(r, t)| f64::from(t - r).powi(2)).sum();
            refined += psnr_of(error / truth.data.len() as f64);
        }
        let count = examples.len().max(1) as f64;
        Ok(RefinerScores {
            rendered_psnr: rendered / count,
            refined_psnr: refined / count,
            strength,
            confidence: (uses.seen > 0).then(|| uses.confidence_share()),
        })
    }

    /// A left-out example as the network takes it, with references drawn by its number.
    fn conditioned(
        &self,
        number: u64,
        example: &KnownView,
        references: &[KnownView],
        uses: &mut Use,
    ) -> Image {
        let Some(guidance) = self.refiner.architecture().guidance else {
            return example.rendered.view.clone();
        };
        let mut rng = CounterRng::new(self.options.seed, SCORES, number);
        let drawn: Vec<&KnownView> = (0..self.options.references)
            .map(|_| &references[rng.below(references.len() as u64) as usize])
            .collect();
        let conditioned = with_references(&example.rendered, &drawn, guidance);
        conditioned.uses.iter().for_each(|of_use| uses.add(of_use));
        conditioned.view
    }

    /// Draws references for examples anew, where the network takes some and a round begins.
    fn condition(&mut self, examples: &[KnownView]) {
        let round = self.steps() / POOL_STEPS;
        if let Some(guidance) = self.refiner.architecture().guidance
            && self.pool.as_ref().is_none_or(|pool| pool.round != round)
        {
            self.pool = Some(Pool::new(round, &self.options, guidance, examples));
        }
    }

    /// What squares are drawn from: examples with their references, or as they are.
    fn subjects<'a>(&'a self, examples: &'a [KnownView]) -> Vec<Subject<'a>> {
        let Some(pool) = &self.pool else {
            return examples
                .iter()
                .map(|example| Subject { view: &example.rendered.view, truth: &example.truth })
                .collect();
        };
        let conditioned = pool.views.iter();
        conditioned.map(|(i, view)| Subject { view, truth: &examples[*i].truth }).collect()
    }
}

impl Training for RefinerTrainer {
    fn steps(&self) -> u64 {
        self.adam.updates()
    }

    fn step(&mut self, examples: &[KnownView]) -> Result<Option<f64>, RefinementError> {
        let RefinerTraining { steps, batch, rate, .. } = self.options;
        let (step, options) = (self.steps(), self.options);
        if step >= steps {
            return Ok(None);
        }
        let shards: Vec<(Refiner, Range<usize>)> = (0..SHARDS)
            .map(|i| (self.refiner.share(), batch * i / SHARDS..batch * (i + 1) / SHARDS))
            .collect();
        self.condition(examples);
        let subjects = self.subjects(examples);
        let parts: Vec<(f64, Vec<Tensor>)> = shards
            .into_par_iter()
            .filter(|(_, range)| !range.is_empty())
            .map(|(refiner, range)| shard(&refiner, &options, step, range, &subjects))
            .collect::<Result<_, _>>()?;
        let (loss, gradients) = sum_in_order(parts)?;
        if !loss.is_finite() || !nets::all_finite(&gradients)? {
            return Err(RefinementError::NotFinite { step });
        }
        let warm = ((step + 1) as f64 / WARM_UP_STEPS as f64).min(1.0);
        let cosine = 0.5 * (1.0 + (std::f64::consts::PI * step as f64 / steps as f64).cos());
        self.adam.step(self.refiner.parameters(), &gradients, rate * warm * cosine)?;
        Ok(Some(loss))
    }

    fn write_checkpoint(&self, path: &Path) -> Result<(), RefinementError> {
        Ok(self.adam.write_checkpoint(path, self.refiner.named(), &[])?)
    }

    fn resume(&mut self, path: &Path) -> Result<(), RefinementError> {
        (self.adam, []) = Adam::resume(path, &self.refiner.named())?;
        Ok(())
    }
}

/// The sum of shards' losses and gradients, in their order.
fn sum_in_order(parts: Vec<(f64, Vec<Tensor>)>) -> Result<(f64, Vec<Tensor>), TchError> {
    let loss = parts.iter().map(|(loss, _)| loss).sum();
    let mut parts = parts.into_iter().map(|(_, gradients)| gradients);
    let mut gradients = parts.next().unwrap_or_default();
    for part in parts {
        no_grad(|| {
            gradients.iter_mut().zip(&part).try_for_each(|(sum, g)| sum.f_add_(g).map(drop))
        })?;
    }
    Ok((loss, gradients))
}

/// Loss and gradients of some of a step's squares.
fn shard(
    refiner: &Refiner,
    options: &RefinerTraining,
    step: u64,
    range: Range<usize>,
    subjects: &[Subject<'_>],
) -> Result<(f64, Vec<Tensor>), TchError> {
    let (mut inputs, mut lacks) = (Vec::new(), Vec::new());
    let size = (options.square, options.square);
    let around = Square { x: 0, y: 0, size }.grown(refiner.reach());
    let square = Square { x: 0, y: 0, size };
    for i in range {
        let drawn = TrainingSquare::new(options, step * options.batch as u64 + i as u64, subjects);
        drawn.append(refiner, &mut inputs, &mut lacks);
    }
    let added = refiner.forward(&around.tensor(&inputs, refiner.architecture().inputs())?)?;
    let all = (options.batch * options.square * options.square * OUTPUTS) as f64;
    let loss = added
        .f_sub(&square.tensor(&lacks, OUTPUTS)?)?
        .f_square()?
        .f_sum(None::<Kind>)?
        .f_div_scalar(all)?;
    let parameters: Vec<Tensor> = refiner.parameters().collect();
    let gradients = Tensor::f_run_backward(&[&loss], &parameters, false, false)?;
    Ok((loss.f_double_value(&[])?, gradients))
}

/// A view as the network takes it, beside what it should look like.
#[derive(Clone, Copy)]
struct Subject<'a> {
    view: &'a Image,
    truth: &'a Image,
}

/// A square of a view, as it is shown to the network.
struct TrainingSquare<'a> {
    subject: Subject<'a>,
    square: Square,
    turn: Turn,
    /// Which channel comes first, second, third.
    order: [usize; OUTPUTS],
    /// Contrast; negative for the negative.
    gain: f32,
    offset: f32,
}

impl<'a> TrainingSquare<'a> {
    /// The square with that number.
    fn new(options: &RefinerTraining, number: u64, subjects: &[Subject<'a>]) -> Self {
        let mut rng = CounterRng::new(options.seed, SQUARES, number);
        let mut placed = place(subjects, options.square, &mut rng);
        for _ in 0..MOST_REDRAWS {
            if contrast(placed.0.truth, placed.1) >= LEAST_CONTRAST {
                break;
            }
            placed = place(subjects, options.square, &mut rng);
        }
        let (subject, square) = placed;
        let turn = Turn::ALL[rng.below(Turn::ALL.len() as u64) as usize];
        let mut order = [0, 1, 2];
        (1..OUTPUTS).for_each(|i| order.swap(i, rng.below(i as u64 + 1) as usize));
        let (contrast, shift) = (0.5 + 0.7 * rng.uniform(), 0.4 * (rng.uniform() - 0.5));
        let sign = if rng.below(2) == 1 { -1.0 } else { 1.0 };
        // Around the middle of all colours.
        let (gain, offset) = (sign * contrast, 0.5 + sign * (shift - 0.5 * contrast));
        Self { subject, square, turn, order, gain, offset }
    }

    /// Appends what the network gets, which reaches farther than the square, and what it should
    /// add.
    fn append(&self, refiner: &Refiner, inputs: &mut Vec<f32>, lacks: &mut Vec<f32>) {
        let Subject { view, truth } = self.subject;
        let around = self.square.grown(refiner.reach());
        around.fold(|x, y| {
            let (x, y) = self.turn.source(around, x, y);
            let pixel = around.of(view, x, y);
            inputs.extend(self.order.map(|c| self.gain * pixel[c] + self.offset));
            inputs.push(pixel[OUTPUTS]);
            if view.channels == REFERENCE_INPUTS {
                let [.., r, g, b, confidence, x, y, z] = pixel else {
                    unreachable!("a conditioned view has that many channels")
                };
                let (differences, lacking) = ([r, g, b], [x, y, z]);
                inputs.extend(self.order.map(|c| self.gain * differences[c]));
                inputs.push(*confidence);
                inputs.extend(self.order.map(|c| self.gain * lacking[c]));
            }
        });
        self.square.fold(|x, y| {
            let (x, y) = self.turn.source(self.square, x, y);
            let (seen, wanted) = (self.square.of(view, x, y), self.square.of(truth, x, y));
            lacks.extend(self.order.map(|c| self.gain * (wanted[c] - seen[c])));
        });
    }
}

/// A drawn square, of so many pixels along its side, of a drawn view.
fn place<'a>(subjects: &[Subject<'a>], side: usize, rng: &mut CounterRng) -> (Subject<'a>, Square) {
    let subject = subjects[rng.below(subjects.len() as u64) as usize];
    let (x, y) = (start(subject.view.width, side, rng), start(subject.view.height, side, rng));
    (subject, Square { x, y, size: (side, side) })
}

/// Where a drawn square begins along an axis: on even pixels, as the folds of whole views lie.
fn start(size: usize, side: usize, rng: &mut CounterRng) -> isize {
    (rng.below((size.saturating_sub(side) / FOLD + 1) as u64) as usize * FOLD) as isize
}

/// Range of the green in a square of the truth.
fn contrast(truth: &Image, square: Square) -> f32 {
    let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
    square.fold(|x, y| {
        let green = square.of(truth, x, y)[1];
        (low, high) = (low.min(green), high.max(green));
    });
    high - low
}

#[cfg(test)]
mod tests {
    use scene::{Camera, Intrinsics};

    use super::*;
    use crate::refiner::RefinerArchitecture;
    use crate::view::Rendered;

    fn level(phase: usize, i: usize, blur: bool) -> f32 {
        let at = |x: usize| if ((x + phase) / 4).is_multiple_of(2) { 0.2 } else { 0.8f32 };
        let x = i % 32 + 1;
        if blur { (at(x - 1) + at(x) + at(x + 1)) / 3.0 } else { at(x) }
    }

    /// Stripes, and the same blurred by a pixel.
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
            // A wall at distance 2, along which the camera moves by a pixel a phase.
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

    fn trained(guidance: Option<Guidance>) -> (RefinerTrainer, Vec<KnownView>) {
        nets::deterministic();
        let options = RefinerTraining {
            steps: 300,
            batch: 8,
            square: 16,
            references: 1,
            rate: 5e-3,
            seed: 3,
        };
        let refiner =
            Refiner::new(RefinerArchitecture { channels: 8, blocks: 1, guidance }, 3).unwrap();
        let mut trainer = RefinerTrainer::new(refiner, options).unwrap();
        let examples: Vec<KnownView> = (0..4).map(example).collect();
        while trainer.step(&examples).unwrap().is_some() {}
        (trainer, examples)
    }

    #[test]
    fn a_blur_is_unlearnt() {
        for guidance in [None, Some(Guidance::default())] {
            let (trainer, examples) = trained(guidance);
            let scores = trainer.score(&[example(5)], &examples).unwrap();
            assert!(scores.refined_psnr > scores.rendered_psnr + 6.0, "{scores:?}");
            assert!(scores.strength > 0.8, "{scores:?}");
        }
    }

    /// References of the stripes' own wall show them as they are, at their place, with full
    /// confidence; wherever they can't see, nothing.
    #[test]
    fn references_show_what_is_there() {
        let (view, other) = (example(5), example(2));
        let pixels = with_references(&view.rendered, &[&other], Guidance::default()).view;
        let (mut seen, mut worst) = (0, 0.0f32);
        for (i, pixel) in pixels.data.chunks_exact(REFERENCE_INPUTS).enumerate() {
            let column = i % 32;
            if pixel[7] == 0.0 {
                // The other camera stands three pixels to the left: it doesn't see the last three
                // columns.
                assert!(column >= 29 && pixel[4..7] == [0.0; 3], "column {column}");
                continue;
            }
            seen += 1;
            worst = worst.max((pixel[0] + pixel[4] - view.truth.data[i * 3]).abs());
            // At the border half a stripe is seen, which isn't as dark as the blurred one.
            assert!(
                pixel[7] > if (5..20).contains(&column) { 0.8 } else { 0.5 },
                "column {column}: {}",
                pixel[7]
            );
        }
        assert!(seen >= 28 * 32 && worst < 1e-3, "{seen} pixels seen, {worst} off");
        assert!(
            with_references(&view.rendered, &[], Guidance::default())
                .view
                .data
                .chunks_exact(REFERENCE_INPUTS)
                .all(|p| p[4..] == [0.0; 7])
        );
    }
}

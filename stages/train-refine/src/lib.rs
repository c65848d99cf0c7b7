//! `train-refine`: trains the network that refines rendered views, from views whose truth is known.
//!
//! In the pipeline those are of a rehearsal: a field trained from LR pictures that were shrunk once more, rendered at LR size, beside
//! the LR pictures themselves. So it sees LR pictures alone, and the scene it is for.
//!
//! For views that will be refined by references, it sees references in training, too: other views of the rehearsal, of which every one has
//! its true picture.
//!
//! Every eighth view is left out of training; what the network brings there is measured and kept with it.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use artifact::{Context, Failure, FailureExt as _, GivenInput, Input, Output, Stage};
use pixels::{psnr_of, read_exr, read_premultiplied};
use refinement::{
    Architecture, KnownView, REFINER_FILE, RefinementError, Refiner, RefinerFile, RefinerTrainer, RefinerTraining, Rendered,
    WEIGHTS_FILE,
};
use scene::{View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `train-refine`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Steps of training.
    #[schemars(range(min = 1))]
    pub steps: u64,
    /// Squares of a view in a step.
    #[schemars(range(min = 1, max = 4096))]
    pub batch: u32,
    /// Pixels along a square's side; an even number.
    #[schemars(range(min = 8, max = 1024))]
    pub square: u32,
    /// Highest learning rate.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub rate: f64,
    /// Features of the network's hidden layers.
    #[schemars(range(min = 1, max = 512))]
    pub channels: u32,
    /// Its residual blocks, of two layers each.
    #[schemars(range(min = 0, max = 64))]
    pub blocks: u32,
    /// References that each view will have when it is refined; 0 trains a network that does without.
    #[schemars(range(min = 0, max = 64))]
    pub references: u32,
    /// Seed of everything that is drawn.
    pub seed: u64,
}

impl Default for Params {
    fn default() -> Self {
        Self { steps: 4000, batch: 8, square: 64, rate: 1e-3, channels: 32, blocks: 4, references: 0, seed: 0 }
    }
}

/// One view in so many is left out of training.
const LEFT_OUT: usize = 8;
/// Steps between two looks at how the training goes.
const NOTE: u64 = 50;

/// The stage.
pub struct TrainRefine;

impl Stage for TrainRefine {
    type Params = Params;
    const NAME: &'static str = "train-refine";
    const SUMMARY: &'static str = "Trains the network that refines rendered views, from views whose truth is known.";

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            ("truth", Input::required(&["scene/train", "scene/truth"], "what they should look like")),
        ]
    }

    fn output() -> Output {
        Output::kind("refiner")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        if params.square % 2 == 1 {
            return Err(Failure::Usage(format!("parameter square: {} is odd; an even number is expected", params.square)).into());
        }
        nets::deterministic();
        let (training, left_out) = examples(context.input("views")?, context.input("truth")?)?;
        if params.references > 0 && training.len() < 2 {
            return Err(Failure::BadInput("input views: one view has no others for references".to_owned()).into());
        }
        let architecture = Architecture { channels: params.channels, blocks: params.blocks, guided: params.references > 0 };
        let options = RefinerTraining {
            steps: params.steps,
            batch: params.batch as usize,
            square: params.square as usize,
            references: params.references as usize,
            rate: params.rate,
            seed: params.seed,
        };
        let mut trainer = RefinerTrainer::new(Refiner::new(architecture, params.seed)?, options)?;
        train(context, params, &mut trainer, &training)?;
        let scores = trainer.score(&left_out, &training)?;
        trainer.refiner().write(&context.output_path(WEIGHTS_FILE)?)?;
        let file = RefinerFile {
            architecture,
            strength: scores.strength,
            rendered_psnr: scores.rendered_psnr,
            refined_psnr: scores.refined_psnr,
        };
        context.write_json(REFINER_FILE, &file)?;
        let summary = format!(
            "views it hasn't seen: {:.2} dB rendered, {:.2} dB refined (strength {:.2})",
            file.rendered_psnr, file.refined_psnr, file.strength
        );
        context.say(&summary);
        context.write_summary(&summary)
    }
}

/// Takes all steps that an earlier run hasn't.
fn train(context: &Context, params: &Params, trainer: &mut RefinerTrainer, examples: &[KnownView]) -> anyhow::Result<()> {
    let checkpoint = context.work().map(|work| work.join("checkpoint.safetensors"));
    if let Some(path) = checkpoint.as_deref().filter(|p| p.exists()) {
        match trainer.resume(path) {
            Ok(()) => context.say(format!("going on from step {}", trainer.steps())),
            Err(error) => context.say(format!("{error}; starting over")),
        }
    }
    let progress = context.progress("training", params.steps);
    let (mut written, mut took) = (Instant::now(), Duration::from_millis(20));
    let (mut sum, mut since) = (0.0, 0);
    loop {
        // A checkpoint costs at most a fiftieth of the time.
        if let Some(path) = checkpoint.as_deref().filter(|_| context.interrupted() || written.elapsed() > 50 * took) {
            let started = Instant::now();
            write_checkpoint(trainer, path).context("cannot write the checkpoint")?;
            (written, took) = (Instant::now(), started.elapsed());
        }
        context.check_interrupt()?;
        let loss = trainer.step(examples).map_err(|error| match error {
            RefinementError::NotFinite { .. } => Failure::Numerical(error.to_string()).into(),
            error => anyhow::Error::from(error),
        })?;
        let Some(loss) = loss else { return Ok(()) };
        (sum, since) = (sum + loss, since + 1);
        if since == NOTE {
            progress.set(trainer.steps(), &format!("{:.2} dB", psnr_of(sum / since as f64)));
            (sum, since) = (0.0, 0);
        }
    }
}

fn write_checkpoint(trainer: &RefinerTrainer, path: &Path) -> anyhow::Result<()> {
    let partial = path.with_extension("partial");
    trainer.write_checkpoint(&partial)?;
    Ok(std::fs::rename(partial, path)?)
}

/// Views beside their truth: those to train on, and those left out; where there are fewer than two, the same ones.
fn examples(views: &GivenInput, truth: &GivenInput) -> anyhow::Result<(Vec<KnownView>, Vec<KnownView>)> {
    let (rendered, known) = (Views::read(views)?, Views::read(truth)?);
    let background = known.background.shown();
    let example = |view: &View| -> anyhow::Result<Option<KnownView>> {
        let name = &view.camera.name;
        let truth_file = known.taken_by(&view.camera).and_then(|v| v.image.as_ref());
        let (Some(file), Some(truth_file)) = (&view.image, truth_file) else { return Ok(None) };
        let place = || format!("view {name}");
        let image = read_exr(&views.path(file)).bad_input(place())?;
        let rendered = Rendered::new(view.camera.clone(), &image, background).bad_input("input views")?;
        let truth = read_premultiplied(&truth.path(truth_file)).bad_input(place())?.over(background);
        KnownView::new(rendered, truth).map(Some).bad_input("input views")
    };
    let all = rendered.views.iter().filter_map(|v| example(v).transpose()).collect::<anyhow::Result<Vec<_>>>()?;
    if all.is_empty() {
        return Err(
            Failure::BadInput("input views: none of them has a picture, by name and pose, in input truth".to_owned()).into()
        );
    }
    if all.len() == 1 {
        return Ok((all.clone(), all));
    }
    let middle = (LEFT_OUT / 2).min(all.len() - 1);
    let (left_out, training): (Vec<_>, Vec<_>) = all.into_iter().enumerate().partition(|(i, _)| i % LEFT_OUT == middle);
    let bare = |list: Vec<(usize, KnownView)>| list.into_iter().map(|(_, e)| e).collect();
    Ok((bare(training), bare(left_out)))
}

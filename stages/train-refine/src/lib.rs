//! `train-refine`: trains the network that refines rendered views, from views whose truth is known.
//!
//! In the pipeline those are of a rehearsal: a field trained from LR pictures that were shrunk once more, rendered at LR size, beside
//! the LR pictures themselves. So it sees LR pictures alone, and the scene it is for.
//!
//! For views that will be refined by references, it sees references in training, too: other views of the rehearsal, of which every one has
//! its true picture.
//!
//! Where all views to be refined (input `cameras`) have LR photographs of their own, as in the paper's split, they agree with those before the
//! network sees them; so do the views that it learns from.
//!
//! Every eighth view is left out of training; what the network brings there is measured and kept with it.
//!
//! `net: paper` trains the published network instead, on the rendered views of references beside the references (block `train-paper`): that is
//! for comparison, and takes weeks on a CPU.

mod paper;

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use artifact::{Context, Failure, FailureExt as _, GivenInput, Input, Output, Stage};
use pixels::{psnr_of, read_exr};
use refinement::{
    Guidance, KnownView, LrObservations, Network, REFINER_FILE, RefinementError, Refiner, RefinerArchitecture, RefinerFile,
    RefinerTrainer, RefinerTraining, Rendered, Training, WEIGHTS_FILE,
};
use scene::{View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `train-refine`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Which network: ours, or the paper's own (weeks on a CPU; with the published settings unless told otherwise).
    pub net: Net,
    /// Steps of training. Without it: 4,000 for `compact`, 46,875 for `paper`.
    #[schemars(range(min = 1))]
    pub steps: Option<u64>,
    /// Patches of views in a step. Without it: 8 for `compact`, 32 for `paper`.
    #[schemars(range(min = 1, max = 4096))]
    pub batch: Option<u32>,
    /// Pixels along a patch's side; a multiple of 2 for `compact`, of 8 for `paper`.
    #[schemars(range(min = 8, max = 1024))]
    pub patch_size: u32,
    /// Highest learning rate. Without it: 0.001 for `compact`, 0.0005 for `paper`.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub rate: Option<f64>,
    /// Features of the network's hidden layers; of the first for `paper`. Without it: 32 for `compact`, 128 for `paper`.
    #[schemars(range(min = 1, max = 512))]
    pub features: Option<u32>,
    /// `compact`: residual blocks, of two layers each.
    #[schemars(range(min = 0, max = 64))]
    pub blocks: u32,
    /// `compact`: references that each view gets while the network learns, as many as it will have when it is refined; 0 trains a network that does without.
    #[schemars(range(min = 0, max = 64))]
    pub references_per_view: u32,
    /// `compact`: whether a reference shows only what it sees by its own depth; without it also what something stands before (to be compared with).
    pub occlusion: bool,
    /// `compact`: whether what a reference shows is moved, by up to two pixels, to fit what is rendered (to be compared with).
    pub alignment: bool,
    /// `paper`: reference patches that a patch gets.
    #[schemars(range(min = 1, max = 64))]
    pub patches: u32,
    /// Seed of everything that is drawn.
    pub seed: u64,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            net: Net::Compact,
            steps: None,
            batch: None,
            patch_size: 64,
            rate: None,
            features: None,
            blocks: 4,
            references_per_view: 0,
            occlusion: true,
            alignment: false,
            patches: 8,
            seed: 0,
        }
    }
}

/// The networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Net {
    /// Ours: small, taught by a rehearsal one size down, sees references where there are some.
    Compact,
    /// NeRF-SR's: 30 million weights, patches, taught on HR references.
    Paper,
}

/// One view in so many is left out of training.
const LEFT_OUT: usize = 8;
/// Steps between two looks at how the training goes.
const NOTE: u64 = 50;
/// Longest without one.
const QUIET: Duration = Duration::from_secs(10);

/// The stage.
pub struct TrainRefine;

impl Stage for TrainRefine {
    type Params = Params;
    const NAME: &'static str = "train-refine";
    const SUMMARY: &'static str = "Trains the network that refines rendered views, from views whose truth is known.";

    fn inputs() -> Vec<(&'static str, Input)> {
        let cameras = ["scene/cameras", "scene/train", "scene/truth", "scene/references", "cameras", "views"];
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            ("truth", Input::required(&["scene/train", "scene/truth", "scene/references"], "what they should look like")),
            (
                "photographs",
                Input::optional(
                    &["scene/train"],
                    "net: compact: LR photographs that the field which rendered them was trained on",
                ),
            ),
            (
                "cameras",
                Input::optional(
                    &cameras,
                    "net: compact: cameras of the views to be refined; where all have LR photographs, so have examples",
                ),
            ),
            (
                "weights",
                Input::optional(&["weights"], "net: paper: folder with VGG-19, for the perceptual loss; without it L1 alone"),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("refiner")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        nets::deterministic();
        if params.net == Net::Paper {
            return paper::run(context, params);
        }
        if params.patch_size % 2 == 1 {
            return Err(Failure::Usage(format!(
                "parameter patch_size: {} is odd; an even number is expected",
                params.patch_size
            ))
            .into());
        }
        let own = lr_observations(context)?;
        let (training, left_out) = examples(context.input("views")?, context.input("truth")?, own.as_ref())?;
        if params.references_per_view > 0 && training.len() < 2 {
            return Err(Failure::BadInput("input views: one view has no others for references".to_owned()).into());
        }
        let architecture = RefinerArchitecture {
            channels: params.features.unwrap_or(32),
            blocks: params.blocks,
            guidance: (params.references_per_view > 0)
                .then_some(Guidance { occlusion: params.occlusion, alignment: params.alignment }),
        };
        let options = RefinerTraining {
            steps: params.steps.unwrap_or(4000),
            batch: params.batch.unwrap_or(8) as usize,
            square: params.patch_size as usize,
            references: params.references_per_view as usize,
            rate: params.rate.unwrap_or(1e-3),
            seed: params.seed,
        };
        let mut trainer = RefinerTrainer::new(Refiner::new(architecture, params.seed)?, options)?;
        train(context, options.steps, &mut trainer, &training, |error| format!("{:.2} dB", psnr_of(error)))?;
        let scores = trainer.score(&left_out, &training)?;
        trainer.refiner().write(&context.output_path(WEIGHTS_FILE)?)?;
        let file = RefinerFile {
            network: Network::Compact(architecture),
            strength: scores.strength,
            rendered_psnr: scores.rendered_psnr,
            refined_psnr: scores.refined_psnr,
            trusted: scores.confidence,
            agreeing: own.is_some(),
        };
        context.write_json(REFINER_FILE, &file)?;
        say(context, "views it hasn't seen", &file)
    }
}

/// LR photographs of the rehearsal's views, where those of the views to be refined will be known, too: the task is to be the same.
fn lr_observations(context: &Context) -> anyhow::Result<Option<LrObservations<'_>>> {
    let Some((photographs, cameras)) = context.optional_input("photographs").zip(context.optional_input("cameras")) else {
        return Ok(None);
    };
    let own = LrObservations::read(photographs)?;
    if !own.are_of_all(&Views::read(cameras)?) {
        return Ok(None);
    }
    context.say("all views to be refined have LR photographs of their own: the network learns on views that agree with theirs");
    Ok(Some(own))
}

/// What training brought to some views.
fn say(context: &Context, views: &str, file: &RefinerFile) -> anyhow::Result<()> {
    let RefinerFile { rendered_psnr, refined_psnr, strength, .. } = file;
    let summary =
        format!("{views}: {rendered_psnr:.2} dB rendered, {refined_psnr:.2} dB refined (residual weight {strength:.2})");
    context.say(&summary);
    context.write_summary(&summary)
}

/// Takes all steps that an earlier run hasn't; `note` says in words how large errors are.
fn train(
    context: &Context,
    steps: u64,
    trainer: &mut impl Training,
    examples: &[KnownView],
    note: impl Fn(f64) -> String,
) -> anyhow::Result<()> {
    let checkpoint = context.work().map(|work| work.join("checkpoint.safetensors"));
    if let Some(path) = checkpoint.as_deref().filter(|p| p.exists()) {
        match trainer.resume(path) {
            Ok(()) => context.say(format!("going on from step {}", trainer.steps())),
            Err(error) => context.say(format!("{error}; starting over")),
        }
    }
    let progress = context.progress("training", steps);
    let (mut written, mut took) = (Instant::now(), Duration::from_millis(20));
    let (mut sum, mut since, mut noted) = (0.0, 0u64, Instant::now());
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
        if since == NOTE || noted.elapsed() > QUIET {
            progress.set(trainer.steps(), &note(sum / since as f64));
            (sum, since, noted) = (0.0, 0u64, Instant::now());
        }
    }
}

fn write_checkpoint(trainer: &impl Training, path: &Path) -> anyhow::Result<()> {
    let partial = path.with_extension("partial");
    trainer.write_checkpoint(&partial)?;
    Ok(std::fs::rename(partial, path)?)
}

/// Views beside their truth: those to train on, and those left out; where there are fewer than two, the same ones.
fn examples(
    views: &GivenInput,
    truth: &GivenInput,
    own: Option<&LrObservations<'_>>,
) -> anyhow::Result<(Vec<KnownView>, Vec<KnownView>)> {
    let (rendered, known) = (Views::read(views)?, Views::read(truth)?);
    let background = known.background.shown();
    let example = |view: &View| -> anyhow::Result<Option<KnownView>> {
        let name = &view.camera.name;
        let (Some(file), Some(true_view)) = (&view.image, known.taken_by(&view.camera)) else { return Ok(None) };
        let place = || format!("view {name}");
        let Some(photograph) = true_view.read_photograph(truth).bad_input(place())? else { return Ok(None) };
        let image = read_exr(&views.path(file)).bad_input(place())?;
        let mut rendered = Rendered::new(view.camera.clone(), &image, background).bad_input("input views")?;
        if let Some(own) = own {
            rendered = own.make_consistent(rendered)?;
        }
        Ok(Some(KnownView::new(rendered, photograph.over(background)).bad_input("input views")?))
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

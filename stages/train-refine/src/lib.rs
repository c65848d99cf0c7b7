//! `train-refine`: trains the network that refines rendered views, from views whose truth is known.
//!
//! This is internal learning; in the pipeline the views are of the downscaled field: a field
//! trained from LR images that were shrunk once more, rendered at LR size, beside the LR images
//! themselves. So it sees LR images alone, and the scene it is for.
//!
//! For views that will be refined by references, it sees references in training, too: other views
//! of the downscaled field, of which every one has its true image.
//!
//! Where all views to be refined (input `cameras`) have LR photographs of their own, as in the
//! paper's split, they are made consistent with those before the network sees them; so do the views
//! that it learns from.
//!
//! Every eighth view is left out of training; what the network brings there is measured and kept
//! with it.
//!
//! `net: paper` trains the published network instead, on the rendered views of references beside
//! the references (block `train-paper`): that is for comparison, and takes weeks on a CPU.

mod paper;

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use artifact::{Context, Failure, FailureExt as _, GivenInput, Input, Output, Stage};
use pixels::{psnr_of, read_exr};
use refinement::{
    Guidance, KnownView, LrObservations, Network, REFINER_FILE, RefinementError, Refiner,
    RefinerArchitecture, RefinerFile, RefinerTrainer, RefinerTraining, Rendered, Training,
    WEIGHTS_FILE,
};
use scene::{View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `train-refine`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Kind of network: ours, or the paper's, which takes weeks on a CPU.
    #[schemars(extend("x-group" = "network"))]
    pub net: Net,
    /// Seed of all random numbers.
    #[schemars(extend("x-group" = "sampling"))]
    pub seed: u64,
}

/// The networks, each with its own parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Net {
    /// Ours: small, trained by internal learning, with or without references.
    Compact(CompactParams),
    /// NeRF-SR's: 30 million weights, trained on patches of HR references.
    Paper(PaperParams),
}

impl Default for Net {
    fn default() -> Self {
        Self::Compact(CompactParams::default())
    }
}

/// Parameters of our network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CompactParams {
    /// Steps of training.
    #[schemars(range(min = 1), extend("x-group" = "optimiser"))]
    pub steps: u64,
    /// Patches in a step.
    #[schemars(range(min = 1, max = 4096), extend("x-group" = "sampling"))]
    pub batch: u32,
    /// Pixels along a patch's side; an even number.
    #[schemars(range(min = 8, max = 1024), extend("x-group" = "sampling"))]
    pub patch_size: u32,
    /// Highest learning rate.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "optimiser"))]
    pub rate: f64,
    /// Features of the hidden layers.
    #[schemars(range(min = 1, max = 512), extend("x-group" = "network"))]
    pub features: u32,
    /// Residual blocks, of two layers each.
    #[schemars(range(min = 0, max = 64), extend("x-group" = "network"))]
    pub blocks: u32,
    /// References that each view gets while the network learns: as many as it will have when views
    /// are refined. 0 trains a network without references.
    #[schemars(range(min = 0, max = 64), extend("x-group" = "data"))]
    pub references_per_view: u32,
    /// A reference shows only points that it sees by its own depth. Without this, it also shows
    /// points that something hides; for comparisons.
    #[schemars(extend("x-group" = "data"))]
    pub occlusion: bool,
    /// Moves warped references by up to two pixels to fit the render; for comparisons.
    #[schemars(extend("x-group" = "data"))]
    pub alignment: bool,
}

impl Default for CompactParams {
    fn default() -> Self {
        Self {
            steps: 4_000,
            batch: 8,
            patch_size: 64,
            rate: 1e-3,
            features: 32,
            blocks: 4,
            references_per_view: 0,
            occlusion: true,
            alignment: false,
        }
    }
}

/// Parameters of the paper's network, with the published settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PaperParams {
    /// Steps of training.
    #[schemars(range(min = 1), extend("x-group" = "optimiser"))]
    pub steps: u64,
    /// Patches in a step.
    #[schemars(range(min = 1, max = 4096), extend("x-group" = "sampling"))]
    pub batch: u32,
    /// Pixels along a patch's side; a multiple of 8.
    #[schemars(range(min = 8, max = 1024), extend("x-group" = "sampling"))]
    pub patch_size: u32,
    /// Highest learning rate.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-group" = "optimiser"))]
    pub rate: f64,
    /// Features of the first layer.
    #[schemars(range(min = 1, max = 512), extend("x-group" = "network"))]
    pub features: u32,
    /// Reference patches that a patch gets.
    #[schemars(range(min = 1, max = 64), extend("x-group" = "data"))]
    pub patches: u32,
}

impl Default for PaperParams {
    fn default() -> Self {
        Self { steps: 46_875, batch: 32, patch_size: 64, rate: 5e-4, features: 128, patches: 8 }
    }
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
    const SUMMARY: &'static str =
        "Trains the network that refines rendered views, from views whose truth is known.";

    fn inputs() -> Vec<(&'static str, Input)> {
        let cameras =
            ["scene/cameras", "scene/train", "scene/truth", "scene/references", "cameras", "views"];
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            (
                "truth",
                Input::required(
                    &["scene/train", "scene/truth", "scene/references"],
                    "what they should look like",
                ),
            ),
            (
                "photographs",
                Input::optional(
                    &["scene/train"],
                    "net: compact: LR photographs that the field which rendered them was trained \
                    on",
                ),
            ),
            (
                "cameras",
                Input::optional(
                    &cameras,
                    "net: compact: cameras of the views to be refined; where all have LR \
                    photographs, so have examples",
                ),
            ),
            (
                "weights",
                Input::optional(
                    &["weights"],
                    "net: paper: folder with VGG-19, for the perceptual loss; without it L1 alone",
                ),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("refiner")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        nets::deterministic();
        let net = match &params.net {
            Net::Compact(compact) => compact,
            Net::Paper(paper) => return paper::run(context, paper, params.seed),
        };
        if net.patch_size % 2 == 1 {
            return Err(Failure::Usage(format!(
                "parameter patch_size: {} is odd; an even number is expected",
                net.patch_size
            ))
            .into());
        }
        let own = lr_observations(context)?;
        let (training, left_out) =
            examples(context.input("views")?, context.input("truth")?, own.as_ref())?;
        if net.references_per_view > 0 && training.len() < 2 {
            return Err(Failure::BadInput(
                "input views: one view has no others for references".to_owned(),
            )
            .into());
        }
        let architecture = RefinerArchitecture {
            channels: net.features,
            blocks: net.blocks,
            guidance: (net.references_per_view > 0)
                .then_some(Guidance { occlusion: net.occlusion, alignment: net.alignment }),
        };
        let options = RefinerTraining {
            steps: net.steps,
            batch: net.batch as usize,
            square: net.patch_size as usize,
            references: net.references_per_view as usize,
            rate: net.rate,
            seed: params.seed,
        };
        let mut trainer = RefinerTrainer::new(Refiner::new(architecture, params.seed)?, options)?;
        train(context, options.steps, &mut trainer, &training, |error| {
            format!("{:.2} dB", psnr_of(error))
        })?;
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

/// LR photographs of the downscaled field's views, where those of the views to be refined will be
/// known, too: the task is to be the same.
fn lr_observations(context: &Context) -> anyhow::Result<Option<LrObservations<'_>>> {
    let Some((photographs, cameras)) =
        context.optional_input("photographs").zip(context.optional_input("cameras"))
    else {
        return Ok(None);
    };
    let own = LrObservations::read(photographs)?;
    if !own.are_of_all(&Views::read(cameras)?) {
        return Ok(None);
    }
    context.say(
        "all views to be refined have LR photographs of their own: the network learns on views \
        that are consistent with theirs",
    );
    Ok(Some(own))
}

/// What training brought to some views.
fn say(context: &Context, views: &str, file: &RefinerFile) -> anyhow::Result<()> {
    let RefinerFile { rendered_psnr, refined_psnr, strength, .. } = file;
    let summary = format!(
        "{views}: {rendered_psnr:.2} dB rendered, {refined_psnr:.2} dB refined (residual weight \
        {strength:.2})"
    );
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
        if let Some(path) =
            checkpoint.as_deref().filter(|_| context.interrupted() || written.elapsed() > 50 * took)
        {
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

/// Views beside their truth: those to train on, and those left out; where there are fewer than two,
/// the same ones.
fn examples(
    views: &GivenInput,
    truth: &GivenInput,
    own: Option<&LrObservations<'_>>,
) -> anyhow::Result<(Vec<KnownView>, Vec<KnownView>)> {
    let (rendered, known) = (Views::read(views)?, Views::read(truth)?);
    let background = known.background.shown();
    let example = |view: &View| -> anyhow::Result<Option<KnownView>> {
        let name = &view.camera.name;
        let (Some(file), Some(true_view)) = (&view.image, known.taken_by(&view.camera)) else {
            return Ok(None);
        };
        let place = || format!("view {name}");
        let Some(photograph) = true_view.read_photograph(truth).bad_input(place())? else {
            return Ok(None);
        };
        let image = read_exr(&views.path(file)).bad_input(place())?;
        let mut rendered =
            Rendered::new(view.camera.clone(), &image, background).bad_input("input views")?;
        if let Some(own) = own {
            rendered = own.make_consistent(rendered)?;
        }
        Ok(Some(KnownView::new(rendered, photograph.over(background)).bad_input("input views")?))
    };
    let all = rendered
        .views
        .iter()
        .filter_map(|v| example(v).transpose())
        .collect::<anyhow::Result<Vec<_>>>()?;
    if all.is_empty() {
        return Err(Failure::BadInput(
            "input views: none of them has an image, by name and pose, in input truth".to_owned(),
        )
        .into());
    }
    if all.len() == 1 {
        return Ok((all.clone(), all));
    }
    let middle = (LEFT_OUT / 2).min(all.len() - 1);
    let (left_out, training): (Vec<_>, Vec<_>) =
        all.into_iter().enumerate().partition(|(i, _)| i % LEFT_OUT == middle);
    let bare = |list: Vec<(usize, KnownView)>| list.into_iter().map(|(_, e)| e).collect();
    Ok((bare(training), bare(left_out)))
}

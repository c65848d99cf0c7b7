//! `train-ss`: supersampled training of a radiance field from LR images (NeRF-SR, section "Supersampling").
//!
//! * [`Params`]: the stage's parameters; `supersample: 1` is plain NeRF on the same images.
//! * [`Resolved`]: the parameters with every default that the scene decides ([`Params::resolve`]).
//! * [`Supersampling`]: what rays are cast and what their colours are compared with: the paper's average (its eq. 4), or the
//!   kernel that made the LR images.
//! * `hr_cache`: the field's HR pixels as last rendered, by which the kernel is known without casting its whole footprint.
//! * `member`: one training; `field_trainer`: whatever it trains, our grid or the paper's networks.
//! * `exposure`: how bright each photograph is, where that is asked for.
//! * `moving_cameras`: where photographs were taken from, where that is asked for; `pose_choice`: whether it was better to ask.
//! * `checkpoint`: what makes a killed run end in the same bytes.

mod checkpoint;
mod exposure;
mod field_trainer;
mod hr_cache;
mod member;
mod moving_cameras;
mod order;
mod params;
mod pose_choice;
mod references;
mod resolve;
mod supervision;

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::Context as _;
use artifact::{
    Context, Failure, FailureExt as _, GivenInput, Input, Output, Progress, Rule, Stage, WARNING, amount, with_warnings,
};
use pixels::{DEGRADATION_FILE, Degradation, Kernel};
use radiance::{FIELD_FILE, FIELD_FORMAT, FieldFile};
use scene::{Photograph, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use member::Member;
pub use params::{Combine, FieldParams, GridParams, MlpParams, Params, RateSchedule};
pub use resolve::{Resolved, ResolvedField, SceneFacts};
pub use supervision::{Order, Supersampling, SupersamplingOptions, Supervision};

/// `training.json`: how the training went, over all members one after the other.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainingLog {
    /// Steps taken.
    pub steps: u64,
    /// Rays cast.
    pub rays: u64,
    /// Mean samples a ray over the whole training.
    pub samples_per_ray: f64,
    /// Values in use of the parameters whose default depends on the scene, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub resolved: BTreeMap<String, Value>,
    /// PSNR of training pixels against rays, about a hundred points a member.
    pub curve: Vec<CurvePoint>,
    /// How many times as bright as all together each training view is, in the order of `views.json`, red, green and blue, where that was asked
    /// for; of the first member.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub exposures: Vec<[f32; 3]>,
    /// Where each training view was found to be taken from, `camera_to_world` in the order of `views.json`, where that was asked for; of the first
    /// member. The given poses where no better ones were found.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub poses: Vec<[[f64; 4]; 3]>,
    /// What looks wrong about it, a line each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
}

impl TrainingLog {
    /// Appends another training's.
    fn add(&mut self, next: TrainingLog) {
        let samples = self.samples_per_ray * self.rays as f64 + next.samples_per_ray * next.rays as f64;
        let before = self.rays;
        if self.steps == 0 {
            (self.exposures, self.poses) = (next.exposures, next.poses);
        }
        self.warnings.extend(next.warnings);
        self.curve.extend(next.curve.into_iter().map(|p| CurvePoint { rays: before + p.rays, ..p }));
        self.steps += next.steps;
        self.rays += next.rays;
        self.samples_per_ray = samples / self.rays.max(1) as f64;
    }
}

/// A point of the training curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CurvePoint {
    /// Rays cast until here.
    pub rays: u64,
    /// PSNR over the training pixels since the last point.
    pub psnr: f64,
}

/// Name of a [`TrainingLog`] in the output.
const TRAINING_FILE: &str = "training.json";

/// The stage.
pub struct TrainSs;

impl Stage for TrainSs {
    type Params = Params;
    const NAME: &'static str = "train-ss";
    const SUMMARY: &'static str = "Trains a radiance field from LR images by supersampling.";
    #[cfg(feature = "torch")]
    const ENVIRONMENT: &'static [&'static str] = &[nets::TF32_VARIABLE];

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![
            ("scene", Input::required(&["scene/train"], "LR images with cameras and bounds")),
            ("references", Input::optional(&["scene/references"], "HR images of some views, to train on beside the LR images")),
            (
                "init",
                Input::optional(
                    &["field"],
                    "a field to fine-tune, trained on the same scene with the same parameters; see combine",
                ),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("field").with_resolved(TRAINING_FILE)
    }

    fn rules() -> Vec<Rule> {
        let closed = [("supervision", json!("kernel")), ("pose_refinement", json!(true)), ("exposure", json!(true))];
        let rule = |(parameter, value)| {
            let message = open_background(parameter);
            Rule::new(&message)
                .when("scene.background", json!({"const": "alpha"}))
                .must(parameter, json!({"not": {"const": value}}))
        };
        let importance = "parameter pixel_importance: an epoch goes through all pixels evenly; choose order random";
        let evenly = Rule::new(importance)
            .when("order", json!({"const": "epochs"}))
            .must("pixel_importance", json!({"anyOf": [{"type": "null"}, {"maximum": 1}]}));
        closed.map(rule).into_iter().chain([evenly]).collect()
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        params.check().map_err(Failure::Usage)?;
        let input = context.input("scene")?;
        let references = context.optional_input("references");
        let views = Views::read(input)?;
        let init = context.optional_input("init");
        let has_kernel = input.path(DEGRADATION_FILE).exists();
        let params = params.resolve(&SceneFacts { is_fine_tuning: init.is_some(), ..SceneFacts::of(&views, has_kernel) });
        let (model, combine) = (params.model(), params.combine);
        let mut file = FieldFile {
            format: FIELD_FORMAT,
            field: model,
            members: params.ensemble,
            bounds: views.bounds,
            background: views.background,
        };
        let init = init.map(|input| InitField::read(input, &file)).transpose()?;
        let first = match (&init, combine) {
            (Some(init), Combine::Ensemble) => init.keep_beside(context, &mut file)?,
            _ => 0,
        };
        let members: Vec<Resolved> = (0..params.ensemble).map(|index| params.member(index)).collect();
        let compared = if params.pose_refinement { members[0].rays } else { 0 };
        let progress = context.progress("training", compared + params.rays);
        let data = TrainingData { input, references, views: &views, progress: &progress };
        let mut log = TrainingLog { resolved: params.record(), ..TrainingLog::default() };
        let mut done = compared;
        for (index, own) in members.into_iter().enumerate() {
            // What the first member finds of poses holds for all.
            let own = Resolved { pose_refinement: own.pose_refinement && (index == 0 || moves_cameras(&log, &views)), ..own };
            let from = init.as_ref().map(|init| (init.member(index as u32), combine));
            let before = if index == 0 { 0 } else { done };
            let member = Member::new(context, own, (model, from), first + index as u32, before)?;
            let trained = if index == 0 { pose_choice::train(&member, &data)? } else { member.run(&data)? };
            trained.warnings.iter().for_each(|warning| context.say(format!("{WARNING}{warning}")));
            done += trained.rays;
            log.add(trained);
            progress.set(done, "");
        }
        context.write_json(FIELD_FILE, &file)?;
        context.write_json(TRAINING_FILE, &log)?;
        let psnr = log.curve.last().map_or(0.0, |p| p.psnr);
        let (rays, steps, samples) = (amount(log.rays), log.steps, log.samples_per_ray);
        let summary = format!("{rays} rays in {steps} steps, {samples:.1} samples a ray, training PSNR {psnr:.2} dB");
        context.write_summary(&with_warnings(&summary, &log.warnings))
    }
}

/// Whether a training has found other poses than the given ones.
fn moves_cameras(log: &TrainingLog, views: &Views) -> bool {
    log.poses.iter().zip(&views.views).any(|(pose, view)| *pose != view.camera.camera_to_world)
}

/// What a training learns from, and where it says how far it is.
#[derive(Clone, Copy)]
pub(crate) struct TrainingData<'a> {
    input: &'a GivenInput,
    references: Option<&'a GivenInput>,
    views: &'a Views,
    progress: &'a Progress,
}

/// A field to go on from.
struct InitField<'a> {
    input: &'a GivenInput,
    members: u32,
}

impl<'a> InitField<'a> {
    /// Reads what it says of itself, which must be what is to be trained.
    fn read(input: &'a GivenInput, wanted: &FieldFile) -> anyhow::Result<Self> {
        let file: FieldFile = input.read_json(FIELD_FILE)?;
        file.check().map_err(|reason| Failure::BadInput(format!("{}: {reason}", input.path(FIELD_FILE).display())))?;
        let differs = [
            ("lies elsewhere; train both from one prep", file.bounds != wanted.bounds),
            ("has another background; train both from one prep", file.background != wanted.background),
            ("is made of something else than the parameters ask for; give those it was trained with", file.field != wanted.field),
        ];
        match differs.iter().find(|(_, differs)| *differs) {
            Some((what, _)) => Err(Failure::BadInput(format!("input init: it {what}")).into()),
            None => Ok(Self { input, members: file.members }),
        }
    }

    /// Weights of a member; where it has fewer of them, they are gone on from in turn.
    fn member(&self, index: u32) -> PathBuf {
        self.input.path(&FieldFile::member(index % self.members))
    }

    /// Writes all of its members before those of `file`, and returns how many they are.
    fn keep_beside(&self, context: &Context, file: &mut FieldFile) -> anyhow::Result<u32> {
        file.members += self.members;
        file.check().map_err(|reason| {
            let message =
                format!("parameter ensemble: {reason} with those of input init; lower it, or set combine to average_weights");
            Failure::Usage(message)
        })?;
        for index in 0..self.members {
            std::fs::copy(self.member(index), context.output_path(&FieldFile::member(index))?)
                .context("cannot keep input init")?;
        }
        Ok(self.members)
    }
}

/// Photographs to train on, each with its view: premultiplied RGBA as they are read, or over the background.
#[derive(Clone, Debug)]
pub struct Photographs {
    /// Where they were taken from.
    pub views: Views,
    /// One for each view, of its camera's size.
    pub images: Vec<Photograph>,
}

impl Photographs {
    /// Reads those of an input.
    pub fn read(input: &artifact::GivenInput) -> anyhow::Result<Self> {
        Self::read_first(input, usize::MAX)
    }

    /// Reads so many of them, the first.
    pub fn read_first(input: &artifact::GivenInput, most: usize) -> anyhow::Result<Self> {
        let mut views = Views::read(input)?;
        views.views.truncate(most);
        let images = read_images(input, &views)?;
        Ok(Self { views, images })
    }

    /// Over the background, but where that is open.
    fn over_background(self) -> Self {
        let background = self.views.background;
        if background == scene::Background::Alpha {
            return self;
        }
        let images = self.images.into_iter().map(|photograph| photograph.over(background.shown())).collect();
        Self { images, ..self }
    }
}

fn read_images(input: &artifact::GivenInput, views: &Views) -> anyhow::Result<Vec<Photograph>> {
    let read = |view: &scene::View| -> anyhow::Result<Photograph> {
        let (name, k) = (&view.camera.name, view.camera.intrinsics);
        let place = input.folder().display();
        let photograph = view.read_photograph(input).bad_input(&place)?;
        let photograph = photograph.with_context(|| format!("view {name}: it has no image")).bad_input(&place)?;
        let (width, height) = (photograph.image.width, photograph.image.height);
        if (width, height) != (k.width as usize, k.height as usize) {
            let message = format!("{place}: view {name}: {width}×{height} pixels where its camera has {}×{}", k.width, k.height);
            return Err(Failure::BadInput(message).into());
        }
        Ok(photograph)
    };
    views.views.iter().map(read).collect()
}

/// What to say to a parameter that an open background leaves no meaning.
fn open_background(parameter: &str) -> String {
    let problem = match parameter {
        "supervision" => "kernel needs a background to render on; choose refiltered, or prep.background white",
        "exposure" => "what shines through an open background has none; choose prep.background white or opaque",
        _ => "photographs with an open background can't be compared with renderings; choose prep.background white or opaque",
    };
    format!("parameter {parameter}: {problem}")
}

/// What the field is compared with, by the parameters and by what the input says of its own making. What is wrong with a reference is said.
pub fn supervision(
    input: &artifact::GivenInput,
    params: &Resolved,
    photographs: Photographs,
    references: Option<Photographs>,
    say: &dyn Fn(String),
) -> anyhow::Result<Supersampling> {
    let background = photographs.views.background;
    if references.as_ref().is_some_and(|references| references.views.background != background) {
        let message = "input references: another background than the scene's; have one prep make both";
        return Err(Failure::BadInput(message.to_owned()).into());
    }
    if photographs.images.iter().all(|p| p.mask.as_ref().is_some_and(|mask| mask.share() == 0.0)) {
        return Err(Failure::BadInput("scene: masks leave no pixel of any photograph; white is what counts".to_owned()).into());
    }
    let known = input.path(DEGRADATION_FILE).exists();
    let made: Option<Degradation> = if known { Some(input.read_json(DEGRADATION_FILE)?) } else { None };
    let is_open = background == scene::Background::Alpha;
    let supervision = params.supervision;
    if supervision != Supervision::Average && made.is_none() {
        let message = format!("parameter supervision: the scene has no {DEGRADATION_FILE} that names its kernel; choose average");
        return Err(Failure::Usage(message).into());
    }
    let closed = [
        ("supervision", supervision == Supervision::Kernel),
        ("pose_refinement", params.pose_refinement),
        ("exposure", params.exposure),
    ];
    if let Some((parameter, _)) = closed.iter().find(|(_, asked)| is_open && *asked) {
        return Err(Failure::Usage(open_background(parameter)).into());
    }
    let kernel = made.map_or(Kernel::Lanczos, |d| d.kernel);
    let references = references.map(|references| references::checked(references, &photographs, kernel, say));
    let options = SupersamplingOptions {
        supervision,
        scale: [params.supersample; 2],
        filter: kernel.filter(),
        supersample_warmup: params.supersample_warmup,
        order: params.order,
        precrop_bundles: params.precrop_bundles(),
        pixel_importance: params.pixel_importance,
        exposure: params.exposure,
        pose_refinement: params.pose_refinement,
        seed: params.seed,
    };
    Ok(Supersampling::new(photographs.over_background(), references.map(Photographs::over_background), &options))
}

fn read_hull(path: &std::path::Path) -> anyhow::Result<Vec<u8>> {
    let bytes = std::fs::read(path).bad_input(path.display())?;
    let tensors = safetensors::SafeTensors::deserialize(&bytes).bad_input(path.display())?;
    let hull = tensors.tensor("hull").bad_input(path.display())?;
    if hull.data().len() != 128 * 128 * 128 {
        return Err(Failure::BadInput(format!("{}: a hull of 128³ cells is expected", path.display())).into());
    }
    Ok(hull.data().to_vec())
}

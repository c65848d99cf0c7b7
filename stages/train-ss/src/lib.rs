//! `train-ss`: supersampled training of a radiance field from LR images (NeRF-SR, section "Supersampling").
//!
//! * [`Params`]: the stage's parameters; `supersample: 1` is plain NeRF on the same images.
//! * [`Supersampling`]: what rays are cast and what their colours are compared with: the paper's average (its eq. 4), or the
//!   kernel that made the LR images.
//! * `memory`: the field's HR pixels as last rendered, by which the kernel is known without casting its whole footprint.
//! * `checkpoint`: what makes a killed run end in the same bytes.

mod checkpoint;
mod memory;
mod supervision;

use std::path::PathBuf;

use anyhow::Context as _;
use artifact::{Context, Failure, FailureExt as _, Input, Output, Stage};
use pixels::{DEGRADATION_FILE, Degradation, Filter, Picture, read_premultiplied};
use radiance::{Architecture, FIELD_FILE, Field, FieldFile, FieldKind, Trainer, TrainingError, TrainingOptions};
use scene::{Bounds, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use checkpoint::Checkpoints;
pub use supervision::{Supersampling, SupersamplingOptions, Supervision};

/// Parameters of `train-ss`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Which field.
    pub field: FieldKind,
    /// Sub-rays along each side of an LR pixel, the paper's s; 1 is plain NeRF. It needn't be the scale at which views will be
    /// rendered: few sub-rays leave more of the budget for other pixels. For `kernel`, the HR pixels along each side; where that
    /// isn't whole, sub-rays are cast for the next whole number.
    #[schemars(range(min = 1.0, max = 16.0))]
    pub supersample: f64,
    /// Share of the rays during which fewer sub-rays are cast: one, then two a side and so on, doubling up to `supersample`. Coarse
    /// pixels teach the rough shape from more views in the same time.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub coarse: f64,
    /// What an LR pixel is compared with. Without it: `kernel` where the scene says what made it and has a background, else
    /// `average`.
    pub supervision: Option<Supervision>,
    /// Where a sub-ray passes its share of the pixel: at the centre, as in the paper, or anywhere.
    pub jitter: bool,
    /// How many fields to train apart, each with its share of the rays: what they render is averaged, and so is what each of them
    /// makes up where the pictures leave it open. Member m is what `seed` + m gives alone.
    #[schemars(range(min = 1, max = 16))]
    pub members: u32,
    /// Rays to train with, sub-rays counted each, over all members.
    #[schemars(range(min = 1))]
    pub rays: u64,
    /// Most rays in a step.
    #[schemars(range(min = 1, max = 1_048_576))]
    pub batch: u32,
    /// Samples a step aims at while space is full of fog and rays are expensive.
    #[schemars(range(min = 1024, max = 16_777_216))]
    pub samples: u32,
    /// Highest learning rate of the grid's coarsest level.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub rate: f64,
    /// Learning rate of a level over that of the next coarser one: below 1 what is coarse explains the pictures first.
    #[schemars(range(min = 0.01, max = 2.0))]
    pub level_rate: f64,
    /// Highest learning rate of the networks.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub network_rate: f64,
    /// Learning rates at the end, as a share of the highest; they fall exponentially.
    #[schemars(range(min = 1e-6, max = 1.0))]
    pub final_rate: f64,
    /// Share that the weights' running average keeps at each of its steps, late in the training; 0 for the last weights.
    #[schemars(range(min = 0.0, max = 0.999))]
    pub averaging: f64,
    /// Weight decay of the grid.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub grid_decay: f64,
    /// Weight decay of the networks.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub network_decay: f64,
    /// Levels of the grid.
    #[schemars(range(min = 1, max = 16))]
    pub levels: u32,
    /// Cells along an axis of the coarsest level.
    #[schemars(range(min = 2, max = 512))]
    pub coarsest: u32,
    /// Cells along an axis of the finest level. Without it: 2.56 for every LR pixel across, at least `coarsest`.
    #[schemars(range(min = 2, max = 4096))]
    pub finest: Option<u32>,
    /// Base-2 logarithm of the most entries in a level. Without it: 17 for 256 cells along the finest level's axis, and two more
    /// for every doubling of those, since surfaces grow with the square.
    #[schemars(range(min = 8, max = 22))]
    pub log2_entries: Option<u32>,
    /// Width of the networks' hidden layers.
    #[schemars(range(min = 16, max = 128))]
    pub hidden: u32,
    /// Samples along the diagonal of the scene's cube.
    #[schemars(range(min = 16, max = 8192))]
    pub steps: u32,
    /// Seed of everything that is drawn.
    pub seed: u64,
}

impl Default for Params {
    fn default() -> Self {
        let grid = Architecture::default();
        Self {
            field: FieldKind::Grid,
            supersample: 2.0,
            coarse: 0.3,
            supervision: None,
            jitter: false,
            members: 1,
            rays: 30_000_000,
            batch: 2_048,
            samples: 32_768,
            rate: 4e-2,
            level_rate: 0.8,
            network_rate: 1e-2,
            final_rate: 0.25,
            averaging: 0.97,
            grid_decay: 0.0,
            network_decay: 1e-6,
            levels: grid.levels,
            coarsest: grid.coarsest,
            finest: None,
            log2_entries: None,
            hidden: grid.hidden,
            steps: grid.steps,
            seed: 0,
        }
    }
}

impl Params {
    /// What field they ask for, with LR images of a width.
    pub fn architecture(&self, lr_width: u32) -> Architecture {
        let by_width = (2.56 * f64::from(lr_width)).round().clamp(64.0, 2048.0) as u32;
        let finest = self.finest.unwrap_or(by_width.max(self.coarsest));
        let by_finest = (17.0 + 2.0 * (f64::from(finest) / 256.0).log2()).round().clamp(14.0, 20.0) as u32;
        Architecture {
            levels: self.levels,
            coarsest: self.coarsest,
            finest,
            log2_entries: self.log2_entries.unwrap_or(by_finest),
            hidden: self.hidden,
            steps: self.steps,
        }
    }

    /// Parameters by which a member is trained, as if it were alone.
    pub fn member(&self, index: u32) -> Self {
        let members = u64::from(self.members.max(1));
        let rays = self.rays / members + u64::from(u64::from(index) < self.rays % members);
        Self { members: 1, rays, seed: self.seed.wrapping_add(u64::from(index)), ..self.clone() }
    }

    /// How they ask for a field to be trained.
    pub fn options(&self) -> TrainingOptions {
        TrainingOptions {
            rays: self.rays,
            batch: self.batch as usize,
            samples: self.samples as usize,
            rate: self.rate,
            level_rate: self.level_rate,
            network_rate: self.network_rate,
            final_rate: self.final_rate,
            warm_up: 100,
            averaging: self.averaging as f32,
            grid_decay: self.grid_decay as f32,
            network_decay: self.network_decay as f32,
            seed: self.seed,
        }
    }
}

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
    /// PSNR of training pixels against rays, about a hundred points a member.
    pub curve: Vec<CurvePoint>,
}

impl TrainingLog {
    /// Appends another training's.
    fn add(&mut self, next: TrainingLog) {
        let samples = self.samples_per_ray * self.rays as f64 + next.samples_per_ray * next.rays as f64;
        let before = self.rays;
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

/// The stage.
pub struct TrainSs;

impl Stage for TrainSs {
    type Params = Params;
    const NAME: &'static str = "train-ss";
    const SUMMARY: &'static str = "Trains a radiance field from LR images by supersampling.";

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![("scene", Input::required(&["scene/train"], "LR images with cameras and bounds"))]
    }

    fn output() -> Output {
        Output::kind("field")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        if let Some(finest) = params.finest.filter(|f| *f < params.coarsest) {
            let message = format!("parameter coarsest: {} is above finest = {finest}", params.coarsest);
            return Err(Failure::Usage(message).into());
        }
        let input = context.input("scene")?;
        let views = Views::read(input)?;
        let architecture = params.architecture(views.views[0].camera.intrinsics.width);
        let progress = context.progress("training", params.rays);
        let mut log = TrainingLog::default();
        for index in 0..params.members {
            let member = Member::new(context, params, index)?;
            let own = match member.finished(architecture, views.bounds) {
                Some(own) => own,
                None => member.train(input, &views, architecture, &progress)?,
            };
            log.add(own);
            progress.set(log.rays, "");
        }
        let Params { field, members, .. } = *params;
        let file = FieldFile { field, members, architecture, bounds: views.bounds, background: views.background };
        context.write_json(FIELD_FILE, &file)?;
        context.write_json("training.json", &log)?;
        let psnr = log.curve.last().map_or(0.0, |p| p.psnr);
        context.write_summary(&format!(
            "{:.1} M rays in {} steps, {:.1} samples a ray, training PSNR {psnr:.2} dB",
            log.rays as f64 / 1e6,
            log.steps,
            log.samples_per_ray
        ))
    }
}

/// LR pictures as the supervision wants them: over the background, or RGBA premultiplied where it is open.
pub fn read_pictures(input: &artifact::GivenInput, views: &Views) -> anyhow::Result<Vec<Picture>> {
    let read = |view: &scene::View| -> anyhow::Result<Picture> {
        let name = view.image.as_ref().with_context(|| format!("view {}: it has no image", view.camera.name));
        let path = input.path(name.bad_input("scene")?);
        let picture = read_premultiplied(&path).bad_input("scene")?;
        let k = view.camera.intrinsics;
        if (picture.width, picture.height) != (k.width as usize, k.height as usize) {
            let message = format!(
                "{}: {}×{} pixels where its camera has {}×{}",
                path.display(),
                picture.width,
                picture.height,
                k.width,
                k.height
            );
            return Err(Failure::BadInput(message).into());
        }
        let is_open = views.background == scene::Background::Alpha;
        Ok(if is_open { picture } else { picture.over(views.background.shown()) })
    };
    views.views.iter().map(read).collect()
}

/// What the field is compared with, by the parameters and by what the input says of its own making.
pub fn supervision(
    input: &artifact::GivenInput,
    params: &Params,
    views: &Views,
    pictures: Vec<Picture>,
) -> anyhow::Result<Supersampling> {
    let known = input.path(DEGRADATION_FILE).exists();
    let made: Option<Degradation> = if known { Some(input.read_json(DEGRADATION_FILE)?) } else { None };
    let is_open = views.background == scene::Background::Alpha;
    let best = if made.is_some() && !is_open { Supervision::Kernel } else { Supervision::Average };
    let supervision = params.supervision.unwrap_or(best);
    if supervision != Supervision::Average && made.is_none() {
        let message = format!("parameter supervision: the scene has no {DEGRADATION_FILE} that names its kernel; choose average");
        return Err(Failure::Usage(message).into());
    }
    if supervision == Supervision::Kernel && is_open {
        let message =
            "parameter supervision: kernel needs a background to render on; choose refiltered, or prep.background white";
        return Err(Failure::Usage(message.to_owned()).into());
    }
    let options = SupersamplingOptions {
        supervision,
        scale: [params.supersample; 2],
        filter: made.map_or(Filter::Lanczos, |d| d.kernel.filter()),
        coarse: params.coarse,
        jitter: params.jitter,
        seed: params.seed,
    };
    Ok(Supersampling::new(views, pictures, &options))
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

/// A field that is trained alone, with its checkpoints in a folder of its own.
struct Member<'a> {
    context: &'a Context,
    params: Params,
    /// Where its weights go.
    output: PathBuf,
    work: Option<PathBuf>,
    /// Rays of the members before it.
    before: u64,
}

/// In a member's folder: its weights once it is trained, and its log, which is written last.
const DONE_WEIGHTS: &str = "field.safetensors";
const DONE_LOG: &str = "training.json";

impl<'a> Member<'a> {
    fn new(context: &'a Context, params: &Params, index: u32) -> anyhow::Result<Self> {
        let output = context.output_path(&FieldFile::member(index))?;
        let work = context.work().map(|w| w.join(format!("member-{index}")));
        if let Some(work) = &work {
            std::fs::create_dir_all(work).with_context(|| format!("cannot make {}", work.display()))?;
        }
        let before = (0..index).map(|i| params.member(i).rays).sum();
        Ok(Self { context, params: params.member(index), output, work, before })
    }

    /// What an earlier run finished, if anything: its weights go to the output.
    fn finished(&self, architecture: Architecture, bounds: Bounds) -> Option<TrainingLog> {
        let work = self.work.as_ref()?;
        let log = serde_json::from_slice(&std::fs::read(work.join(DONE_LOG)).ok()?).ok()?;
        let field = Field::read(&work.join(DONE_WEIGHTS), architecture, bounds).ok()?;
        field.write(&self.output).ok()?;
        Some(log)
    }

    /// Trains to the end, with checkpoints, progress and a curve.
    fn train(
        &self,
        input: &artifact::GivenInput,
        views: &Views,
        architecture: Architecture,
        progress: &artifact::Progress,
    ) -> anyhow::Result<TrainingLog> {
        let (context, params) = (self.context, &self.params);
        let mut supervision = supervision(input, params, views, read_pictures(input, views)?)?;
        let (total, group) = (params.rays, supervision.full_side().iter().product::<usize>());
        if total < group as u64 {
            let message = format!("parameter rays: {total} for a field is less than the {group} of one pixel");
            return Err(Failure::Usage(message).into());
        }
        let mut trainer = Trainer::new(Field::new(architecture, views.bounds, params.seed), params.options());
        if let Some(hull) = &views.hull {
            trainer.limit_to_hull(&read_hull(&input.path(hull))?);
        }
        let mut checkpoints = Checkpoints::new(self.work.as_deref());
        let mut curve = checkpoints.resume(&mut trainer, &mut supervision, |text| context.say(text));
        loop {
            if context.interrupted() {
                checkpoints.write(&trainer, &supervision, &curve).context("cannot write the checkpoint")?;
                return Err(Failure::Interrupted.into());
            }
            let report = trainer.step(&mut supervision).map_err(|e| match e {
                TrainingError::NotFinite { .. } => anyhow::Error::from(Failure::Numerical(e.to_string())),
            })?;
            let Some(report) = report else { break };
            if report.skipped {
                context.say(format!(
                    "step {}: something wasn't finite; the step was thrown away and the rate halved",
                    trainer.steps()
                ));
            }
            let rays = trainer.rays_done();
            curve.add(&report, rays, total);
            progress.set(self.before + rays, &curve.note());
            checkpoints.write_when_due(&trainer, &supervision, &curve).context("cannot write the checkpoint")?;
        }
        let log = curve.finish(trainer.steps(), trainer.rays_done());
        let field = trainer.finish();
        if !field.is_finite() {
            return Err(Failure::Numerical(format!("step {}: a parameter is not finite; lower the rate", log.steps)).into());
        }
        field.write(&self.output).context("cannot write the field")?;
        if let Some(work) = &self.work {
            field.write(&work.join(DONE_WEIGHTS)).context("cannot write the field")?;
            artifact::write_json(&work.join(DONE_LOG), &log)?;
        }
        Ok(log)
    }
}

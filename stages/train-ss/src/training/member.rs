use std::path::{Path, PathBuf};

use anyhow::Context as _;
use artifact::{Failure, GivenInput};
use fields::{FieldFile, FieldModel};
use poses::MeanMotion;
use radiance::{TRAINING_FILE, TrainingLog};
use scene::{Bounds, Views};
use stage::{Context, Progress};

use super::checkpoint::{Checkpoints, Curve, read_latest};
use super::field_trainer::{FieldTrainer, new_trainer};
use super::time_left::{TimeLeft, TrainingRays};
use crate::params::{Combine, Exposure, Resolved};
use crate::supervision::{Supersampling, set_up_supervision};

/// Inputs of a training run, and its progress bar.
#[derive(Clone, Copy)]
pub(crate) struct TrainingData<'a> {
    pub(crate) input: &'a GivenInput,
    pub(crate) references: Option<&'a GivenInput>,
    pub(crate) views: &'a Views,
    /// Mask of the occupancy cells that may become occupied; `None` for all.
    pub(crate) cells: Option<&'a [bool]>,
    pub(crate) progress: &'a Progress,
    /// Number of rays of all trainings.
    pub(crate) total_rays: u64,
}

/// Training in progress.
struct Training {
    trainer: Box<dyn FieldTrainer>,
    supervision: Supersampling,
    checkpoints: Checkpoints,
    curve: Curve,
}

/// Reason for the end of a training's steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    /// All rays are cast.
    Complete,
    /// The photographs' exposures differ, and aren't estimated.
    ExposuresDiffer,
}

/// Field of an ensemble, with checkpoints in a folder of its own.
#[derive(Clone)]
pub(crate) struct Member<'a> {
    pub(super) context: &'a Context,
    pub(super) params: Resolved,
    pub(super) model: FieldModel,
    /// Weights to initialise the field from, and their combination with the trained ones.
    init: Option<(PathBuf, Combine)>,
    /// Path of the field's weights.
    pub(super) output: PathBuf,
    work: Option<PathBuf>,
    /// Number of rays of the trainings before this one, for the progress.
    rays_before: u64,
}

/// File name of a trained member's weights in the member's work folder.
const DONE_WEIGHTS: &str = "field.safetensors";

impl<'a> Member<'a> {
    pub(crate) fn new(
        context: &'a Context,
        params: Resolved,
        (model, init): (FieldModel, Option<(PathBuf, Combine)>),
        index: u32,
        rays_before: u64,
    ) -> anyhow::Result<Self> {
        let output = context.output_path(&FieldFile::member_file(index))?;
        let work = context.work().map(|w| w.join(format!("member-{index}")));
        Ok(Self { context, params, model, init, output, work, rays_before })
    }

    /// Returns a copy with or without pose refinement, with checkpoints in the subfolder `name` and
    /// weights at `output`. The copy is trained after `more_rays` further rays of other trainings.
    pub(crate) fn variant(
        &self,
        pose_refinement: bool,
        name: &str,
        output: PathBuf,
        more_rays: u64,
    ) -> Self {
        Self {
            params: Resolved { pose_refinement, ..self.params.clone() },
            output,
            work: self.work.as_ref().map(|work| work.join(name)),
            rays_before: self.rays_before + more_rays,
            ..self.clone()
        }
    }

    /// Trains the field unless an earlier run has.
    pub(crate) fn run(&self, data: &TrainingData<'_>) -> anyhow::Result<TrainingLog> {
        if let Some(log) = self.copy_finished() {
            self.context.log_line("using the field that an earlier run trained");
            return Ok(log);
        }
        self.train(data)
    }

    /// Writes the weights of the latest checkpoint of all members, and returns that member's log.
    pub(crate) fn write_checkpoint_weights(&self, bounds: Bounds) -> anyhow::Result<TrainingLog> {
        let work = self.context.work().context("--from-checkpoint needs --work")?;
        let mut trainer = self.new_trainer(bounds, None)?;
        let curve = read_latest(work, &mut *trainer).ok_or_else(|| {
            Failure::BadInput(format!("--work {}: no complete checkpoint yet", work.display()))
        })?;
        let log = curve.finish(trainer.state());
        self.write_weights(trainer)?;
        Ok(log)
    }

    /// Copies an earlier run's finished weights to the output, and returns the training's log;
    /// `None` if there are none.
    fn copy_finished(&self) -> Option<TrainingLog> {
        let work = self.work.as_ref()?;
        let log = serde_json::from_slice(&std::fs::read(work.join(TRAINING_FILE)).ok()?).ok()?;
        std::fs::copy(work.join(DONE_WEIGHTS), &self.output).ok()?;
        Some(log)
    }

    /// Trains the field to the end, with checkpoints, progress and a curve. If the photographs'
    /// exposures turn out to differ, starts over and estimates exposures: the field has begun to
    /// explain the differences by floaters (design note 026).
    fn train(&self, data: &TrainingData<'_>) -> anyhow::Result<TrainingLog> {
        let with_exposures = self.with_exposures();
        if self.params.exposure == Exposure::ByScene && with_exposures.has_started() {
            return with_exposures.run(data);
        }
        let mut training = self.start(data)?;
        if self.take_steps(&mut training, data)? == Outcome::ExposuresDiffer {
            drop(training);
            return with_exposures.run(data);
        }
        self.finish(training)
    }

    /// Returns a copy that estimates exposures, with its checkpoints in a subfolder, which also
    /// marks the measurement as done.
    fn with_exposures(&self) -> Self {
        let mut member = self.clone();
        member.params.exposure = Exposure::On;
        member.work = self.work.as_ref().map(|work| work.join("exposures"));
        member
    }

    /// Returns the folder of the file of training pixels.
    fn pixel_folder(&self) -> &Path {
        let folder = self.work.as_deref().or_else(|| self.output.parent());
        folder.unwrap_or(Path::new("."))
    }

    /// True if an earlier run has started this training.
    fn has_started(&self) -> bool {
        self.work.as_ref().is_some_and(|work| work.is_dir())
    }

    /// Returns the mask of the cells that silhouettes leave. While cameras move, their silhouettes
    /// would empty wrong cells.
    fn known_cells<'d>(&self, data: &TrainingData<'d>) -> Option<&'d [bool]> {
        data.cells.filter(|_| !self.params.pose_refinement)
    }

    /// Starts training, or resumes from the last checkpoint in the work folder.
    fn start(&self, data: &TrainingData<'_>) -> anyhow::Result<Training> {
        let (params, work) = (&self.params, self.work.as_deref());
        let TrainingData { input, references, views, .. } = *data;
        let folder = self.pixel_folder();
        if let Some(work) = work {
            std::fs::create_dir_all(work)
                .with_context(|| format!("cannot create {}", work.display()))?;
        }
        let log = |text: String| self.context.log_line(text);
        let mut supervision =
            set_up_supervision(input, params, references, folder, work.is_some(), &log)?;
        let bundle: usize = supervision.supersample().iter().product();
        if params.rays < bundle as u64 {
            let message = format!(
                "parameter rays: {} rays for each field, but one LR pixel needs {bundle}; raise \
                rays, or lower ensemble or supersample",
                params.rays
            );
            return Err(Failure::Usage(message).into());
        }
        let cells = self.known_cells(data);
        let checkpoints = Checkpoints::new(work);
        let (trainer, curve) =
            checkpoints.resume(|| self.new_trainer(views.bounds, cells), &mut supervision, log)?;
        Ok(Training { trainer, supervision, checkpoints, curve })
    }

    /// Takes steps until all rays are cast or exposures turn out to differ, with checkpoints and
    /// progress.
    fn take_steps(
        &self,
        training: &mut Training,
        data: &TrainingData<'_>,
    ) -> anyhow::Result<Outcome> {
        let total = self.params.rays;
        let Training { trainer, supervision, checkpoints, curve } = training;
        let (is_initialised, has_silhouettes) =
            (self.init.is_some(), self.known_cells(data).is_some());
        let background = data.views.background;
        let mut time_left =
            TimeLeft::new(&self.params, is_initialised, has_silhouettes, background);
        loop {
            let is_interrupted = self.context.is_interrupted();
            checkpoints.write_if_due(is_interrupted, &**trainer, supervision, curve)?;
            let Some(report) = trainer.step(supervision)? else { return Ok(Outcome::Complete) };
            if let Some(error) = supervision.memory.first_error() {
                let folder = self.pixel_folder().display();
                anyhow::bail!(
                    "cannot read or write the training pixels in {folder}: {error}; check the \
                    disk's space and permissions"
                );
            }
            if report.skipped {
                self.context.log_line(format!(
                    "step {}: a value was not finite; step discarded, learning rates halved",
                    trainer.state().steps
                ));
            }
            let rays = trainer.state().rays;
            if let Some(difference) = supervision.exposure_difference(rays as f64 / total as f64) {
                if difference.is_clear() || difference.is_last() {
                    self.context.log_line(difference.to_string());
                }
                if difference.is_clear() {
                    return Ok(Outcome::ExposuresDiffer);
                }
            }
            supervision.refine_poses(rays as f64 / total as f64, || trainer.field())?;
            curve.add(&report, rays, total);
            time_left.add(&report);
            let rays_left = TrainingRays {
                total,
                remaining: total.saturating_sub(rays),
                further: data.total_rays.saturating_sub(self.rays_before + total),
            };
            data.progress.set_seconds_left(time_left.seconds(trainer.state().steps, rays_left));
            data.progress.set(self.rays_before + rays, &curve.last_psnr());
        }
    }

    /// Ends a training: writes the weights, and stores weights and log for a later run.
    fn finish(&self, training: Training) -> anyhow::Result<TrainingLog> {
        let Training { trainer, supervision, curve, .. } = training;
        let mut log = curve.finish(trainer.state());
        if let Some(motion) = supervision.mean_motion(|| trainer.field())? {
            self.context.log_line(format!("cameras have {motion}"));
            if motion.exceeds_usual_error() {
                log.warnings.push(far_warning(&motion));
            }
        }
        log.exposures = supervision.exposures().to_vec();
        log.poses =
            supervision.refined_cameras().iter().map(|camera| camera.camera_to_world).collect();
        self.write_weights(trainer)?;
        if let Some(work) = &self.work {
            std::fs::copy(&self.output, work.join(DONE_WEIGHTS))
                .context("cannot copy the field")?;
            // Written last: the log marks the member as trained.
            artifact::write_json(&work.join(TRAINING_FILE), &log)?;
        }
        Ok(log)
    }

    fn new_trainer(
        &self,
        bounds: Bounds,
        cells: Option<&[bool]>,
    ) -> anyhow::Result<Box<dyn FieldTrainer>> {
        let init = self.init.as_ref().map(|(weights, _)| weights.as_path());
        new_trainer(&self.params, init, bounds, cells, &self.context.device)
    }

    /// Writes the trained weights, averaged with the initial ones if requested.
    fn write_weights(&self, trainer: Box<dyn FieldTrainer>) -> anyhow::Result<()> {
        match &self.init {
            Some((init, Combine::AverageWeights)) => trainer.finish(&self.output, Some(init)),
            _ => trainer.finish(&self.output, None),
        }
    }
}

fn far_warning(moved: &MeanMotion) -> String {
    format!(
        "pose refinement: cameras have {moved}; unless the given poses are that far off, train \
        without pose_refinement"
    )
}

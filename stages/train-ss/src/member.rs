use std::path::{Path, PathBuf};

use anyhow::Context as _;
use artifact::{Failure, GivenInput};
use poses::MeanMotion;
use radiance::{FieldFile, FieldModel};
use scene::{Bounds, Views};
use stage::{Context, Progress};

use crate::checkpoint::{Checkpoints, Curve, read_latest};
use crate::field_trainer::{Collapsed, FieldTrainer, average, start};
use crate::params::Combine;
use crate::resolve::Resolved;
use crate::setup::supervision;
use crate::supervision::Supersampling;
use crate::training_log::TrainingLog;

/// What a training learns from, and where it says how far it is.
#[derive(Clone, Copy)]
pub(crate) struct TrainingData<'a> {
    pub(crate) input: &'a GivenInput,
    pub(crate) references: Option<&'a GivenInput>,
    pub(crate) views: &'a Views,
    pub(crate) progress: &'a Progress,
}

/// A training that has begun.
struct Training {
    trainer: Box<dyn FieldTrainer>,
    supervision: Supersampling,
    checkpoints: Checkpoints,
    curve: Curve,
}

/// A field that is trained alone, with its checkpoints in a folder of its own.
pub(crate) struct Member<'a> {
    context: &'a Context,
    params: Resolved,
    model: FieldModel,
    /// Weights to go on from, and what becomes of them.
    from: Option<(PathBuf, Combine)>,
    /// Where its weights go.
    output: PathBuf,
    work: Option<PathBuf>,
    /// Rays of the members before it.
    before: u64,
}

/// In a member's folder: its weights once it is trained, and its log, which is written last.
const DONE_WEIGHTS: &str = "field.safetensors";
const DONE_LOG: &str = "training.json";

fn far_warning(moved: &MeanMotion) -> String {
    format!(
        "pose refinement: cameras have {moved}, which is far: unless the given poses are that far \
        off, train without it"
    )
}

impl<'a> Member<'a> {
    pub(crate) fn new(
        context: &'a Context,
        params: Resolved,
        (model, from): (FieldModel, Option<(PathBuf, Combine)>),
        index: u32,
        before: u64,
    ) -> anyhow::Result<Self> {
        let output = context.output_path(&FieldFile::member_file(index))?;
        let work = context.work().map(|w| w.join(format!("member-{index}")));
        Ok(Self { context, params, model, from, output, work, before })
    }

    /// Its parameters.
    pub(crate) fn params(&self) -> &Resolved {
        &self.params
    }

    /// Where messages go, and where to compute.
    pub(crate) fn context(&self) -> &Context {
        self.context
    }

    /// What is trained.
    pub(crate) fn model(&self) -> FieldModel {
        self.model
    }

    /// Where its weights go.
    pub(crate) fn output(&self) -> &Path {
        &self.output
    }

    /// The same with or without pose refinement, with checkpoints in a folder of its own, its
    /// weights elsewhere, and so many rays more before it.
    pub(crate) fn variant(
        &self,
        pose_refinement: bool,
        name: &str,
        output: PathBuf,
        more: u64,
    ) -> Self {
        Self {
            context: self.context,
            params: Resolved { pose_refinement, ..self.params.clone() },
            model: self.model,
            from: self.from.clone(),
            output,
            work: self.work.as_ref().map(|work| work.join(name)),
            before: self.before + more,
        }
    }

    /// Trains it, unless an earlier run did; a network that collapses starts over where that is
    /// allowed.
    pub(crate) fn run(&self, data: &TrainingData<'_>) -> anyhow::Result<TrainingLog> {
        if let Some(log) = self.finished() {
            self.context.say("going on from a field that an earlier run has trained");
            return Ok(log);
        }
        let mut said = String::new();
        for restart in 0..=self.params.restarts() {
            let params = Resolved {
                seed: self.params.seed.wrapping_add(u64::from(restart)),
                ..self.params.clone()
            };
            if restart > 0 {
                self.context.say(format!("{said}: starting over with seed {}", params.seed));
            }
            // A folder each, so that a checkpoint goes on with the seed it began with.
            let work = self.work.as_ref().map(|w| {
                if restart == 0 { w.clone() } else { w.join(format!("restart-{restart}")) }
            });
            match self.train(&params, work.as_deref(), data) {
                Err(error) => match error.downcast_ref() {
                    Some(Collapsed(message)) => said.clone_from(message),
                    None => return Err(error),
                },
                done => return done,
            }
        }
        Err(Failure::Numerical(format!("{said}, or let it start over: parameter restarts")).into())
    }

    /// Writes the weights of the latest checkpoint, whichever member it belongs to; its log.
    pub(crate) fn latest_checkpoint(&self, bounds: Bounds) -> anyhow::Result<TrainingLog> {
        let work = self.context.work().context("--from-checkpoint goes with --work")?;
        let mut trainer = self.start(&self.params, bounds)?;
        let curve = read_latest(work, &mut *trainer).ok_or_else(|| {
            Failure::BadInput(format!(
                "--work {}: no complete checkpoint in it yet",
                work.display()
            ))
        })?;
        let log = curve.finish(trainer.steps(), trainer.rays_done());
        self.write_weights(trainer, bounds)?;
        Ok(log)
    }

    /// What an earlier run finished, if anything: its weights go to the output.
    fn finished(&self) -> Option<TrainingLog> {
        let work = self.work.as_ref()?;
        let log = serde_json::from_slice(&std::fs::read(work.join(DONE_LOG)).ok()?).ok()?;
        std::fs::copy(work.join(DONE_WEIGHTS), &self.output).ok()?;
        Some(log)
    }

    /// Trains to the end, with checkpoints, progress and a curve.
    fn train(
        &self,
        params: &Resolved,
        work: Option<&Path>,
        data: &TrainingData<'_>,
    ) -> anyhow::Result<TrainingLog> {
        let mut training = self.begin(params, work, data)?;
        self.take_steps(&mut training, params.rays, data.progress)?;
        self.end(training, data.views.bounds)
    }

    /// Begins a training, or goes on from its last checkpoint in `work`.
    fn begin(
        &self,
        params: &Resolved,
        work: Option<&Path>,
        data: &TrainingData<'_>,
    ) -> anyhow::Result<Training> {
        let TrainingData { input, references, views, .. } = *data;
        let folder = work.unwrap_or_else(|| self.output.parent().unwrap_or(Path::new(".")));
        if let Some(work) = work {
            std::fs::create_dir_all(work)
                .with_context(|| format!("cannot make {}", work.display()))?;
        }
        let say = |text: String| self.context.say(text);
        let mut supervision = supervision(input, params, references, folder, work.is_some(), &say)?;
        let (total, bundle) = (params.rays, supervision.full_side().iter().product::<usize>());
        if total < bundle as u64 {
            let message = format!(
                "parameter rays: {total} for a field is less than the {bundle} of one pixel"
            );
            return Err(Failure::Usage(message).into());
        }
        let mut trainer = self.start(params, views.bounds)?;
        let checkpoints = Checkpoints::new(work);
        let curve =
            checkpoints.resume(&mut *trainer, &mut supervision, |text| self.context.say(text))?;
        Ok(Training { trainer, supervision, checkpoints, curve })
    }

    /// Takes steps until `total` rays are cast, with checkpoints and progress.
    fn take_steps(
        &self,
        training: &mut Training,
        total: u64,
        progress: &Progress,
    ) -> anyhow::Result<()> {
        let Training { trainer, supervision, checkpoints, curve } = training;
        loop {
            if self.context.is_interrupted() {
                checkpoints
                    .write(&**trainer, supervision, curve)
                    .context("cannot write the checkpoint")?;
                return Err(Failure::Interrupted.into());
            }
            let Some(report) = trainer.step(supervision)? else { return Ok(()) };
            if let Some(fault) = supervision.fault() {
                anyhow::bail!("the file that keeps pixels can't be read or written: {fault}");
            }
            if report.skipped {
                self.context.say(format!(
                    "step {}: something wasn't finite; the step was thrown away and the rate \
                    halved",
                    trainer.steps()
                ));
            }
            let rays = trainer.rays_done();
            supervision.refine_poses(rays as f64 / total as f64, || trainer.field())?;
            curve.add(&report, rays, total);
            progress.set(self.before + rays, &curve.note());
            checkpoints
                .write_when_due(&**trainer, supervision, curve)
                .context("cannot write the checkpoint")?;
        }
    }

    /// Ends a training: writes its weights, and keeps them and its log for a later run.
    fn end(&self, training: Training, bounds: Bounds) -> anyhow::Result<TrainingLog> {
        let Training { trainer, supervision, curve, .. } = training;
        let moved = supervision.moved(|| trainer.field())?;
        moved.iter().for_each(|moved| self.context.say(format!("cameras have {moved}")));
        let mut log = curve.finish(trainer.steps(), trainer.rays_done());
        log.exposures = supervision.exposures().to_vec();
        log.poses =
            supervision.refined_cameras().iter().map(|camera| camera.camera_to_world).collect();
        log.warnings = moved.filter(MeanMotion::is_far).iter().map(far_warning).collect();
        self.write_weights(trainer, bounds)?;
        if let Some(work) = &self.work {
            std::fs::copy(&self.output, work.join(DONE_WEIGHTS))
                .context("cannot keep the field")?;
            artifact::write_json(&work.join(DONE_LOG), &log)?;
        }
        Ok(log)
    }

    fn start(&self, params: &Resolved, bounds: Bounds) -> anyhow::Result<Box<dyn FieldTrainer>> {
        let from = self.from.as_ref().map(|(weights, _)| weights.as_path());
        start(params, from, bounds, &self.context.device)
    }

    /// Writes the weights of a training, combined with those it went on from.
    fn write_weights(&self, trainer: Box<dyn FieldTrainer>, bounds: Bounds) -> anyhow::Result<()> {
        trainer.finish(&self.output)?;
        if let Some((from, Combine::AverageWeights)) = &self.from {
            average(self.model, bounds, from, &self.output)
                .context("cannot average the weights")?;
        }
        Ok(())
    }
}

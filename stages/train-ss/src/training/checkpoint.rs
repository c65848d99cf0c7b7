use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use pixels::psnr_of;
use radiance::{CurvePoint, StepReport, TrainingLog, TrainingState};
use serde::{Deserialize, Serialize};
use stage::CheckpointSchedule;

use super::field_trainer::FieldTrainer;
use crate::state::{HrCache, SupervisionState};
use crate::supervision::Supersampling;

/// File name of a trainer's checkpoint.
const CHECKPOINT: &str = "checkpoint.safetensors";
/// Start of the file names of checkpoints' curves and states.
const STATE_PREFIX: &str = "state-";
/// Start of the file names of checkpoints' HR caches.
const CACHE_PREFIX: &str = "cache-";

/// Training curve of an unfinished training. Checkpoints contain all of it, so that a resumed
/// training writes the same curve.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Curve {
    points: Vec<CurvePoint>,
    /// Sum of losses since the last point.
    loss: f64,
    /// Number of steps since the last point.
    steps: u64,
    /// Number of samples of the whole training.
    samples: u64,
}

impl Curve {
    /// Adds a step, and a point for each hundredth of the rays.
    pub(crate) fn add(&mut self, report: &StepReport, rays: u64, total: u64) {
        self.samples += report.samples as u64;
        if !report.skipped {
            self.loss += report.loss;
            self.steps += 1;
        }
        let hundredths = rays * 100 / total;
        let before = self.points.last().map_or(0, |p| p.rays * 100 / total);
        if hundredths > before && self.steps > 0 {
            self.points.push(CurvePoint { rays, psnr: psnr_of(self.loss / self.steps as f64) });
            (self.loss, self.steps) = (0.0, 0);
        }
    }

    /// Returns the last PSNR of the training pixels as text for the progress bar.
    pub(crate) fn last_psnr(&self) -> String {
        let last = self.points.last();
        last.map(|p| format!("PSNR of training pixels {:.2} dB", p.psnr)).unwrap_or_default()
    }

    pub(crate) fn finish(self, state: &TrainingState) -> TrainingLog {
        TrainingLog {
            steps: state.steps,
            rays: state.rays,
            samples_per_ray: self.samples as f64 / state.rays.max(1) as f64,
            curve: self.points,
            ..TrainingLog::default()
        }
    }
}

/// Content of `state-STEP.json`, written from references.
#[derive(Serialize, Deserialize)]
struct SavedState<C = Curve, S = SupervisionState> {
    curve: C,
    supervision: S,
}

/// Checkpoints in the work folder. A checkpoint has three files, written in this order:
/// `state-STEP.json`, the curve and the supervision's state ([`SavedState`]); `cache-STEP.bin`, the
/// HR cache; `checkpoint.safetensors`. The step in the last one decides which of the others belong
/// to it.
pub(crate) struct Checkpoints {
    folder: Option<PathBuf>,
    schedule: CheckpointSchedule,
}

impl Checkpoints {
    pub(crate) fn new(folder: Option<&Path>) -> Self {
        Self { folder: folder.map(Path::to_path_buf), schedule: CheckpointSchedule::default() }
    }

    /// Creates a trainer, and resumes from the checkpoint of an earlier run, if any. An incomplete
    /// checkpoint is logged and skipped, and the training starts over. Fails if a complete one
    /// can't be read.
    pub(crate) fn resume(
        &self,
        new_trainer: impl Fn() -> anyhow::Result<Box<dyn FieldTrainer>>,
        supervision: &mut Supersampling,
        log: impl Fn(String),
    ) -> anyhow::Result<(Box<dyn FieldTrainer>, Curve)> {
        let mut trainer = new_trainer()?;
        let path = self.folder.as_ref().map(|folder| folder.join(CHECKPOINT));
        let Some(path) = path.filter(|path| path.exists()) else {
            return Ok((trainer, Curve::default()));
        };
        let own = &supervision.state;
        let cache_bytes = own.cache.as_ref().map_or(0, HrCache::byte_length) as u64;
        let complete = read_saved(&path, &mut *trainer).and_then(|saved| {
            let cache_path = path.with_file_name(cache_name(trainer.state().steps));
            let cache = File::open(&cache_path).ok()?;
            let is_complete = cache.metadata().ok()?.len() == cache_bytes
                && saved.supervision.view_counts() == own.view_counts();
            is_complete.then_some((saved, cache, cache_path))
        });
        let Some((saved, mut cache, cache_path)) = complete else {
            log(format!("{}: incomplete checkpoint; starting over", path.display()));
            drop(trainer);
            return Ok((new_trainer()?, Curve::default()));
        };
        supervision.restore(saved.supervision, &mut cache).with_context(|| {
            format!("cannot read {}; delete it to start the training over", cache_path.display())
        })?;
        log(format!("resuming from step {}", trainer.state().steps));
        Ok((trainer, saved.curve))
    }

    /// Writes a checkpoint if one is due or the run is interrupted, and there is a work folder.
    /// Then fails if the run is interrupted.
    pub(crate) fn write_if_due(
        &mut self,
        is_interrupted: bool,
        trainer: &dyn FieldTrainer,
        supervision: &Supersampling,
        curve: &Curve,
    ) -> anyhow::Result<()> {
        self.schedule.write_if_due(is_interrupted, || match &self.folder {
            Some(folder) => write(folder, trainer, supervision, curve),
            None => Ok(()),
        })
    }
}

/// Writes a checkpoint and removes the previous one. Each file is replaced atomically: a run
/// interrupted before its first step overwrites the files of the checkpoint from which it resumed.
fn write(
    folder: &Path,
    trainer: &dyn FieldTrainer,
    supervision: &Supersampling,
    curve: &Curve,
) -> anyhow::Result<()> {
    let partial = folder.join("checkpoint.partial");
    let step = trainer.state().steps;
    let files = [state_name(step), cache_name(step)];
    let state = SavedState { curve, supervision: &supervision.state };
    artifact::write_json_atomically(&folder.join(&files[0]), &state)?;
    let mut cache_file = File::create(&partial)?;
    if let Some(cache) = &supervision.state.cache {
        cache.write(&mut cache_file)?;
    }
    publish(&partial, &folder.join(&files[1]))?;
    trainer.write_checkpoint(&partial)?;
    publish(&partial, &folder.join(CHECKPOINT))?;
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        let file = entry.file_name().to_string_lossy().into_owned();
        let is_part = file.starts_with(STATE_PREFIX) || file.starts_with(CACHE_PREFIX);
        if is_part && !files.contains(&file) {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

/// Renames a complete file after its bytes are on the disk.
fn publish(partial: &Path, path: &Path) -> std::io::Result<()> {
    File::open(partial)?.sync_all()?;
    std::fs::rename(partial, path)
}

/// Restores a trainer from the latest checkpoint below a work folder, and returns the checkpoint's
/// curve. Returns `None` if there is no checkpoint, or if the latest is incomplete, for example
/// while a new checkpoint replaces it.
pub(crate) fn read_latest(work: &Path, trainer: &mut dyn FieldTrainer) -> Option<Curve> {
    let files = walkdir::WalkDir::new(work).sort_by_file_name().into_iter().flatten();
    let latest = files
        .filter(|entry| entry.file_name() == CHECKPOINT)
        .max_by_key(|entry| entry.metadata().ok().and_then(|metadata| metadata.modified().ok()))?;
    read_saved(latest.path(), trainer).map(|saved| saved.curve)
}

/// Returns the file name of a step's [`SavedState`].
fn state_name(step: u64) -> String {
    format!("{STATE_PREFIX}{step}.json")
}

/// Returns the file name of a step's HR cache.
fn cache_name(step: u64) -> String {
    format!("{CACHE_PREFIX}{step}.bin")
}

/// Restores a trainer, and reads the checkpoint's curve and state; `None` if the checkpoint is
/// incomplete, in which case the trainer may have been restored.
fn read_saved(checkpoint: &Path, trainer: &mut dyn FieldTrainer) -> Option<SavedState> {
    if !trainer.resume(checkpoint) {
        return None;
    }
    let state = checkpoint.with_file_name(state_name(trainer.state().steps));
    serde_json::from_slice(&std::fs::read(state).ok()?).ok()
}

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use pixels::psnr_of;
use radiance::StepReport;
use serde::{Deserialize, Serialize};

use crate::field_trainer::FieldTrainer;
use crate::supervision::Supersampling;
use crate::training_log::{CurvePoint, TrainingLog};

/// The training curve while it grows. Everything in it is saved, so that a resumed training writes
/// the same one.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Curve {
    points: Vec<CurvePoint>,
    loss: f64,
    steps: u64,
    samples: u64,
}

impl Curve {
    /// About a hundred points: one whenever the next hundredth of the rays is done.
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

    /// The last figure, for the progress bar.
    pub(crate) fn note(&self) -> String {
        self.points.last().map(|p| format!("{:.2} dB", p.psnr)).unwrap_or_default()
    }

    pub(crate) fn finish(self, steps: u64, rays: u64) -> TrainingLog {
        TrainingLog {
            steps,
            rays,
            samples_per_ray: self.samples as f64 / rays.max(1) as f64,
            curve: self.points,
            ..TrainingLog::default()
        }
    }
}

/// Checkpoints in the work folder: `curve-STEP.json` and `kept-STEP.bin`, what the supervision has
/// come to know; then `checkpoint.safetensors`, which says which STEP they belong to.
pub(crate) struct Checkpoints {
    folder: Option<PathBuf>,
    last: Instant,
    took: Duration,
}

impl Checkpoints {
    pub(crate) fn new(folder: Option<&Path>) -> Self {
        Self {
            folder: folder.map(Path::to_path_buf),
            last: Instant::now(),
            took: Duration::from_millis(20),
        }
    }

    /// Loads what an earlier run left. A checkpoint that isn't whole is said and left out: the
    /// training starts over. Fails where the system can't read the file of a whole one.
    pub(crate) fn resume(
        &self,
        trainer: &mut dyn FieldTrainer,
        supervision: &mut Supersampling,
        say: impl Fn(&str),
    ) -> anyhow::Result<Curve> {
        let Some(folder) = &self.folder else { return Ok(Curve::default()) };
        let path = folder.join(CHECKPOINT);
        if !path.exists() {
            return Ok(Curve::default());
        }
        let found = whole_checkpoint(folder, &path, trainer).and_then(|(step, curve)| {
            let kept = std::fs::File::open(folder.join(kept_name(step))).ok()?;
            let is_whole = kept.metadata().ok()?.len() == supervision.learnt.written_len() as u64;
            // A trainer that can't resume is as it was.
            (is_whole && trainer.resume(&path)).then_some((kept, curve))
        });
        let Some((mut kept, curve)) = found else {
            say(&format!("{}: not a whole checkpoint; starting over", path.display()));
            return Ok(Curve::default());
        };
        // Half of it would be neither the earlier training nor a new one.
        supervision.restore(&mut kept).with_context(|| {
            let kept = folder.join(kept_name(trainer.steps()));
            format!("cannot read {}; delete it to start the training over", kept.display())
        })?;
        say(&format!("going on from step {}", trainer.steps()));
        Ok(curve)
    }

    /// Writes a checkpoint when writing costs at most a fiftieth of the time.
    pub(crate) fn write_when_due(
        &mut self,
        trainer: &dyn FieldTrainer,
        supervision: &Supersampling,
        curve: &Curve,
    ) -> anyhow::Result<()> {
        if self.folder.is_some() && self.last.elapsed() > 50 * self.took {
            self.write(trainer, supervision, curve)?;
        }
        Ok(())
    }

    pub(crate) fn write(
        &mut self,
        trainer: &dyn FieldTrainer,
        supervision: &Supersampling,
        curve: &Curve,
    ) -> anyhow::Result<()> {
        let Some(folder) = &self.folder else { return Ok(()) };
        let started = Instant::now();
        let (name, temporary) = (folder.join(CHECKPOINT), folder.join("checkpoint.partial"));
        let step = trainer.steps();
        let own = [curve_name(step), kept_name(step)];
        artifact::write_json(&folder.join(&own[0]), curve)?;
        let mut file = std::fs::File::create(folder.join(&own[1]))?;
        supervision.learnt.write(&mut file)?;
        trainer.write_checkpoint(&temporary)?;
        std::fs::rename(&temporary, &name)?;
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            let file = entry.file_name().to_string_lossy().into_owned();
            if (file.starts_with("curve-") || file.starts_with("kept-")) && !own.contains(&file) {
                std::fs::remove_file(entry.path())?;
            }
        }
        (self.last, self.took) = (Instant::now(), started.elapsed());
        Ok(())
    }
}

const CHECKPOINT: &str = "checkpoint.safetensors";

/// The curve of the latest checkpoint below a work folder, with a trainer as it was then. None
/// where there is no whole checkpoint, as while one gives way to the next.
pub(crate) fn read_latest(work: &Path, trainer: &mut dyn FieldTrainer) -> Option<Curve> {
    let files = walkdir::WalkDir::new(work).sort_by_file_name().into_iter().flatten();
    let latest = files
        .filter(|entry| entry.file_name() == CHECKPOINT)
        .max_by_key(|entry| entry.metadata().ok().and_then(|metadata| metadata.modified().ok()))?;
    let (_, curve) = whole_checkpoint(latest.path().parent()?, latest.path(), trainer)?;
    trainer.resume(latest.path()).then_some(curve)
}

fn curve_name(step: u64) -> String {
    format!("curve-{step}.json")
}

fn kept_name(step: u64) -> String {
    format!("kept-{step}.bin")
}

/// A checkpoint's step and the curve that belongs to it.
fn whole_checkpoint(
    folder: &Path,
    checkpoint: &Path,
    trainer: &dyn FieldTrainer,
) -> Option<(u64, Curve)> {
    let step = trainer.checkpoint_step(checkpoint)?;
    let curve = serde_json::from_slice(&std::fs::read(folder.join(curve_name(step))).ok()?).ok()?;
    Some((step, curve))
}

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use radiance::{StepReport, Trainer};
use serde::{Deserialize, Serialize};

use crate::{CurvePoint, TrainingLog};

/// The training curve while it grows. Everything in it is saved, so that a resumed training writes the same one.
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
            // A loss of exactly 0 has no PSNR; 100 dB stands for it.
            let psnr = (-10.0 * (self.loss / self.steps as f64).log10()).min(100.0);
            self.points.push(CurvePoint { rays, psnr });
            (self.loss, self.steps) = (0.0, 0);
        }
    }

    /// The last figure, for the progress bar.
    pub(crate) fn note(&self) -> String {
        self.points.last().map(|p| format!("{:.2} dB", p.psnr)).unwrap_or_default()
    }

    pub(crate) fn finish(self, steps: u64, rays: u64) -> TrainingLog {
        TrainingLog { steps, rays, samples_per_ray: self.samples as f64 / rays.max(1) as f64, curve: self.points }
    }
}

/// Checkpoints in the work folder: `curve-STEP.json`, then `checkpoint.safetensors`, which says which STEP it belongs to.
pub(crate) struct Checkpoints {
    folder: Option<PathBuf>,
    last: Instant,
    took: Duration,
}

impl Checkpoints {
    pub(crate) fn new(folder: Option<&Path>) -> Self {
        Self { folder: folder.map(Path::to_path_buf), last: Instant::now(), took: Duration::from_millis(20) }
    }

    /// Loads what an earlier run left. What can't be read is said and left out: the training starts over.
    pub(crate) fn resume(&self, trainer: &mut Trainer, say: impl Fn(&str)) -> Curve {
        let Some(folder) = &self.folder else { return Curve::default() };
        let path = folder.join("checkpoint.safetensors");
        if !path.exists() {
            return Curve::default();
        }
        // The curve of the checkpoint's step proves that the pair is whole; look for it before the trainer is touched.
        let step = radiance::Trainer::checkpoint_step(&path);
        let curve = step
            .as_ref()
            .ok()
            .and_then(|step| serde_json::from_slice(&std::fs::read(folder.join(format!("curve-{step}.json"))).ok()?).ok());
        match curve.map(|curve: Curve| trainer.resume(&path).map(|()| curve)) {
            Some(Ok(curve)) => {
                say(&format!("going on from step {}", trainer.steps()));
                curve
            }
            _ => {
                say(&format!("{}: not a whole checkpoint; starting over", path.display()));
                Curve::default()
            }
        }
    }

    /// Writes a checkpoint when writing costs at most a fiftieth of the time.
    pub(crate) fn write_when_due(&mut self, trainer: &Trainer, curve: &Curve) -> anyhow::Result<()> {
        if self.folder.is_some() && self.last.elapsed() > 50 * self.took {
            self.write(trainer, curve)?;
        }
        Ok(())
    }

    pub(crate) fn write(&mut self, trainer: &Trainer, curve: &Curve) -> anyhow::Result<()> {
        let Some(folder) = &self.folder else { return Ok(()) };
        let started = Instant::now();
        let (name, temporary) = (folder.join("checkpoint.safetensors"), folder.join("checkpoint.partial"));
        let own_curve = format!("curve-{}.json", trainer.steps());
        artifact::write_json(&folder.join(&own_curve), curve)?;
        trainer.write_checkpoint(&temporary)?;
        std::fs::rename(&temporary, &name)?;
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            let file = entry.file_name();
            if file.to_string_lossy().starts_with("curve-") && file.to_string_lossy() != own_curve {
                std::fs::remove_file(entry.path())?;
            }
        }
        (self.last, self.took) = (Instant::now(), started.elapsed());
        Ok(())
    }
}

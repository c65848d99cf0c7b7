use std::path::Path;

use artifact::{Failure, bail_usage};
use pixels::psnr_of;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{CheckpointSchedule, Context, Input, Output, Stage};

use super::training::{PriorTrainer, TrainingError, TrainingImages};

/// Parameters of `train-prior`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PriorParams {
    /// Factor by which the network enlarges images: 2, 4 or 8.
    pub scale: u32,
    /// Number of training steps.
    #[schemars(range(min = 1))]
    pub steps: u64,
    /// Number of random images, of which one in 64 is left out of training.
    #[schemars(range(min = 2, max = 100_000))]
    pub images: u64,
    /// Seed of all random numbers.
    pub seed: u64,
}

impl Default for PriorParams {
    fn default() -> Self {
        Self { scale: 4, steps: 3_600, images: 1_500, seed: 0 }
    }
}

/// Stage `train-prior`.
pub struct TrainPrior;

/// Steps between two progress reports; chosen by hand.
const STEPS_PER_REPORT: u64 = 20;

impl Stage for TrainPrior {
    type Params = PriorParams;
    const NAME: &'static str = "train-prior";
    const SUMMARY: &'static str = "Trains upsample's network on random images, for method prior.";

    fn inputs() -> Vec<(&'static str, Input)> {
        Vec::new()
    }

    fn output() -> Output {
        Output::kind("weights")
    }

    fn run(context: &Context, params: &PriorParams) -> anyhow::Result<()> {
        nets::deterministic();
        if ![2, 4, 8].contains(&params.scale) {
            bail_usage!("parameter scale: expected 2, 4 or 8, found {}", params.scale);
        }
        let scale = params.scale as usize;
        context.log_line(format!("drawing {} images", params.images));
        let images =
            TrainingImages::draw(params.seed, params.images, scale, || context.check_interrupt())?;
        let mut trainer = PriorTrainer::new(scale, params.steps, params.seed)?;
        let checkpoint = context.work().map(|work| work.join("checkpoint.safetensors"));
        if let Some(path) = checkpoint.as_deref().filter(|path| path.exists()) {
            match trainer.resume(path) {
                Ok(()) => context.log_line(format!("resuming from step {}", trainer.steps())),
                Err(error) => context.log_line(format!("{error}; starting over")),
            }
        }
        train(context, params.steps, &mut trainer, &images, checkpoint.as_deref())?;
        trainer.write(&context.output_path(&format!("prior_x{scale}.safetensors"))?)?;
        let [bicubic, enlarged] = trainer.score(&images)?;
        context.write_summary(&format!(
            "images left out of training: {bicubic:.2} dB bicubic, {enlarged:.2} dB enlarged"
        ))
    }
}

/// Takes the remaining steps and writes checkpoints.
fn train(
    context: &Context,
    steps: u64,
    trainer: &mut PriorTrainer,
    images: &TrainingImages,
    checkpoint: Option<&Path>,
) -> anyhow::Result<()> {
    let progress = context.progress("training", steps);
    let mut schedule = CheckpointSchedule::default();
    let mut error_sum = 0.0;
    loop {
        schedule.write_if_due(context.is_interrupted(), || {
            checkpoint.map_or(Ok(()), |path| write_checkpoint(trainer, path))
        })?;
        let error = trainer.step(images).map_err(|error| match error {
            TrainingError::NotFinite { .. } => Failure::Numerical(error.to_string()).into(),
            error => anyhow::Error::from(error),
        })?;
        let Some(error) = error else { return Ok(()) };
        error_sum += error;
        if trainer.steps().is_multiple_of(STEPS_PER_REPORT) {
            let mean = error_sum / STEPS_PER_REPORT as f64;
            progress.set(trainer.steps(), &format!("PSNR of patches {:.2} dB", psnr_of(mean)));
            error_sum = 0.0;
        }
    }
}

/// Writes a checkpoint and replaces the previous one atomically.
fn write_checkpoint(trainer: &PriorTrainer, path: &Path) -> anyhow::Result<()> {
    let partial = path.with_extension("partial");
    trainer.write_checkpoint(&partial)?;
    Ok(std::fs::rename(partial, path)?)
}

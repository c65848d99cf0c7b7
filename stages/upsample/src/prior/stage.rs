use std::path::Path;

use artifact::Failure;
use pixels::psnr_of;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Stage, Training};

use super::training::{PriorTrainer, TrainingError, TrainingImages};

/// Parameters of `train-prior`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PriorParams {
    /// Factor by which the network enlarges images.
    #[schemars(extend("enum" = [2, 4, 8]))]
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

impl Stage for TrainPrior {
    type Params = PriorParams;
    const NAME: &'static str = "train-prior";
    const SUMMARY: &'static str =
        "Trains the network of upsample's `method: prior` on random images.";

    fn inputs() -> Vec<(&'static str, Input)> {
        Vec::new()
    }

    fn output() -> Output {
        Output::kind("weights")
    }

    fn run(context: &Context, params: &PriorParams) -> anyhow::Result<()> {
        nets::deterministic();
        let scale = params.scale as usize;
        context.log_line(format!("drawing {} images", params.images));
        let images =
            TrainingImages::draw(params.seed, params.images, scale, || context.check_interrupt())?;
        let trainer = PriorTrainer::new(scale, params.steps, params.seed)?;
        let mut training = PriorRun { trainer, images };
        context.train(params.steps, &mut training, |error| {
            format!("PSNR of patches {:.2} dB", psnr_of(error))
        })?;
        let PriorRun { trainer, images } = training;
        trainer.write(&context.output_path(&format!("prior_x{scale}.safetensors"))?)?;
        let [bicubic, enlarged] = trainer.score(&images)?;
        context.write_summary(&format!(
            "images left out of training: {bicubic:.2} dB by bicubic enlargement, {enlarged:.2} dB \
            by the network"
        ))
    }
}

/// Trainer with its images.
struct PriorRun {
    trainer: PriorTrainer,
    images: TrainingImages,
}

impl Training for PriorRun {
    fn steps(&self) -> u64 {
        self.trainer.steps()
    }

    fn step(&mut self) -> anyhow::Result<Option<f64>> {
        self.trainer.step(&self.images).map_err(|error| match error {
            TrainingError::NotFinite { .. } => Failure::Numerical(error.to_string()).into(),
            error => error.into(),
        })
    }

    fn write_checkpoint(&self, path: &Path) -> anyhow::Result<()> {
        Ok(self.trainer.write_checkpoint(path)?)
    }

    fn resume(&mut self, path: &Path) -> anyhow::Result<()> {
        Ok(self.trainer.resume(path)?)
    }
}

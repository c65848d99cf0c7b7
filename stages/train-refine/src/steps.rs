use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use artifact::Failure;
use refinement::{KnownView, RefinementError, Training};
use stage::Context;

/// Steps between two notes of how the training goes.
const STEPS_BETWEEN_NOTES: u64 = 50;
/// Longest time without a note.
const LONGEST_SILENCE: Duration = Duration::from_secs(10);
/// Checkpoints take at most one part in so many of the time.
const TIME_PER_CHECKPOINT: u32 = 50;

/// Takes all steps that an earlier run hasn't; `note` says in words how large errors are.
pub(crate) fn train(
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
        if let Some(path) = checkpoint
            .as_deref()
            .filter(|_| context.interrupted() || written.elapsed() > TIME_PER_CHECKPOINT * took)
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
        if since == STEPS_BETWEEN_NOTES || noted.elapsed() > LONGEST_SILENCE {
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

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use artifact::Failure;

use crate::context::Context;

/// Steps between two progress reports; chosen by hand.
const STEPS_PER_REPORT: u64 = 50;
/// Maximum time between two progress reports; chosen by hand.
const MAX_REPORT_INTERVAL: Duration = Duration::from_secs(10);

/// Interruptible training, step by step.
pub trait Training {
    /// Returns the number of steps taken.
    fn steps(&self) -> u64;

    /// Takes a step. Returns the loss before the step, or `None` after the last step.
    fn step(&mut self) -> anyhow::Result<Option<f64>>;

    /// Writes a checkpoint, from which the training resumes. The caller makes the write atomic.
    fn write_checkpoint(&self, path: &Path) -> anyhow::Result<()>;

    /// Resumes from a checkpoint of a training with the same parameters.
    fn resume(&mut self, path: &Path) -> anyhow::Result<()>;
}

impl Context {
    /// Trains to the end, from the checkpoint of an earlier run if there is one. `format_loss`
    /// formats a mean loss for the progress bar.
    pub fn train(
        &self,
        total_steps: u64,
        training: &mut impl Training,
        format_loss: impl Fn(f64) -> String,
    ) -> anyhow::Result<()> {
        let checkpoint = self.work().map(|work| work.join("checkpoint.safetensors"));
        if let Some(path) = checkpoint.as_deref().filter(|path| path.exists()) {
            self.log_line(resume(training, path));
        }
        let progress = self.progress("training", total_steps);
        take_steps(
            training,
            checkpoint.as_deref(),
            || self.is_interrupted(),
            |done, mean| progress.set(done, &format_loss(mean)),
        )
    }
}

/// Minimum ratio of the time between two checkpoints to the time that one takes; chosen by hand.
const MIN_INTERVAL_RATIO: u32 = 50;

/// Schedule of a training's checkpoints, which take at most a fiftieth of its time.
pub struct CheckpointSchedule {
    next: Instant,
}

impl Default for CheckpointSchedule {
    fn default() -> Self {
        Self { next: Instant::now() + Duration::from_secs(1) }
    }
}

impl CheckpointSchedule {
    /// Writes a checkpoint if one is due, or if the run is interrupted.
    ///
    /// # Errors
    /// [`Failure::Interrupted`] after the checkpoint of an interrupted run.
    pub fn write_if_due(
        &mut self,
        is_interrupted: bool,
        write: impl FnOnce() -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let started = Instant::now();
        if is_interrupted || started > self.next {
            write().context("cannot write the checkpoint")?;
            self.next = Instant::now() + MIN_INTERVAL_RATIO * started.elapsed();
        }
        if is_interrupted { Err(Failure::Interrupted.into()) } else { Ok(()) }
    }
}

/// Resumes from a checkpoint, or starts over if the checkpoint can't be used. Returns a log line.
fn resume(training: &mut impl Training, checkpoint: &Path) -> String {
    match training.resume(checkpoint) {
        Ok(()) => format!("resuming from step {}", training.steps()),
        Err(error) => format!("{error}; starting over"),
    }
}

/// Takes the remaining steps and writes checkpoints. Writes a last checkpoint and fails if the run
/// is interrupted. `report` gets the number of steps and the mean loss since the last report.
fn take_steps(
    training: &mut impl Training,
    checkpoint: Option<&Path>,
    interrupted: impl Fn() -> bool,
    report: impl Fn(u64, f64),
) -> anyhow::Result<()> {
    let mut schedule = CheckpointSchedule::default();
    let mut last_report = Instant::now();
    let (mut sum, mut count) = (0.0, 0u64);
    loop {
        schedule.write_if_due(interrupted(), || {
            checkpoint.map_or(Ok(()), |path| write_checkpoint(training, path))
        })?;
        let Some(loss) = training.step()? else { return Ok(()) };
        sum += loss;
        count += 1;
        if count == STEPS_PER_REPORT || last_report.elapsed() > MAX_REPORT_INTERVAL {
            report(training.steps(), sum / count as f64);
            (sum, count) = (0.0, 0);
            last_report = Instant::now();
        }
    }
}

/// Writes a checkpoint and replaces the previous one atomically.
fn write_checkpoint(training: &impl Training, path: &Path) -> anyhow::Result<()> {
    let partial = path.with_extension("partial");
    training.write_checkpoint(&partial)?;
    Ok(std::fs::rename(partial, path)?)
}

#[cfg(test)]
mod tests {
    use std::cell::{Cell, RefCell};

    use anyhow::anyhow;
    use artifact::exit_code;

    use super::*;

    const STEPS: u64 = 120;

    /// Training whose losses are 1, 2, 3, …; its checkpoint is the number of steps as text.
    #[derive(Default)]
    struct CountingTraining {
        steps: u64,
        /// Number of steps taken in this run.
        taken: u64,
        /// Error of the step after a number of steps.
        failure: Option<(u64, anyhow::Error)>,
    }

    impl Training for CountingTraining {
        fn steps(&self) -> u64 {
            self.steps
        }

        fn step(&mut self) -> anyhow::Result<Option<f64>> {
            if self.steps == STEPS {
                return Ok(None);
            }
            if let Some((_, error)) = self.failure.take_if(|(after, _)| *after == self.steps) {
                return Err(error);
            }
            (self.steps, self.taken) = (self.steps + 1, self.taken + 1);
            Ok(Some(self.steps as f64))
        }

        fn write_checkpoint(&self, path: &Path) -> anyhow::Result<()> {
            std::fs::write(path, self.steps.to_string()).map_err(|_| anyhow!("unwritable"))
        }

        fn resume(&mut self, path: &Path) -> anyhow::Result<()> {
            let text = std::fs::read_to_string(path).unwrap();
            self.steps = text.parse().map_err(|_| anyhow!("no number"))?;
            Ok(())
        }
    }

    /// Takes steps without checkpoints; returns the result and the reports.
    fn reports_of(training: &mut CountingTraining) -> (anyhow::Result<()>, Vec<(u64, f64)>) {
        let reports = RefCell::new(Vec::new());
        let report = |done, mean| reports.borrow_mut().push((done, mean));
        let result = take_steps(training, None, || false, report);
        (result, reports.into_inner())
    }

    #[test]
    fn a_resumed_training_takes_the_remaining_steps() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("checkpoint");
        std::fs::write(&checkpoint, "100").unwrap();
        let mut training = CountingTraining::default();
        assert_eq!(resume(&mut training, &checkpoint), "resuming from step 100");
        reports_of(&mut training).0.unwrap();
        assert_eq!((training.steps, training.taken), (STEPS, 20));
    }

    #[test]
    fn an_unusable_checkpoint_restarts_the_training() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("checkpoint");
        std::fs::write(&checkpoint, "torn").unwrap();
        let mut training = CountingTraining::default();
        let message = resume(&mut training, &checkpoint);
        assert_eq!(message, "no number; starting over");
        reports_of(&mut training).0.unwrap();
        assert_eq!((training.steps, training.taken), (STEPS, STEPS));
    }

    #[test]
    fn an_interruption_leaves_a_checkpoint_to_resume_from() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("checkpoint");
        let mut training = CountingTraining::default();
        let checks = Cell::new(0);
        let interrupted = || checks.replace(checks.get() + 1) == 3;
        let result = take_steps(&mut training, Some(&checkpoint), interrupted, |_, _| {});
        let failure = result.unwrap_err();
        assert!(matches!(failure.downcast_ref(), Some(Failure::Interrupted)), "{failure}");
        assert_eq!((training.steps, exit_code(&failure)), (3, 130));
        assert_eq!(std::fs::read_to_string(&checkpoint).unwrap(), "3");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no partial file is left");
        let mut training = CountingTraining::default();
        assert_eq!(resume(&mut training, &checkpoint), "resuming from step 3");
        reports_of(&mut training).0.unwrap();
        assert_eq!(training.taken, STEPS - 3);
    }

    #[test]
    fn a_failed_checkpoint_is_not_reported_as_an_interruption() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join("absent/checkpoint");
        let result =
            take_steps(&mut CountingTraining::default(), Some(&checkpoint), || true, |_, _| {});
        let failure = result.unwrap_err();
        let expected = "cannot write the checkpoint: unwritable";
        assert_eq!((format!("{failure:#}").as_str(), exit_code(&failure)), (expected, 1));
    }

    #[test]
    fn a_failed_step_ends_the_training() {
        let failure = Failure::Numerical("not finite".to_owned()).into();
        let mut training =
            CountingTraining { failure: Some((7, failure)), ..CountingTraining::default() };
        let failure = reports_of(&mut training).0.unwrap_err();
        assert_eq!((failure.to_string().as_str(), exit_code(&failure)), ("not finite", 4));
        assert_eq!(training.taken, 7);
    }

    #[test]
    fn a_report_is_the_mean_since_the_last_one() {
        let (result, reports) = reports_of(&mut CountingTraining::default());
        result.unwrap();
        // Means of 1 to 50 and of 51 to 100; the last 20 steps aren't reported.
        assert_eq!(reports, [(50, 25.5), (100, 75.5)]);
    }
}

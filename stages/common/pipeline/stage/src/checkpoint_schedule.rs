use std::time::{Duration, Instant};

use anyhow::Context as _;
use artifact::Failure;

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

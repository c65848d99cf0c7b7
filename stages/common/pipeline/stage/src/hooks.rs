use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Environment variable for tests: number of finished steps at which a stage is interrupted, as if
/// by a signal.
pub const STOP_VARIABLE: &str = "NERF_SR_STOP_AFTER";

/// Environment variable for tests, `COUNT FILE`: number of finished steps from which a stage is
/// slowed until the file exists, so that a test can observe training in progress on any machine.
pub const SLOW_VARIABLE: &str = "NERF_SR_SLOW_UNTIL";

/// Pause of a slowed stage at each progress update. The stage still advances, so that it reaches
/// its next checkpoint.
const PAUSE: Duration = Duration::from_millis(500);

/// Hooks of tests that interrupt or slow a stage at a given step.
#[derive(Debug, Default)]
pub(crate) struct TestHooks {
    stop: Option<(u64, Arc<AtomicBool>)>,
    slow: Option<(u64, PathBuf)>,
}

impl TestHooks {
    /// Reads [`STOP_VARIABLE`] and [`SLOW_VARIABLE`].
    pub(crate) fn from_environment(interrupted: &Arc<AtomicBool>) -> Self {
        let stop = std::env::var(STOP_VARIABLE).ok().and_then(|count| count.parse().ok());
        let slow = std::env::var(SLOW_VARIABLE).ok().and_then(|text| {
            let (count, file) = text.split_once(' ')?;
            Some((count.parse().ok()?, PathBuf::from(file)))
        });
        Self { stop: stop.map(|count| (count, Arc::clone(interrupted))), slow }
    }

    /// Interrupts or delays the stage if `done` steps have reached a hook's count.
    pub(crate) fn apply(&self, done: u64) {
        if let Some((count, interrupted)) = &self.stop
            && done >= *count
        {
            interrupted.store(true, Ordering::Relaxed);
        }
        if let Some((count, file)) = &self.slow
            && done >= *count
            && !file.exists()
        {
            std::thread::sleep(PAUSE);
        }
    }
}

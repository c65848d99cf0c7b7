use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Environment variable of the tests: a stage whose progress comes to this count is stopped then,
/// as if by a signal.
pub const STOP_VARIABLE: &str = "NERF_SR_STOP_AFTER";

/// Environment variable of the tests, `COUNT FILE`: a stage whose progress has come to this count
/// slows down until the file exists. A test sees the middle of a training with it on any machine.
pub const SLOW_VARIABLE: &str = "NERF_SR_SLOW_UNTIL";

/// Pause of a slowed stage at each report of its progress. A stage goes on, if slowly, so that it
/// reaches its next checkpoint.
const PAUSE: Duration = Duration::from_millis(500);

/// Stops or slows a stage at a count.
#[derive(Debug, Default)]
pub(crate) struct TestHooks {
    stop: Option<(u64, Arc<AtomicBool>)>,
    slow: Option<(u64, PathBuf)>,
}

impl TestHooks {
    /// The hooks that [`STOP_VARIABLE`] and [`SLOW_VARIABLE`] ask for.
    pub(crate) fn from_environment(interrupted: &Arc<AtomicBool>) -> Self {
        let stop = || Some((std::env::var(STOP_VARIABLE).ok()?.parse().ok()?, interrupted.clone()));
        Self { stop: stop(), slow: std::env::var(SLOW_VARIABLE).ok().and_then(|text| slow(&text)) }
    }

    pub(crate) fn progress(&self, done: u64) {
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

fn slow(text: &str) -> Option<(u64, PathBuf)> {
    let (count, file) = text.split_once(' ')?;
    Some((count.parse().ok()?, Path::new(file).to_owned()))
}

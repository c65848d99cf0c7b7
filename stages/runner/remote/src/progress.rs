use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use artifact::Failure;
use stage::ProgressMode;

/// Progress in bytes. [`Progress::add`] also checks for signals, because it is called after each
/// piece of data.
pub(crate) struct Progress {
    bytes: stage::Progress,
    stop: Arc<AtomicBool>,
}

impl Progress {
    /// Creates progress of `total` bytes. With a total of 0, nothing is displayed, and only signals
    /// are checked.
    pub(crate) fn new(label: &str, total: u64, stop: &Arc<AtomicBool>) -> Self {
        let mode = if total > 0 { ProgressMode::Plain } else { ProgressMode::None };
        Self { bytes: stage::Progress::of_bytes(label, total, mode), stop: Arc::clone(stop) }
    }

    /// Counts transferred bytes. Fails if a signal has interrupted the program.
    pub(crate) fn add(&self, bytes: u64) -> Result<(), Failure> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted);
        }
        self.bytes.add(bytes);
        Ok(())
    }

    /// Logs a line on stderr without disturbing the bar.
    pub(crate) fn log(&self, line: &str) {
        self.bytes.log_line(line);
    }
}

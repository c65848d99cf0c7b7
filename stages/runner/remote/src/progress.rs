use std::io::IsTerminal as _;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use artifact::{Failure, format_size, report_line};
use indicatif::{ProgressBar, ProgressStyle};
use stage::Pace;

/// Interval between lines if stderr isn't a terminal.
const REPORT_INTERVAL: Duration = Duration::from_secs(10);

/// Progress in bytes with the remaining time: a bar on a terminal, otherwise a line at intervals.
/// [`Progress::add`] also checks for signals, because it is called after each piece of data.
pub(crate) struct Progress {
    label: &'static str,
    total: u64,
    bar: Option<ProgressBar>,
    state: Mutex<State>,
    stop: Arc<AtomicBool>,
}

struct State {
    done: u64,
    pace: Pace,
    /// Time of the last line if stderr isn't a terminal.
    last_report: Instant,
}

impl Progress {
    /// Creates progress of `total` bytes. With a total of 0, nothing is displayed, and only signals
    /// are checked.
    pub(crate) fn new(label: &'static str, total: u64, stop: &Arc<AtomicBool>) -> Self {
        let bar = (total > 0 && std::io::stderr().is_terminal()).then(|| {
            let style = ProgressStyle::with_template("{prefix} [{bar:30}] {percent:>3}% {msg}")
                .expect("the template is constant");
            ProgressBar::new(total).with_style(style.progress_chars("=> ")).with_prefix(label)
        });
        let mut pace = Pace::default();
        pace.start(0);
        let state = Mutex::new(State { done: 0, pace, last_report: Instant::now() });
        Self { label, total, bar, state, stop: Arc::clone(stop) }
    }

    /// Counts transferred bytes. Fails if a signal has interrupted the program.
    pub(crate) fn add(&self, bytes: u64) -> Result<(), Failure> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted);
        }
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.done += bytes;
        let done = state.done;
        let is_due = self.total > 0 && state.last_report.elapsed() >= REPORT_INTERVAL;
        if self.bar.is_none() && !is_due {
            return Ok(());
        }
        let left = state.pace.time_left(done, self.total, None);
        let bytes = format!("{} of {}", format_size(done), format_size(self.total));
        let text = stage::join_parts(&[&bytes, &left]);
        if let Some(bar) = &self.bar {
            bar.set_position(done);
            bar.set_message(text);
        } else {
            state.last_report = Instant::now();
            report_line!("{}: {text}", self.label);
        }
        Ok(())
    }

    /// Logs a line on stderr without disturbing the bar.
    pub(crate) fn log(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| report_line!("{line}")),
            None => report_line!("{line}"),
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

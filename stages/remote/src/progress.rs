use std::io::IsTerminal as _;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use artifact::{Failure, report_line, sized};
use indicatif::{ProgressBar, ProgressStyle};
use stage::Pace;

/// Between two lines where there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Bytes done of bytes in all, with the time left: a bar on a terminal, a line now and then
/// elsewhere. Knows of signals, too: work looks at both between two pieces.
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
    shown: Instant,
}

impl Progress {
    /// With a total of 0 it looks at signals alone.
    pub(crate) fn new(label: &'static str, total: u64, stop: &Arc<AtomicBool>) -> Self {
        let bar = (total > 0 && std::io::stderr().is_terminal()).then(|| {
            let style = ProgressStyle::with_template("{prefix} [{bar:30}] {percent:>3}% {msg}")
                .expect("the template is constant");
            ProgressBar::new(total).with_style(style.progress_chars("=> ")).with_prefix(label)
        });
        let mut pace = Pace::default();
        pace.start(0);
        let state = Mutex::new(State { done: 0, pace, shown: Instant::now() });
        Self { label, total, bar, state, stop: Arc::clone(stop) }
    }

    /// Counts bytes that were transferred; an error once a signal has come.
    pub(crate) fn add(&self, bytes: u64) -> Result<(), Failure> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted);
        }
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.done += bytes;
        let done = state.done;
        let words =
            |left: String| format!("{} of {} · {left} left", sized(done), sized(self.total));
        if let Some(bar) = &self.bar {
            bar.set_position(done);
            bar.set_message(words(state.pace.time_left(done, self.total)));
        } else if self.total > 0 && state.shown.elapsed() >= LINE_INTERVAL {
            state.shown = Instant::now();
            report_line!("{}: {}", self.label, words(state.pace.time_left(done, self.total)));
        }
        Ok(())
    }

    /// Says something in between, on stderr.
    pub(crate) fn say(&self, line: &str) {
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

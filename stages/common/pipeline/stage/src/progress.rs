use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use artifact::{format_size, report_line};
use serde::{Deserialize, Serialize};

/// Format of a stage's progress reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum ProgressMode {
    /// A bar on a terminal, a line every ten seconds otherwise.
    Plain,
    /// JSON lines on stdout, for the runner.
    Json,
    /// No reports.
    None,
}

/// Line of `--progress json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "lowercase")]
pub enum Event {
    /// Progress report.
    Progress {
        /// Name of the work in progress.
        label: String,
        /// Number of finished steps.
        done: u64,
        /// Total number of steps.
        total: u64,
        /// Current loss, PSNR or the like, as text; may be empty.
        note: String,
        /// The stage's own estimate of the remaining seconds, for work whose pace changes.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        seconds_left: Option<u64>,
    },
    /// Failure that ends the stage; the exit code tells its kind.
    Failed {
        /// Problem and remedy on one line, without the stage's name.
        message: String,
    },
}

impl Event {
    fn line(&self) -> String {
        serde_json::to_string(self).expect("an event is plain JSON") + "\n"
    }

    /// Writes the event to stdout. Errors are ignored: the stage's work is useful without a runner.
    fn emit(&self) {
        std::io::stdout().write_all(self.line().as_bytes()).ok();
    }
}

/// True if a failure is reported as an event. Global, because a panic hook or any thread may end
/// the process.
static FAILURE_EVENT_ENABLED: AtomicBool = AtomicBool::new(false);

/// Enables the event that reports a failure of the process.
pub(crate) fn enable_failure_event() {
    FAILURE_EVENT_ENABLED.store(true, Ordering::SeqCst);
}

/// Returns the line that reports a failure to the runner; `None` unless the event is enabled.
pub(crate) fn failed_event(message: &str) -> Option<String> {
    let is_enabled = FAILURE_EVENT_ENABLED.load(Ordering::SeqCst);
    is_enabled.then(|| Event::Failed { message: message.to_owned() }.line())
}

/// Progress of a long piece of work. Calls are cheap: at most ten reports per second are written.
pub struct Progress {
    label: String,
    total: u64,
    /// True if steps are bytes, which are reported as sizes.
    counts_bytes: bool,
    mode: ProgressMode,
    bar: Option<indicatif::ProgressBar>,
    state: Mutex<ProgressState>,
    hooks: TestHooks,
}

struct ProgressState {
    done: u64,
    note: String,
    seconds_left: Option<f64>,
    pace: Pace,
    /// Time of the latest report, or of creation.
    reported: Instant,
    /// Number of finished steps in the latest report, if any.
    reported_done: Option<u64>,
}

impl ProgressState {
    /// True if a report is due: the interval since the latest one has passed, or work that has been
    /// reported has finished since.
    fn is_due(&self, total: u64, interval: Duration) -> bool {
        let has_grown = self.reported_done.is_some_and(|reported| self.done > reported);
        self.reported.elapsed() >= interval || (self.done >= total && has_grown)
    }
}

impl Progress {
    /// Creates progress at 0 of `total` steps.
    pub fn new(label: &str, total: u64, mode: ProgressMode) -> Self {
        let bar = (mode == ProgressMode::Plain && std::io::stderr().is_terminal()).then(|| {
            let style = indicatif::ProgressStyle::with_template(
                "{prefix:>14} [{bar:30}] {percent:>3}% {msg}",
            )
            .expect("the template is constant");
            indicatif::ProgressBar::new(total)
                .with_style(style.progress_chars("=> "))
                .with_prefix(label.to_owned())
        });
        let state = ProgressState {
            done: 0,
            note: String::new(),
            seconds_left: None,
            pace: Pace::default(),
            reported: Instant::now(),
            reported_done: None,
        };
        Self {
            label: label.to_owned(),
            total,
            counts_bytes: false,
            mode,
            bar,
            state: Mutex::new(state),
            hooks: TestHooks::default(),
        }
    }

    /// Creates progress at 0 of `total` bytes.
    pub fn of_bytes(label: &str, total: u64, mode: ProgressMode) -> Self {
        let mut progress = Self::new(label, total, mode);
        progress.counts_bytes = true;
        progress
    }

    /// Creates progress without reports, for tests.
    pub fn silent() -> Self {
        Self::new("", 0, ProgressMode::None)
    }

    pub(crate) fn with_hooks(mut self, hooks: TestHooks) -> Self {
        self.hooks = hooks;
        self
    }

    /// Sets the number of finished steps.
    pub fn set(&self, done: u64, note: &str) {
        self.update(|state| {
            state.done = done;
            note.clone_into(&mut state.note);
        });
    }

    /// Sets an estimate of the remaining time, for work whose pace changes. It is reported in place
    /// of the one that assumes an even pace, with the next finished steps.
    pub fn set_seconds_left(&self, seconds: f64) {
        self.lock().seconds_left = Some(seconds);
    }

    /// Adds finished steps, for work that finishes in any order.
    pub fn add(&self, steps: u64) {
        self.update(|state| state.done += steps);
    }

    /// Prints a line on stderr without disturbing the bar.
    pub fn log_line(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| report_line!("{line}")),
            None => report_line!("{line}"),
        }
    }

    fn update(&self, change: impl FnOnce(&mut ProgressState)) {
        let mut state = self.lock();
        change(&mut state);
        let done = state.done;
        drop(state);
        self.hooks.apply(done);
        self.report();
    }

    fn lock(&self) -> MutexGuard<'_, ProgressState> {
        self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Writes a report if one is due.
    fn report(&self) {
        let mut state = self.lock();
        let done = state.done;
        state.pace.start(done);
        let interval =
            if self.mode == ProgressMode::Plain && self.bar.is_none() { 10_000 } else { 100 };
        let is_due = state.is_due(self.total, Duration::from_millis(interval));
        if self.mode == ProgressMode::None || !is_due {
            return;
        }
        (state.reported, state.reported_done) = (Instant::now(), Some(done));
        let estimate = state.seconds_left;
        let left = state.pace.time_left(done, self.total, estimate);
        let [done_text, total_text] = [done, self.total]
            .map(|n| if self.counts_bytes { format_size(n) } else { n.to_string() });
        let steps = format!("{done_text} of {total_text}");
        if let Some(bar) = &self.bar {
            let sizes = if self.counts_bytes { &steps } else { "" };
            bar.set_position(done);
            bar.set_message(join_parts(&[sizes, &state.note, &left]));
        } else if self.mode == ProgressMode::Json {
            Event::Progress {
                label: self.label.clone(),
                done,
                total: self.total,
                note: state.note.clone(),
                seconds_left: state.seconds_left.map(|seconds| seconds.round() as u64),
            }
            .emit();
        } else {
            report_line!("{}: {}", self.label, join_parts(&[&steps, &state.note, &left]));
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

/// Pace of work, measured from the first call of [`Pace::start`] or [`Pace::time_left`]: steps of
/// an interrupted run don't count.
#[derive(Debug, Default)]
pub struct Pace {
    first: Option<(Instant, u64)>,
}

impl Pace {
    /// Records the time and the number of finished steps at the first call; later calls change
    /// nothing. Returns the recorded values.
    pub fn start(&mut self, done: u64) -> (Instant, u64) {
        *self.first.get_or_insert_with(|| (Instant::now(), done))
    }

    /// Returns the remaining time as text, such as "4.0 min left": the `estimate` in seconds if
    /// there is one, otherwise from an even pace; empty until a step has finished since the first
    /// call.
    pub fn time_left(&mut self, done: u64, total: u64, estimate: Option<f64>) -> String {
        let (start, first) = self.start(done);
        if let Some(seconds) = estimate {
            return format_seconds_left(seconds);
        }
        let steps = done.saturating_sub(first);
        if steps == 0 {
            return String::new();
        }
        let left = total.saturating_sub(done) as f64;
        format_seconds_left(start.elapsed().as_secs_f64() * left / steps as f64)
    }
}

/// Joins the parts of a progress line that aren't empty.
pub fn join_parts(parts: &[&str]) -> String {
    let parts: Vec<&str> = parts.iter().filter(|part| !part.is_empty()).copied().collect();
    parts.join(" · ")
}

fn format_seconds_left(seconds: f64) -> String {
    if seconds < 90.0 {
        format!("{seconds:.0} s left")
    } else {
        format!("{:.1} min left", seconds / 60.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The end is reported once, also if further calls finish no step.
    #[test]
    fn the_end_is_reported_at_once_but_not_again() {
        let mut state = ProgressState {
            done: 10,
            note: String::new(),
            seconds_left: None,
            pace: Pace::default(),
            reported: Instant::now(),
            reported_done: None,
        };
        let hour = Duration::from_secs(3600);
        for (reported_done, expected) in [(None, false), (Some(9), true), (Some(10), false)] {
            state.reported_done = reported_done;
            assert_eq!(state.is_due(10, hour), expected, "{reported_done:?}");
        }
        assert!(!state.is_due(11, hour) && state.is_due(11, Duration::ZERO));
    }

    #[test]
    fn time_left_depends_on_this_run_only() {
        let mut pace = Pace { first: None };
        assert_eq!(pace.time_left(900, 1000, None), "");
        let (start, _) = pace.first.unwrap();
        pace.first = Some((start.checked_sub(Duration::from_secs(60)).unwrap(), 900));
        assert_eq!(
            [(920, None), (901, None), (901, Some(61.4)), (900, Some(600.0))]
                .map(|(done, estimate)| pace.time_left(done, 1000, estimate)),
            ["4.0 min left", "99.0 min left", "61 s left", "10.0 min left"]
        );
    }
}

//! Progress of running stages: bars on a terminal, otherwise lines.

use std::io::IsTerminal as _;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use artifact::{format_duration, printable, report_text};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use stage::{Event, Pace, join_parts};

use crate::stage_call::call::Watcher;

/// Maximum time without a line of a running stage: after a longer silence the stage would seem dead
/// (docs/design/040).
const MAX_SILENCE: Duration = Duration::from_secs(8);
/// Interval between two movements of a bar's spinner.
const SPINNER_INTERVAL: Duration = Duration::from_millis(500);

/// Output of a run on stderr: progress bars and lines.
pub struct Display {
    /// Progress bars; `None` if stderr isn't a terminal.
    bars: Option<MultiProgress>,
}

impl Default for Display {
    /// Creates a display with bars if stderr is a terminal, otherwise with lines.
    fn default() -> Self {
        Self { bars: std::io::stderr().is_terminal().then(MultiProgress::new) }
    }
}

impl Display {
    /// Prints a line above the bars.
    pub fn line(&self, text: &str) {
        match &self.bars {
            // An error is ignored: the run continues after the terminal is closed.
            Some(bars) => bars.println(printable(text)).unwrap_or_default(),
            None => report_text(text),
        }
    }

    /// Prints a picture above the bars if stderr is a terminal. `draw` takes the terminal's columns
    /// and rows and returns text with escape sequences.
    pub fn picture(&self, draw: impl FnOnce(u16, u16) -> String) {
        if let Some(bars) = &self.bars {
            let (rows, columns) = console::Term::stderr().size();
            bars.println(draw(columns, rows)).unwrap_or_default();
        }
    }

    /// Starts displaying a stage.
    pub fn start(&self, label: &str) -> StageDisplay<'_> {
        let bar = self.bars.as_ref().map(|bars| {
            let template = "{spinner} {prefix} [{bar:30}] {percent:>3}% {msg}";
            let style = ProgressStyle::with_template(template).expect("the template is constant");
            let bar = bars.add(
                ProgressBar::new(1)
                    .with_style(style.progress_chars("=> "))
                    .with_prefix(printable(label).into_owned()),
            );
            bar.enable_steady_tick(SPINNER_INTERVAL);
            bar
        });
        if bar.is_none() {
            self.line(&format!("{label}: running"));
        }
        StageDisplay {
            display: self,
            label: label.to_owned(),
            bar,
            started: Instant::now(),
            state: Mutex::new(StageDisplayState {
                last_line: Instant::now(),
                task: String::new(),
                text: None,
                pace: Pace::default(),
            }),
        }
    }
}

/// Display of one running stage.
pub struct StageDisplay<'a> {
    display: &'a Display,
    label: String,
    bar: Option<ProgressBar>,
    started: Instant,
    state: Mutex<StageDisplayState>,
}

/// State of a stage's display.
struct StageDisplayState {
    /// Time of the last line.
    last_line: Instant,
    /// Task of the last progress event.
    task: String,
    /// Last progress as text; `None` before the first event.
    text: Option<String>,
    /// Pace of the task.
    pace: Pace,
}

impl StageDisplay<'_> {
    /// Removes the stage's bar.
    pub fn end(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Watcher for StageDisplay<'_> {
    fn progress(&self, event: &Event) {
        let Event::Progress { label: task, done, total, note, seconds_left } = event else {
            return;
        };
        let mut state = self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if state.task != *task {
            state.task.clone_from(task);
            state.pace = Pace::default();
        }
        let estimate = seconds_left.map(|seconds| seconds as f64);
        let left = state.pace.time_left(*done, *total, estimate);
        if let Some(bar) = &self.bar {
            bar.set_length(*total);
            bar.set_position(*done);
            bar.set_message(join_parts(&[task, note, &left]));
        } else {
            let percent = format!("{task} {} %", percent(*done, *total));
            state.text = Some(join_parts(&[&percent, note, &left]));
        }
    }

    /// Prints the progress, or else the elapsed time, after [`MAX_SILENCE`] without a line.
    fn tick(&self) {
        let mut state = self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if self.bar.is_some() || state.last_line.elapsed() < MAX_SILENCE {
            return;
        }
        state.last_line = Instant::now();
        let text = state.text.clone().unwrap_or_else(|| {
            format!("running for {}", format_duration(self.started.elapsed().as_secs_f64()))
        });
        self.display.line(&format!("{}: {text}", self.label));
    }

    fn stderr_line(&self, line: &str) {
        let mut state = self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        state.last_line = Instant::now();
        drop(state);
        self.display.line(&format!("{}: {line}", self.label));
    }
}

/// Returns the finished share of a task in percent, for any counts.
fn percent(done: u64, total: u64) -> u128 {
    u128::from(done) * 100 / u128::from(total.max(1))
}

#[cfg(test)]
mod tests {
    use super::percent;

    #[test]
    fn products_of_large_counts_do_not_overflow() {
        assert_eq!([percent(u64::MAX, u64::MAX), percent(3, 0), percent(1, 3)], [100, 300, 33]);
    }
}

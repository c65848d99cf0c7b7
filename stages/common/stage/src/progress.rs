use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

use artifact::report_line;
use serde::{Deserialize, Serialize};

use crate::hooks::TestHooks;

/// How a stage shows that it is getting on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum ProgressMode {
    /// A bar on a terminal, a line every ten seconds elsewhere.
    Plain,
    /// JSON lines on stdout, for the runner.
    Json,
    /// Nothing.
    None,
}

/// A line of `--progress json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "lowercase")]
pub enum Event {
    /// `done` of `total` steps of `label`.
    Progress {
        /// What is being done.
        label: String,
        /// Steps done.
        done: u64,
        /// Steps in all.
        total: u64,
        /// A figure that matters (loss, PSNR), in a few words.
        note: String,
    },
    /// The stage is about to end without a result. The exit code says what kind of failure it is.
    Failed {
        /// What is wrong and what to do, on one line, without the stage's name.
        message: String,
    },
}

impl Event {
    fn line(&self) -> String {
        serde_json::to_string(self).expect("an event is plain JSON") + "\n"
    }

    /// A runner that went away is no reason to stop: the stage's work still counts.
    fn emit(&self) {
        std::io::stdout().write_all(self.line().as_bytes()).ok();
    }
}

/// Whether the process has been asked for events: what ends it may come from anywhere.
static EMITS_EVENTS: AtomicBool = AtomicBool::new(false);

/// From now on the process says as an event why it fails.
pub(crate) fn emit_events() {
    EMITS_EVENTS.store(true, Ordering::SeqCst);
}

/// The line that tells a runner why the process fails, where it is to be told.
pub(crate) fn failed_event(message: &str) -> Option<String> {
    let event = || Event::Failed { message: message.to_owned() }.line();
    EMITS_EVENTS.load(Ordering::SeqCst).then(event)
}

/// Progress of one piece of long work. Cheap to call often: at most ten updates a second leave it.
pub struct Progress {
    label: String,
    total: u64,
    mode: ProgressMode,
    bar: Option<indicatif::ProgressBar>,
    state: Mutex<ProgressState>,
    hooks: TestHooks,
}

struct ProgressState {
    done: u64,
    note: String,
    pace: Pace,
    shown: Instant,
    is_shown: bool,
}

impl Progress {
    /// Starts at 0 of `total`.
    pub fn new(label: &str, total: u64, mode: ProgressMode) -> Self {
        let bar = (mode == ProgressMode::Plain && std::io::stderr().is_terminal()).then(|| {
            let style = indicatif::ProgressStyle::with_template(
                "{prefix:>14} [{bar:30}] {percent:>3}% {msg} left",
            )
            .expect("the template is constant");
            indicatif::ProgressBar::new(total)
                .with_style(style.progress_chars("=> "))
                .with_prefix(label.to_owned())
        });
        let state = ProgressState {
            done: 0,
            note: String::new(),
            pace: Pace::default(),
            shown: Instant::now(),
            is_shown: false,
        };
        Self {
            label: label.to_owned(),
            total,
            mode,
            bar,
            state: Mutex::new(state),
            hooks: TestHooks::default(),
        }
    }

    /// Creates progress that nobody sees, for tests.
    pub fn silent() -> Self {
        Self::new("", 0, ProgressMode::None)
    }

    pub(crate) fn with_hooks(mut self, hooks: TestHooks) -> Self {
        self.hooks = hooks;
        self
    }

    /// Sets the count.
    pub fn set(&self, done: u64, note: &str) {
        self.update(|state| {
            state.done = done;
            note.clone_into(&mut state.note);
        });
    }

    /// Adds to the count: for work that ends in any order.
    pub fn add(&self, steps: u64) {
        self.update(|state| state.done += steps);
    }

    fn update(&self, change: impl FnOnce(&mut ProgressState)) {
        let mut state = self.lock();
        change(&mut state);
        let done = state.done;
        drop(state);
        self.hooks.progress(done);
        self.show();
    }

    fn lock(&self) -> MutexGuard<'_, ProgressState> {
        self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Shows the count, where it is time to.
    fn show(&self) {
        let mut state = self.lock();
        let done = state.done;
        state.pace.begin(done);
        let interval =
            if self.mode == ProgressMode::Plain && self.bar.is_none() { 10_000 } else { 100 };
        let due = state.shown.elapsed() >= Duration::from_millis(interval);
        if self.mode == ProgressMode::None || !(due || (state.done >= self.total && state.is_shown))
        {
            return;
        }
        (state.shown, state.is_shown) = (Instant::now(), true);
        let left = state.pace.left(done, self.total);
        if let Some(bar) = &self.bar {
            bar.set_position(state.done);
            bar.set_message(format!("{} · {left}", state.note));
        } else if self.mode == ProgressMode::Json {
            Event::Progress {
                label: self.label.clone(),
                done,
                total: self.total,
                note: state.note.clone(),
            }
            .emit();
        } else {
            report_line!("{}: {done} of {} {} · {left} left", self.label, self.total, state.note);
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

/// How fast work gets on, from when it is first heard of: what an interrupted run did before says
/// nothing of that.
#[derive(Debug, Default)]
pub struct Pace {
    first: Option<(Instant, u64)>,
}

impl Pace {
    /// Is told when work is first heard of, and how much was done by then. Later calls change
    /// nothing.
    pub fn begin(&mut self, done: u64) -> (Instant, u64) {
        *self.first.get_or_insert_with(|| (Instant::now(), done))
    }

    /// Time left in words, now that so much is done.
    pub fn left(&mut self, done: u64, total: u64) -> String {
        let (since, from) = self.begin(done);
        in_words(since.elapsed(), done.saturating_sub(from), total.saturating_sub(done))
    }
}

fn in_words(elapsed: Duration, done: u64, left: u64) -> String {
    if done == 0 {
        return "?".to_owned();
    }
    let seconds = elapsed.as_secs_f64() * left as f64 / done as f64;
    if seconds < 90.0 { format!("{seconds:.0} s") } else { format!("{:.1} min", seconds / 60.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_left_follows_from_this_run_alone() {
        let mut pace = Pace { first: None };
        assert_eq!(pace.left(900, 1000), "?");
        let (since, _) = pace.first.unwrap();
        pace.first = Some((since.checked_sub(Duration::from_secs(60)).unwrap(), 900));
        assert_eq!(
            (pace.left(920, 1000).as_str(), pace.left(901, 1000).as_str()),
            ("4.0 min", "99.0 min")
        );
    }
}

//! What a person sees of running stages: bars on a terminal, lines elsewhere.

use std::io::IsTerminal as _;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use artifact::{printable, report_text};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use stage::{Event, Pace};

use crate::call::Watcher;
use crate::clock::seconds;

/// Lines of a stage come at least so often, so that nobody takes it for dead: whoever waits ten
/// seconds sees one.
const LONGEST_SILENCE: Duration = Duration::from_secs(8);
/// A bar moves so often, if only its spinner.
const TICK: Duration = Duration::from_millis(500);

/// Bars on a terminal, lines elsewhere.
pub struct Display {
    bars: Option<MultiProgress>,
}

impl Default for Display {
    fn default() -> Self {
        Self::new()
    }
}

impl Display {
    /// Bars where stderr is a terminal.
    pub fn new() -> Self {
        Self { bars: std::io::stderr().is_terminal().then(MultiProgress::new) }
    }

    /// Prints a line above the bars.
    pub fn line(&self, text: &str) {
        match &self.bars {
            // The terminal may have gone; the run goes on.
            Some(bars) => bars.println(printable(text)).unwrap_or_default(),
            None => report_text(text),
        }
    }

    /// Shows a picture above the bars; does nothing where stderr isn't a terminal. `draw` takes the
    /// terminal's columns and rows and returns text with escape sequences.
    pub fn picture(&self, draw: impl FnOnce(u16, u16) -> String) {
        if let Some(bars) = &self.bars {
            let (rows, columns) = console::Term::stderr().size();
            bars.println(draw(columns, rows)).unwrap_or_default();
        }
    }

    /// Shows a stage from now on.
    pub fn start(&self, label: &str) -> StageView<'_> {
        let bar = self.bars.as_ref().map(|bars| {
            let template = "{spinner} {prefix} [{bar:30}] {percent:>3}% {msg}";
            let style = ProgressStyle::with_template(template).expect("the template is constant");
            let bar = bars.add(
                ProgressBar::new(1)
                    .with_style(style.progress_chars("=> "))
                    .with_prefix(printable(label).into_owned()),
            );
            bar.enable_steady_tick(TICK);
            bar
        });
        if bar.is_none() {
            self.line(&format!("{label}: running"));
        }
        StageView {
            display: self,
            label: label.to_owned(),
            bar,
            started: Instant::now(),
            shown: Mutex::new(LastShown {
                when: Instant::now(),
                label: String::new(),
                text: None,
                pace: Pace::default(),
            }),
        }
    }
}

/// One running stage on the display.
pub struct StageView<'a> {
    display: &'a Display,
    label: String,
    bar: Option<ProgressBar>,
    started: Instant,
    shown: Mutex<LastShown>,
}

/// What was last shown of a stage, and how fast the work that it last told of gets on.
struct LastShown {
    when: Instant,
    label: String,
    /// How far it is, in words, if it has told.
    text: Option<String>,
    pace: Pace,
}

impl StageView<'_> {
    /// Takes its bar away.
    pub fn end(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Watcher for StageView<'_> {
    fn progress(&self, event: &Event) {
        let Event::Progress { label, done, total, note } = event else { return };
        let mut shown = self.shown.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if shown.label != *label {
            (shown.label, shown.pace) = (label.clone(), Pace::default());
        }
        let left = shown.pace.left(*done, *total);
        if let Some(bar) = &self.bar {
            bar.set_length(*total);
            bar.set_position(*done);
            bar.set_message(format!("{label} {note} · {left} left"));
        } else {
            let percent = done * 100 / total.max(&1);
            shown.text = Some(format!("{label} {percent}% {note} · {left} left"));
        }
    }

    /// Says where the stage is, where nothing has been said for long.
    fn alive(&self) {
        let mut shown = self.shown.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if self.bar.is_some() || shown.when.elapsed() < LONGEST_SILENCE {
            return;
        }
        shown.when = Instant::now();
        let running = || format!("running for {}", seconds(self.started.elapsed().as_secs_f64()));
        let text = shown.text.clone().unwrap_or_else(running);
        self.display.line(&format!("{}: {text}", self.label));
    }

    fn said(&self, line: &str) {
        self.display.line(&format!("{}: {line}", self.label));
    }
}

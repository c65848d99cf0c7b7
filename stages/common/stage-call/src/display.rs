//! What a person sees of running stages: bars on a terminal, lines elsewhere.

use std::io::IsTerminal as _;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use artifact::{Event, Pace, printable, report_text};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

use crate::call::Watcher;

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

    /// Shows a stage from now on.
    pub fn start(&self, label: &str) -> StageView<'_> {
        let bar = self.bars.as_ref().map(|bars| {
            let style = ProgressStyle::with_template("{prefix} [{bar:30}] {percent:>3}% {msg}")
                .expect("the template is constant");
            bars.add(
                ProgressBar::new(1)
                    .with_style(style.progress_chars("=> "))
                    .with_prefix(printable(label).into_owned()),
            )
        });
        if bar.is_none() {
            self.line(&format!("{label}: running"));
        }
        StageView {
            display: self,
            label: label.to_owned(),
            bar,
            shown: Mutex::new(LastShown {
                when: Instant::now(),
                label: String::new(),
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
    shown: Mutex<LastShown>,
}

/// What was last shown of a stage, and how fast the work that it last told of gets on.
struct LastShown {
    when: Instant,
    label: String,
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
        } else if shown.when.elapsed() > Duration::from_secs(15) {
            shown.when = Instant::now();
            self.display.line(&format!(
                "{}: {label} {}% {note} · {left} left",
                self.label,
                done * 100 / total.max(&1)
            ));
        }
    }

    fn said(&self, line: &str) {
        self.display.line(&format!("{}: {line}", self.label));
    }
}

//! Log file of a stage: start time, arguments, output, progress and result.

use std::fmt::Display;
use std::fs::File;
use std::io::{self, Write as _};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use artifact::printable;

/// Log file, shared by the readers of stdout and stderr.
pub(crate) struct StageLog {
    file: Mutex<File>,
}

impl StageLog {
    /// Opens a log file to append to the lines of earlier attempts.
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        Ok(Self { file: Mutex::new(File::options().create(true).append(true).open(path)?) })
    }

    /// Writes a line with escaped control characters.
    pub(crate) fn line(&self, text: impl Display) {
        let line = format!("{}\n", printable(&text.to_string()));
        // An error is ignored: the log isn't part of the result, and on a full disk the output
        // can't be written either.
        self.file.lock().unwrap_or_else(PoisonError::into_inner).write_all(line.as_bytes()).ok();
    }
}

/// Filter that reduces progress to one log line per tenth of each task.
#[derive(Default)]
pub(crate) struct ProgressFilter {
    task: String,
    /// Tenths of the task that were logged.
    tenth: u128,
}

impl ProgressFilter {
    /// Returns the log line of a progress event if the task has reached a further tenth.
    pub(crate) fn line(&mut self, task: &str, done: u64, total: u64, note: &str) -> Option<String> {
        if self.task != task {
            *self = Self { task: task.to_owned(), tenth: 0 };
        }
        let tenth = u128::from(done) * 10 / u128::from(total.max(1));
        if tenth <= self.tenth {
            return None;
        }
        self.tenth = tenth;
        let separator = if note.is_empty() { "" } else { " · " };
        Some(format!("{task}: {} %{separator}{note}", tenth * 10))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_logged_at_tenths() {
        let mut filter = ProgressFilter::default();
        let mut lines = Vec::new();
        for done in 0..=1000 {
            lines.extend(filter.line("training", done, 1000, "PSNR 20"));
        }
        assert_eq!(
            (lines.len(), lines[0].as_str(), lines[9].as_str()),
            (10, "training: 10 % · PSNR 20", "training: 100 % · PSNR 20")
        );
        // Another task starts at 0; products of large counts must not overflow.
        assert_eq!(
            filter.line("rendering", u64::MAX / 2, u64::MAX, ""),
            Some("rendering: 40 %".to_owned())
        );
    }
}

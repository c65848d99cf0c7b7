//! The log of a stage: when it started, with what, all it said, how far it got, and how it ended.

use std::fmt::Display;
use std::fs::File;
use std::io::{self, Write as _};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use artifact::{printable, unix_time};

use crate::clock::utc;

/// The file, which the readers of both pipes write to.
pub(crate) struct StageLog {
    file: Mutex<File>,
}

impl StageLog {
    /// Goes on after what earlier attempts said.
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        Ok(Self { file: Mutex::new(File::options().create(true).append(true).open(path)?) })
    }

    /// The first line of a run.
    pub(crate) fn start(&self, label: &str) {
        self.line(format_args!("{label}: started {}", utc(unix_time())));
    }

    /// Writes a line, control characters spelled out.
    pub(crate) fn line(&self, text: impl Display) {
        let line = format!("{}\n", printable(&text.to_string()));
        // The log is for people; a full disk shows itself in the output.
        self.file.lock().unwrap_or_else(PoisonError::into_inner).write_all(line.as_bytes()).ok();
    }
}

/// Thins out progress: a line at each tenth of a piece of work.
#[derive(Default)]
pub(crate) struct Tenths {
    work: String,
    tenth: u128,
}

impl Tenths {
    /// How far the work is, in words, where that is another tenth than was last told.
    pub(crate) fn told(&mut self, work: &str, done: u64, total: u64, note: &str) -> Option<String> {
        if self.work != work {
            *self = Self { work: work.to_owned(), tenth: 0 };
        }
        let tenth = u128::from(done) * 10 / u128::from(total.max(1));
        if tenth <= self.tenth {
            return None;
        }
        self.tenth = tenth;
        Some(format!("{work}: {}% {note}", tenth * 10).trim_end().to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_told_at_tenths() {
        let mut tenths = Tenths::default();
        let mut told = Vec::new();
        for done in 0..=1000 {
            told.extend(tenths.told("training", done, 1000, "PSNR 20"));
        }
        assert_eq!(
            (told.len(), told[0].as_str(), told[9].as_str()),
            (10, "training: 10% PSNR 20", "training: 100% PSNR 20")
        );
        // Other work begins anew; counts may be as large as can be.
        assert_eq!(
            tenths.told("rendering", u64::MAX / 2, u64::MAX, ""),
            Some("rendering: 40%".to_owned())
        );
    }
}

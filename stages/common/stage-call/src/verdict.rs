//! Why a stage failed: by what it says itself, by what its memory allocator said, by the signal
//! that ended it, and only then by the last line on its stderr.

use std::os::unix::process::ExitStatusExt as _;
use std::path::Path;
use std::process::ExitStatus;

use stage::{MEMORY_REMEDY, out_of_memory};

/// How a stage ended, if not well.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{message}")]
pub struct StageFailure {
    /// Its exit code; 1 where a signal ended it.
    pub code: u8,
    /// Why, on one line.
    pub message: String,
}

impl StageFailure {
    /// A file that can't be read or written.
    pub fn at(path: &Path, error: &std::io::Error) -> Self {
        Self { code: 1, message: format!("{}: {error}", path.display()) }
    }
}

/// How a stage ended.
pub(crate) struct End {
    pub(crate) status: ExitStatus,
    /// The reason it gave by the protocol.
    pub(crate) stated: Option<String>,
    /// Its last lines on stderr, less [noise](is_noise).
    pub(crate) tail: Vec<String>,
    /// Whether it was asked to end.
    pub(crate) asked: bool,
    /// True if the kernel ended some process meanwhile because memory ran out.
    pub(crate) memory_ran_out: bool,
}

/// Exit code of a shell whose program was ended by SIGKILL.
const KILLED_IN_SHELL: i32 = 128 + 9;

/// Returns the number of processes that the kernel has ended because memory ran out; `None` where
/// the kernel doesn't count them.
pub(crate) fn memory_kills() -> Option<u64> {
    let counts = std::fs::read_to_string("/proc/vmstat").ok()?;
    counts.lines().find_map(|line| line.strip_prefix("oom_kill "))?.parse().ok()
}

impl End {
    /// What to tell of a stage that didn't end well. `name` is what it may begin its lines with.
    pub(crate) fn failure(&self, name: &str) -> StageFailure {
        if self.asked && self.status.signal().is_some() {
            return StageFailure { code: 130, message: "interrupted".to_owned() };
        }
        let code = self.status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(1);
        StageFailure { code, message: self.reason(name) }
    }

    fn reason(&self, name: &str) -> String {
        if let Some(stated) = &self.stated {
            return stated.clone();
        }
        if let Some(said) = self.tail.iter().rev().find_map(|line| out_of_memory(line)) {
            return said;
        }
        let is_killed =
            self.status.signal() == Some(9) || self.status.code() == Some(KILLED_IN_SHELL);
        if is_killed && self.memory_ran_out {
            return format!("out of memory: the kernel ended it; {MEMORY_REMEDY}");
        }
        let words = self
            .tail
            .iter()
            .rev()
            .map(|line| own_words(line, name))
            .find(|words| !words.is_empty());
        match (self.status.signal(), words) {
            (Some(signal), words) => by_signal(signal, words),
            (None, Some(words)) => words.to_owned(),
            (None, None) => {
                format!("ended with exit code {} and said nothing", self.status.code().unwrap_or(1))
            }
        }
    }
}

/// A line without the name it begins with.
fn own_words<'a>(line: &'a str, name: &str) -> &'a str {
    line.strip_prefix(name).and_then(|rest| rest.strip_prefix(": ")).unwrap_or(line).trim()
}

/// What Rust's runtime adds to a message: how to see more, or the frames of a backtrace. It is for
/// the log alone.
pub(crate) fn is_noise(line: &str) -> bool {
    let text = line.trim_start();
    let is_frame = text.starts_with("at ")
        || text.trim_start_matches(|c: char| c.is_ascii_digit()).starts_with(": ");
    let is_added =
        ["note: run with `RUST_BACKTRACE", "note: Some details are omitted", "stack backtrace:"];
    (text.len() < line.len() && is_frame) || is_added.iter().any(|start| text.starts_with(start))
}

fn by_signal(signal: i32, words: Option<&str>) -> String {
    let name = signal_hook::low_level::signal_name(signal)
        .map_or_else(|| format!("signal {signal}"), str::to_owned);
    let after = words.map(|words| format!(" after it said: {words}")).unwrap_or_default();
    match name.as_str() {
        "SIGKILL" => {
            format!(
                "ended by SIGKILL{after}; maybe the kernel ended it because memory ran out \
                (`dmesg` says): {MEMORY_REMEDY}"
            )
        }
        "SIGTERM" | "SIGINT" | "SIGHUP" => format!("ended by {name}{after}; run again to go on"),
        _ => format!("crashed with {name}{after}; please report it"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Exit codes stand in the second byte of a status, signals in the first.
    fn end(status: i32, tail: &[&str]) -> End {
        let tail = tail.iter().map(|line| (*line).to_owned()).collect();
        let status = ExitStatus::from_raw(status);
        End { status, stated: None, tail, asked: false, memory_ran_out: false }
    }

    #[test]
    fn the_reason_is_not_the_last_line_by_position() {
        for (status, tail, code, starts, ends) in [
            (3 << 8, &["eval: r_0.png: cut short"][..], 3, "r_0.png: cut short", "short"),
            (1 << 8, &["Traceback", "ValueError: bad"], 1, "ValueError: bad", "bad"),
            (101 << 8, &["thread 'main' panicked at x.rs:1:2:", "a name"], 101, "a name", "name"),
            (7 << 8, &[], 7, "ended with exit code 7 and said nothing", "nothing"),
            (
                6,
                &["memory allocation of 99532800 bytes failed"],
                1,
                "out of memory: 99.5 MB more were asked for;",
                "images",
            ),
            (
                6,
                &["terminate called after throwing an instance of 'std::bad_alloc'", "  what():"],
                1,
                "out of memory; end other programs",
                "images",
            ),
            (
                6,
                &["free(): invalid pointer"],
                1,
                "crashed with SIGABRT after it said: free(): invalid",
                "please report it",
            ),
            (
                9,
                &["LR images: 8"],
                1,
                "ended by SIGKILL after it said: LR images: 8; maybe the kernel",
                "images",
            ),
            (11, &[], 1, "crashed with SIGSEGV; please report it", "it"),
            (15, &[], 1, "ended by SIGTERM; run again to go on", "on"),
        ] {
            let failure = end(status, tail).failure("eval");
            assert_eq!(failure.code, code, "{tail:?}");
            assert!(
                failure.message.starts_with(starts) && failure.message.ends_with(ends),
                "{tail:?}: {}",
                failure.message
            );
        }
    }

    #[test]
    fn what_the_kernel_ended_was_out_of_memory() {
        for (status, is_said) in [(9, true), (137 << 8, true), (1 << 8, false), (15, false)] {
            let end = End { memory_ran_out: true, ..end(status, &["Killed"]) };
            let said = end.failure("eval").message.starts_with("out of memory: the kernel");
            assert_eq!(said, is_said, "{status}");
        }
    }

    #[test]
    fn what_rusts_runtime_adds_is_no_reason() {
        for line in [
            "note: run with `RUST_BACKTRACE=1` environment variable to display a backtrace",
            "stack backtrace:",
            "   0: std::alloc::rust_oom",
            "             at /rustc/59807616/library/std/src/alloc.rs:424:5",
            "  10: {closure#0}",
        ] {
            assert!(is_noise(line), "{line}");
        }
        for line in [
            "memory allocation of 5 bytes failed",
            "at last",
            "10: ten",
            "  indented: words",
            ": odd",
            "",
        ] {
            assert!(!is_noise(line), "{line}");
        }
    }

    #[test]
    fn what_a_stage_states_comes_before_what_it_printed() {
        let stated = End {
            stated: Some("no space left".to_owned()),
            ..end(1 << 8, &["eval: no space left", "warning: slow"])
        };
        assert_eq!(stated.failure("eval").message, "no space left");
        let asked = End { asked: true, ..end(15, &["working"]) };
        assert_eq!(
            (asked.failure("eval").code, asked.failure("eval").message.as_str()),
            (130, "interrupted")
        );
    }
}

//! Causes of a stage's failure, in this order of evidence: the reason that the stage states, its
//! memory allocator's message, the kernel's kill for lack of memory, the signal that ended it, and
//! the last line on its stderr.

use std::os::unix::process::ExitStatusExt as _;
use std::path::Path;
use std::process::ExitStatus;

use stage::{MEMORY_REMEDY, out_of_memory_message};

/// Error returned when a stage fails.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{message}")]
pub struct StageFailure {
    /// Exit code of the stage; if a signal ended it, 130 if it was asked to end, otherwise 1.
    pub code: u8,
    /// Reason, on one line.
    pub message: String,
}

impl StageFailure {
    /// Exit code of a failure without a code of its own.
    pub const FAILED: u8 = 1;
    /// Exit code for wrong usage: a pipeline, an argument or a program that can't be used.
    pub const USAGE: u8 = 2;
    /// Exit code for an input folder or artifact that can't be used.
    pub const BAD_INPUT: u8 = 3;
    /// Exit code of an interruption.
    pub const INTERRUPTED: u8 = 130;

    /// Creates the failure for a file that can't be read or written.
    pub fn at(path: &Path, error: &std::io::Error) -> Self {
        Self { code: Self::FAILED, message: format!("{}: {error}", path.display()) }
    }
}

/// Exit status of a stage, with evidence of the cause.
pub(crate) struct Exit {
    pub(crate) status: ExitStatus,
    /// Reason of a failure, as the stage states it by the contract.
    pub(crate) stated_reason: Option<String>,
    /// Last lines on stderr, without [noise](is_noise).
    pub(crate) tail: Vec<String>,
    /// True if the stage was asked to end.
    pub(crate) was_stopped: bool,
    /// True if the kernel killed a process for lack of memory while the stage ran.
    pub(crate) was_memory_exhausted: bool,
}

/// Exit code of a shell whose program was ended by SIGKILL.
const KILLED_IN_SHELL: i32 = 128 + 9;

/// Returns the number of processes that the kernel has killed for lack of memory; `None` if the
/// kernel doesn't count them.
pub(crate) fn memory_kills() -> Option<u64> {
    let counts = std::fs::read_to_string("/proc/vmstat").ok()?;
    counts.lines().find_map(|line| line.strip_prefix("oom_kill "))?.parse().ok()
}

impl Exit {
    /// Returns the failure of a stage with an unsuccessful status. `name` is the name that the
    /// stage may print before its messages.
    pub(crate) fn failure(&self, name: &str) -> StageFailure {
        if self.was_stopped && self.status.signal().is_some() {
            let message = "interrupted".to_owned();
            return StageFailure { code: StageFailure::INTERRUPTED, message };
        }
        let code = self.status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(1);
        StageFailure { code, message: self.reason(name) }
    }

    fn reason(&self, name: &str) -> String {
        if let Some(reason) = &self.stated_reason {
            return reason.clone();
        }
        if let Some(reason) = self.tail.iter().rev().find_map(|line| out_of_memory_message(line)) {
            return reason;
        }
        let is_killed =
            self.status.signal() == Some(9) || self.status.code() == Some(KILLED_IN_SHELL);
        if is_killed && self.was_memory_exhausted {
            return format!("out of memory: killed by the kernel; {MEMORY_REMEDY}");
        }
        let mut lines = self.tail.iter().rev().map(|line| without_name(line, name));
        let last_line = lines.find(|line| !line.is_empty());
        match (self.status.signal(), last_line) {
            (Some(signal), line) => signal_reason(signal, line),
            (None, Some(line)) => line.to_owned(),
            (None, None) => {
                format!("exit code {} without a message", self.status.code().unwrap_or(1))
            }
        }
    }
}

/// Returns a line without the stage's name at its start.
fn without_name<'a>(line: &'a str, name: &str) -> &'a str {
    line.strip_prefix(name).and_then(|rest| rest.strip_prefix(": ")).unwrap_or(line).trim()
}

/// Returns whether a line is one that Rust's runtime adds to a panic message: a hint or a frame of
/// a backtrace. Such lines are for the log alone.
pub(crate) fn is_noise(line: &str) -> bool {
    let text = line.trim_start();
    let is_frame = text.starts_with("at ")
        || text.trim_start_matches(|c: char| c.is_ascii_digit()).starts_with(": ");
    let hints =
        ["note: run with `RUST_BACKTRACE", "note: Some details are omitted", "stack backtrace:"];
    (text.len() < line.len() && is_frame) || hints.iter().any(|start| text.starts_with(start))
}

fn signal_reason(signal: i32, last_line: Option<&str>) -> String {
    let name = signal_hook::low_level::signal_name(signal)
        .map_or_else(|| format!("signal {signal}"), str::to_owned);
    let context = last_line.map(|line| format!(" (last line: {line})")).unwrap_or_default();
    match name.as_str() {
        "SIGKILL" => {
            format!("ended by SIGKILL{context}; if memory ran out (see `dmesg`): {MEMORY_REMEDY}")
        }
        "SIGTERM" | "SIGINT" | "SIGHUP" => format!("ended by {name}{context}; run again to resume"),
        _ => format!("crashed with {name}{context}; please report it"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates an exit from a wait status: signal in the low byte, exit code in the second byte.
    fn exit(status: i32, tail: &[&str]) -> Exit {
        let tail = tail.iter().map(|line| (*line).to_owned()).collect();
        let status = ExitStatus::from_raw(status);
        Exit { status, stated_reason: None, tail, was_stopped: false, was_memory_exhausted: false }
    }

    #[test]
    fn reasons_follow_from_the_status_and_the_last_lines() {
        for (status, tail, code, start, end) in [
            (3 << 8, &["eval: r_0.png: cut short"][..], 3, "r_0.png: cut short", "short"),
            (1 << 8, &["Traceback", "ValueError: bad"], 1, "ValueError: bad", "bad"),
            (101 << 8, &["thread 'main' panicked at x.rs:1:2:", "a name"], 101, "a name", "name"),
            (7 << 8, &[], 7, "exit code 7 without a message", "message"),
            (6, &["memory allocation of 99532800 bytes failed"], 1, "out of memory: 99.5 MB", ""),
            (
                6,
                &["terminate called after throwing an instance of 'std::bad_alloc'", "  what():"],
                1,
                "out of memory;",
                "",
            ),
            (
                6,
                &["free(): invalid pointer"],
                1,
                "crashed with SIGABRT (last line: free(): invalid pointer)",
                "please report it",
            ),
            (
                9,
                &["LR images: 8"],
                1,
                "ended by SIGKILL (last line: LR images: 8); if memory ran out",
                MEMORY_REMEDY,
            ),
            (11, &[], 1, "crashed with SIGSEGV; please report it", "it"),
            (15, &[], 1, "ended by SIGTERM; run again to resume", "resume"),
        ] {
            let failure = exit(status, tail).failure("eval");
            assert_eq!(failure.code, code, "{tail:?}");
            assert!(
                failure.message.starts_with(start) && failure.message.ends_with(end),
                "{tail:?}: {}",
                failure.message
            );
        }
    }

    #[test]
    fn a_kill_with_exhausted_memory_is_out_of_memory() {
        for (status, expected) in [(9, true), (137 << 8, true), (1 << 8, false), (15, false)] {
            let exit = Exit { was_memory_exhausted: true, ..exit(status, &["Killed"]) };
            let found = exit.failure("eval").message.starts_with("out of memory: killed");
            assert_eq!(found, expected, "{status}");
        }
    }

    #[test]
    fn lines_of_rusts_runtime_are_noise() {
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
    fn a_stated_reason_precedes_printed_lines() {
        let stated = Exit {
            stated_reason: Some("no space left".to_owned()),
            ..exit(1 << 8, &["eval: no space left", "warning: slow"])
        };
        assert_eq!(stated.failure("eval").message, "no space left");
        let stopped = Exit { was_stopped: true, ..exit(15, &["working"]) };
        assert_eq!(
            (stopped.failure("eval").code, stopped.failure("eval").message.as_str()),
            (130, "interrupted")
        );
    }
}

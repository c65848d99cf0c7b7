//! The caller's half of the stage contract; the crate `stage` is the other half.
//!
//! * [`describe_all`]: descriptions of programs, from `STAGE describe`.
//! * [`Call`]: one run of a stage, with its log and its [`Usage`]. If it is stopped, the stage is
//!   asked to end, so that it can write a checkpoint.
//! * [`StageFailure`]: cause of a failure, found from the stage's messages, its allocator's
//!   messages, and the signal that ended its process.
//! * [`stop_on_signals`]: the first signal sets a flag, the second kills all child processes.
//! * [`Display`]: progress of running stages on a terminal or as lines. Any [`Watcher`] can follow
//!   a call.
//! * [`seconds`], [`utc`]: durations and times as text.
//!
//! ```no_run
//! use std::path::{Path, PathBuf};
//! use std::sync::atomic::AtomicBool;
//!
//! use stage_call::{Call, Display, describe_all, seconds};
//!
//! let programs = [PathBuf::from("target/release/demo-scene")];
//! let Ok(descriptions) = describe_all(&programs, None) else { return };
//! let [(program, Ok(description))] = &Vec::from_iter(descriptions)[..] else { return };
//! let call = Call {
//!     label: "demo-scene",
//!     program,
//!     description,
//!     params: Path::new("params.json"),
//!     inputs: &[],
//!     hashes: &[],
//!     output: Path::new("output"),
//!     work: None,
//!     from_checkpoint: false,
//!     device: "cpu",
//!     threads: 2,
//!     lock: None,
//! };
//! let display = Display::new();
//! let view = display.start(call.label);
//! match call.run(Path::new("log"), &view, &AtomicBool::new(false)) {
//!     Ok(usage) => println!("processor time: {}", seconds(usage.processor_seconds)),
//!     Err(failure) => println!("{}", failure.message),
//! }
//! view.end();
//! ```

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod call;
mod describe;
mod display;
mod failure;
mod group;
mod log;

pub use call::{Call, Usage, Watcher, read_summary};
pub use describe::{DescribeError, Descriptions, Interrupted, describe_all};
pub use display::{Display, StageView};
pub use failure::StageFailure;
pub use group::stop_on_signals;

/// Formats a duration in seconds, as `12.3 s` or `4.5 min`.
pub fn seconds(s: f64) -> String {
    if s < 90.0 { format!("{s:.1} s") } else { format!("{:.1} min", s / 60.0) }
}

/// Formats a time, given in seconds since 1970, as `2026-11-24 23:23:05 UTC`.
pub fn utc(unix: u64) -> String {
    let seconds = unix % 86_400;
    // Days since 1 March 0000. Years that begin in March end with the leap day.
    let days = unix / 86_400 + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let (month, carry) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    let year = era * 400 + year + carry;
    format!(
        "{year:04}-{month:02}-{day:02} {:02}:{:02}:{:02} UTC",
        seconds / 3600,
        seconds / 60 % 60,
        seconds % 60
    )
}

#[cfg(test)]
mod tests {
    use super::utc;

    #[test]
    fn times_are_those_of_date() {
        for (unix, text) in [
            (0, "1970-01-01 00:00:00 UTC"),
            (951_782_400, "2000-02-29 00:00:00 UTC"),
            (951_868_799, "2000-02-29 23:59:59 UTC"),
            (951_868_800, "2000-03-01 00:00:00 UTC"),
            (1_798_761_599, "2026-12-31 23:59:59 UTC"),
            (4_107_542_400, "2100-03-01 00:00:00 UTC"),
        ] {
            assert_eq!(utc(unix), text);
        }
    }
}

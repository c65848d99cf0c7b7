//! Calls of stages by their contract: what a runner does of which a stage knows the other half.
//!
//! * [`ask_all`]: what programs say of themselves.
//! * [`Call`]: one run of a stage, with its log and its [`Usage`]. Who stops it asks the stage to
//!   end, so that it leaves a checkpoint.
//! * [`StageFailure`]: why a stage failed, by what it says, by its allocator, by the signal that
//!   ended it.
//! * [`stop_on_signals`]: the first signal sets a flag, the second kills all that was started.
//! * [`Display`]: what a person sees meanwhile; any [`Watcher`] may watch.
//! * [`seconds`], [`utc`]: times as people say them.
//!
//! ```no_run
//! use std::path::{Path, PathBuf};
//! use std::sync::atomic::AtomicBool;
//!
//! use stage_call::{Call, Display, ask_all, seconds};
//!
//! let programs = [PathBuf::from("target/release/demo-scene")];
//! let Ok(answers) = ask_all(&programs, None) else { return };
//! let [(program, Ok(description))] = &Vec::from_iter(answers)[..] else { return };
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
//!     Ok(usage) => println!("{} of processor time", seconds(usage.processor_seconds)),
//!     Err(failure) => println!("{}", failure.message),
//! }
//! view.end();
//! ```

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod call;
mod clock;
mod describing;
mod display;
mod group;
mod log;
mod verdict;

pub use call::{Call, Usage, Watcher, summary_of};
pub use clock::{seconds, utc};
pub use describing::{Answers, DescribeError, Interrupted, ask_all};
pub use display::{Display, StageView};
pub use group::stop_on_signals;
pub use verdict::StageFailure;

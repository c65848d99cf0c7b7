//! The caller's half of the stage contract; the crate `stage` is the other half.
//!
//! * [`describe_all`]: descriptions of programs, from `STAGE describe`.
//! * [`Call`]: one run of a stage, with its log and its [`Usage`]. If a call is stopped, the stage
//!   is asked to end and can write a checkpoint.
//! * [`StageFailure`]: cause of a failure, found from the stage's messages, its allocator's
//!   messages, and the signal that ended its process.
//! * [`stop_on_signals`]: the first signal sets a flag, the second kills all child processes.
//! * [`Display`]: progress of running stages on a terminal or as lines. Any [`Watcher`] can follow
//!   a call.
//!
//! ```no_run
//! use std::path::{Path, PathBuf};
//! use std::sync::atomic::AtomicBool;
//!
//! use planning::stage_call::{Call, Display, describe_all};
//!
//! let programs = [PathBuf::from("target/release/demo-scene")];
//! let Some(descriptions) = describe_all(&programs, None) else { return };
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
//! let display = Display::default();
//! let view = display.start(call.label);
//! let (usage, result) = call.run(Path::new("log"), &view, &AtomicBool::new(false));
//! view.end();
//! println!("processor time: {}", usage.processor_seconds);
//! if let Err(failure) = result {
//!     println!("{}", failure.message);
//! }
//! ```

mod call;
mod describe;
mod display;
mod failure;
mod group;
mod log;

pub use call::{Call, Usage, Watcher, read_summary};
pub use describe::{Descriptions, ProgramError, describe_all};
pub use display::{Display, StageDisplay};
pub use failure::StageFailure;
pub use group::stop_on_signals;

//! Calls of stages by their contract: what a runner does of which a stage knows the other half.
//!
//! * [`ask_all`]: what programs say of themselves.
//! * [`Call`]: one run of a stage, with its log and its [`Usage`]. Who stops it asks the stage to
//!   end, so that it leaves a checkpoint.
//! * [`StageFailure`]: why a stage failed, by what it says, by its allocator, by the signal that
//!   ended it.
//! * [`Display`]: what a person sees meanwhile; any [`Watcher`] may watch.

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod call;
mod clock;
mod describing;
mod display;
mod log;
mod verdict;

pub use call::{Call, Usage, Watcher};
pub use clock::{seconds, utc};
pub use describing::{Answers, DescribeError, Interrupted, ask_all};
pub use display::{Display, StageView};
pub use verdict::StageFailure;

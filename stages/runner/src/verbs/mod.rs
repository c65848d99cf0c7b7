//! What the command line can ask for, a file each.

mod cancel;
mod describe;
mod gc;
mod job;
mod log;
mod pin;
mod plan;
mod run;
mod status;
mod verify;
mod why;

pub(crate) use cancel::cancel;
pub(crate) use describe::describe;
pub(crate) use gc::gc;
pub(crate) use job::job;
pub(crate) use log::log;
pub(crate) use pin::{pin, unpin};
pub(crate) use plan::plan;
pub(crate) use run::run;
pub(crate) use status::status;
pub(crate) use verify::verify;
pub(crate) use why::why;

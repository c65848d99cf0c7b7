//! What the command line can ask for, a file each.

mod describe;
mod diff;
mod gc;
mod log;
mod path;
mod pin;
mod plan;
mod run;
mod status;
mod verify;
mod why;

pub(crate) use describe::describe;
pub(crate) use diff::diff;
pub(crate) use gc::{Style, gc};
pub(crate) use log::log;
pub(crate) use path::path;
pub(crate) use pin::{pin, unpin};
pub(crate) use plan::plan;
pub(crate) use run::run;
pub(crate) use status::status;
pub(crate) use verify::verify;
pub(crate) use why::why;

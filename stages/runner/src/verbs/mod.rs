//! What the command line can ask for, a file each.

mod cancel;
mod completions;
mod describe;
mod diff;
mod gc;
mod graph;
mod init;
mod job;
mod log;
mod man;
mod path;
mod pin;
mod plan;
mod print;
mod run;
mod status;
mod verify;
mod why;

pub(crate) use cancel::cancel;
pub(crate) use completions::completions;
pub(crate) use describe::describe;
pub(crate) use diff::diff;
pub(crate) use gc::{Style, gc};
pub(crate) use graph::{GraphFormat, graph};
pub(crate) use init::init;
pub(crate) use job::job;
pub(crate) use log::log;
pub(crate) use man::man;
pub(crate) use path::path;
pub(crate) use pin::{pin, unpin};
pub(crate) use plan::plan;
pub(crate) use run::run;
pub(crate) use status::status;
pub(crate) use verify::verify;
pub(crate) use why::why;

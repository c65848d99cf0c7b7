//! `nerf-sr-remote`: copies finished actions and their artifacts between stores.
//!
//! * `push` and `pull`: to and from a folder or an S3-compatible server, laid out as a store:
//!   `format`, `objects/HASH/…`, `actions/KEY.json`. A record goes last, so a reader that starts
//!   from records sees whole artifacts only. A folder also has `uploads/`, with the unfinished files
//!   of each push.
//! * `export` and `import`: one artifact with its history as one tar file.
//!
//! Whatever arrives is compared with its manifest in a scratch folder of the store, and then taken
//! in by the store's own rules.

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod archive;
mod cli;
mod destination;
mod export;
mod folder;
mod import;
mod intake;
mod leftovers;
mod listing;
mod progress;
mod pull;
mod push;
mod remote;
mod selection;
mod transfer;

pub use cli::main;
// For the fuzz target.
pub use import::{Imported, import};

//! `nerf-sr-remote`: copies finished actions and their artifacts between stores.
//!
//! * `push` and `pull`: to and from a folder or an S3-compatible server with the layout of a store:
//!   `format`, `objects/HASH/…`, `actions/KEY.json`. Records are written last, so that every record
//!   refers to a complete artifact. A folder also has `uploads/`, with the incomplete files of each
//!   push.
//! * `export` and `import`: one artifact with its history as one tar file.
//!
//! All received artifacts are compared with their manifests in a scratch folder of the store, and
//! then imported by the rules of `store`.

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod cli;
mod export;
mod folder;
mod import;
mod intake;
mod pull;
mod push;
mod remote;
mod selection;
mod transfer;

pub use cli::main;
// Used by the fuzz target.
pub use import::import;

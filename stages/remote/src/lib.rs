//! `nerf-sr-remote`: copies finished actions and their artifacts between stores.
//!
//! * `push` and `pull`: to and from a folder or an S3-compatible server, laid out as a store:
//!   `format`, `objects/HASH/…`, `actions/KEY.json`. A record goes last, so a reader that starts
//!   from records sees whole artifacts only.
//! * `export` and `import`: one artifact with its history as one tar file.
//!
//! Whatever arrives is compared with its manifest in a scratch folder of the store, and then taken
//! in by the store's own rules.

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod archive;
mod cli;
mod export;
mod import;
mod intake;
mod progress;
mod pull;
mod push;
mod remote;
mod selection;
mod transfer;

pub use cli::main;

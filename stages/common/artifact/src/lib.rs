//! What every program and library here shares: artifacts' manifests, hashing, files, failures.
//!
//! * [`Manifest`]: the `artifact.json` of an artifact (kind, and each file's path, size and
//!   blake3); its hash is the artifact's identity.
//! * [`GivenInput`]: an input that a stage was given, checked against its manifest.
//! * [`canonical()`]: the one JSON form that is ever hashed.
//! * [`RunRecord`]: what a sink (the report) is told of a run.
//! * [`Failure`]: what went wrong, by what the user does next; each kind has its exit code.
//! * [`print_line!`], [`report_line!`], [`printable()`], [`counted`], [`advice()`]: words for people.
//!
//! What a stage says of itself is in `contract`, what makes a program a stage in `stage`. A library
//! that stages share needs neither.
//!
//! ```
//! use artifact::{MANIFEST_FILE, Manifest, write_json};
//!
//! let folder = tempfile::tempdir()?;
//! std::fs::write(folder.path().join("greeting.txt"), "Hello")?;
//! let manifest = Manifest::of_folder("text", folder.path())?;
//! write_json(&folder.path().join(MANIFEST_FILE), &manifest)?;
//! assert_eq!(Manifest::read(folder.path()).unwrap().identity(), manifest.identity());
//! # Ok::<(), std::io::Error>(())
//! ```

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod advice;
mod amounts;
mod canonical;
mod console;
mod failure;
mod fsio;
mod given_input;
mod manifest;
mod nearest;
mod passed_over;
mod plain;
mod printable;
mod run_record;
mod warnings;

pub use advice::advice;
pub use amounts::{amount, counted, number, sized};
pub use canonical::{canonical, hash_json};
pub use console::{print_lines, print_text, report_text};
pub use failure::{Failure, FailureExt, exit_code, one_line};
pub use fsio::{sync_folder, temporary, write_atomically, write_json, write_json_atomically};
pub use given_input::GivenInput;
pub use manifest::{
    Damage, FileEntry, ListedFiles, MANIFEST_FILE, Manifest, PathError, list_files,
    list_source_files, relative_path,
};
pub use nearest::{known_names, nearest};
pub use passed_over::has_passed_over_name;
pub use plain::{NotPlain, file_kind, plain_files};
pub use printable::{printable, shortened};
pub use run_record::{
    FailedPoint, RunInput, RunNode, RunRecord, RunRecordError, UnfinishedNode, folders_of, label,
};
pub use warnings::{WARNING, warnings_of, with_warnings};

/// Seconds since 1970.
pub fn unix_time() -> u64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

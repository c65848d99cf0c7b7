//! Base of all programs and libraries: artifacts' manifests, hashing, files, failures, messages.
//!
//! * [`Manifest`]: the `artifact.json` of an artifact (kind, and each file's path, size and
//!   blake3); its hash is the artifact's identity.
//! * [`GivenInput`]: an input of a stage, checked against its manifest.
//! * [`canonical_json`]: the only JSON form that is hashed.
//! * [`RunRecord`]: record of a run, the input of a sink such as `report`.
//! * [`Failure`]: an error, classified by the user's next step; each kind has its exit code.
//! * [`print_line!`], [`report_line!`], [`printable`], [`format_count`]: text of messages.
//!
//! Stages' descriptions and command line are in `stage`; the libraries that stages share don't
//! need it.
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

mod failure;
mod fsio;
mod given_input;
mod listing;
mod manifest;
mod run_record;
mod text;
mod type_words;

pub use failure::{Failure, FailureExt, exit_code, one_line, permission_advice};
pub use fsio::{
    canonical_json, hash_json, json_text, sync_folder, temporary, write_atomically, write_json,
    write_json_atomically,
};
pub use given_input::GivenInput;
pub use listing::{
    ListedFiles, PathError, file_kind, is_ignored_name, list_files, list_output_files,
    list_source_files, relative_path,
};
pub use manifest::{Damage, FileEntry, MANIFEST_FILE, Manifest, hash_file};
pub use run_record::{
    FailedPoint, RunInput, RunNode, RunRecord, UnfinishedNode, label, sink_folders,
};
pub use text::{
    WARNING, format_amount, format_count, format_duration, format_number, format_size, format_utc,
    known_names, nearest, print_lines, print_text, printable, report_text, shell_quoted, shortened,
    suggestion, warnings_of, with_warnings,
};

/// Returns the current time in seconds since 1970.
pub fn unix_time() -> u64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

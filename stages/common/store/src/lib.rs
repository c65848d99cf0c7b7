//! The store: artifacts by content and actions by key, kept in one folder.
//!
//! * [`Store`]: the folder. It says where each thing lies. [`FORMAT`] is the version of its layout.
//! * [`Record`], [`Unfinished`]: an action that is done, and one that was begun, by the key.
//! * [`Attempt`], [`Checked`]: from a stage's output to an object and its record.
//! * [`Arrival`]: an artifact that comes from another store.
//! * [`is_hash`]: which names can be keys or identities.
//! * [`KeyLock`]: one OS lock a key. [`Entered`] and [`Closed`]: runs and garbage collection keep
//!   clear of each other.
//! * [`RunFile`], [`Run`], [`Waiting`]: what runs and pins need.
//!
//! Only a file that is not found counts as absent. Any other error while reading is an error that
//! names the file, for what can't be read may be needed.
//!
//! Stages don't use this crate: they write a folder, and the runner takes it in.
//!
//! ```no_run
//! use store::{Locked, Record, Store, Unfinished};
//!
//! let store = Store::open(".nerf-sr".as_ref())?;
//! if let Locked::Held(entered) = store.try_enter()? {
//!     let action = Unfinished { stage: "greet".to_owned(), ..Unfinished::default() };
//!     let attempt = store.begin(&entered, &action, &serde_json::json!({}))?;
//!     std::fs::create_dir(&attempt.output)?;
//!     std::fs::write(attempt.output.join("greeting.txt"), "Hello")?;
//!     let checked = store.check(attempt, "text")?;
//!     let record = Record { stage: action.stage, ..Record::default() };
//!     let record = store.publish(&entered, checked, record)?;
//!     assert_eq!(store.hit(&record.key())?, Some(record));
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod action;
mod arrivals;
mod attempt;
mod error;
mod folder;
mod format;
mod leftovers;
mod lock;
mod objects;
mod run;
mod runs;
#[cfg(test)]
mod testing;

pub use action::{KEY_VERSION, KEY_VERSION_PART, Record, Unfinished};
pub use arrivals::Arrival;
pub use attempt::{Attempt, Checked};
pub use error::{StoreError, is_taken};
pub use folder::Store;
pub use format::FORMAT;
pub use lock::{Closed, Entered, Holder, KeyLock, Locked, host_name};
pub use objects::is_hash;
pub use run::{Run, RunFile, Waiting};

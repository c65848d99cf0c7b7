//! The store: artifacts by content and actions by key, in one folder.
//!
//! * [`Store`]: the folder and its layout, of version [`FORMAT`].
//! * [`Record`], [`Unfinished`]: a finished and an unfinished action, by key.
//! * [`Attempt`], [`CheckedOutput`]: the steps from a stage's output to an object and its record.
//! * [`Arrival`]: an artifact from another store.
//! * [`is_hash`]: the form of keys and identities.
//! * [`KeyLock`]: one OS lock per key. [`Entered`], held briefly by runs, and [`Closed`], held by
//!   garbage collection, exclude each other.
//! * [`RunFile`], [`Run`], [`PartialKey`]: the actions that runs and pins need.
//!
//! Only a file that is not found counts as absent. Any other error while reading is reported with
//! the file's name, since an unreadable file may be needed.
//!
//! Stages don't use this crate: they write a folder, which the runner publishes in the store.
//!
//! ```no_run
//! use store::{Locked, Record, Store, Unfinished};
//!
//! let store = Store::open(".nerf-sr".as_ref())?;
//! if let Locked::Acquired(entered) = store.try_enter()? {
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
mod attempt;
mod error;
mod folder;
mod format;
mod lock;
mod objects;
mod run;
#[cfg(test)]
mod testing;

pub use action::{KEY_VERSION, KEY_VERSION_PART, ModelCost, Record, SceneKind, Unfinished};
pub use attempt::{Arrival, Attempt, CheckedOutput, TimeSpent};
pub use error::{StoreError, is_lock_acquired};
pub use folder::Store;
pub use format::FORMAT;
pub use lock::{Closed, Entered, Holder, KeyLock, Locked, host_name};
pub use objects::is_hash;
pub use run::{PartialKey, Run, RunFile};

//! Garbage collection by reachability: what roots reach stays, everything else goes.
//!
//! * [`judge`]: decides, by a [`Choice`] of how long things stay. [`Verdict`]: what it decided;
//!   [`Verdict::carry_out`] removes what goes.
//! * [`Fate`]: what becomes of one artifact or unfinished action.
//! * [`Root`]: what is needed, and why. `roots`: pins, held locks, unfinished actions with a
//!   checkpoint, the plan, runs in progress and recent runs. Submissions with jobs are roots, too;
//!   where a cluster can't be asked, all of them are.
//! * `contents`: what lies in the store.
//! * `reach`: from the roots to what they name, and to what that was made of.
//!
//! ```
//! use garbage::{Choice, Root, judge};
//! use store::{Locked, Store};
//!
//! let folder = tempfile::tempdir()?;
//! let store = Store::open(folder.path())?;
//! let plan = Root { why: "the pipeline needs it".to_owned(), ..Root::default() };
//! let choice = Choice { keep_days: 30, drop_unfinished: false, drop_old: false };
//! if let Locked::Held(closed) = store.try_close()? {
//!     let verdict = judge(&store, plan, choice)?;
//!     verdict.fates().iter().for_each(|fate| println!("{fate}"));
//!     assert_eq!(verdict.bytes(), (0, 0));
//!     verdict.carry_out(&store, &closed)?;
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod contents;
mod reach;
mod roots;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use artifact::{label, unix_time};
use serde::Serialize;
use store::{Closed, Record, Run, Store, StoreError};

pub use roots::{Choice, Root};

use contents::Contents;
use reach::Kept;

/// What stays and what goes, for people and for [`Verdict::carry_out`].
pub struct Verdict {
    contents: Contents,
    kept: Kept,
    runs_to_go: Vec<String>,
}

/// Decides what goes. `plan` is what the pipeline needs.
///
/// # Errors
/// If a record, an object, an unfinished action, a run, a pin or a lock can't be read, or a record,
/// a run or a pin is damaged: what it needs isn't known then.
pub fn judge(store: &Store, plan: Root, choice: Choice) -> Result<Verdict, StoreError> {
    let contents = Contents::of(store)?;
    let runs = store.runs()?;
    // After the runs were read: whoever had submitted by then has left jobs.
    let outstanding = roots::outstanding(store)?;
    let roots = roots::roots(store, &contents, plan, choice, &runs, &outstanding)?;
    let kept = reach::reach(&contents, &roots);
    let to_go = runs.iter().filter(|run| !is_kept(run, &outstanding, choice));
    let runs_to_go = to_go.map(|run| run.id.clone()).collect();
    Ok(Verdict { contents, kept, runs_to_go })
}

fn is_kept(run: &Run, outstanding: &BTreeMap<String, String>, choice: Choice) -> bool {
    run.in_progress || outstanding.contains_key(&run.id) || choice.is_recent(run.used_unix())
}

impl Verdict {
    /// What becomes of each artifact and each unfinished action.
    pub fn fates(&self) -> Vec<Fate> {
        let mut makers: BTreeMap<&str, &Record> = BTreeMap::new();
        for record in self.contents.records.values() {
            makers.entry(&record.output).or_insert(record);
        }
        let objects = self.contents.objects.iter().map(|(identity, bytes)| {
            let maker = makers.get(identity.as_str());
            Fate {
                hash: identity.clone(),
                bytes: Some(*bytes),
                stage: maker.map(|record| label(&record.stage, &record.point)),
                started_unix: maker.map(|record| record.started_unix),
                stays: self.kept.objects.get(identity).cloned(),
            }
        });
        let unfinished = self.contents.unfinished.iter().map(|(key, action)| Fate {
            hash: key.clone(),
            bytes: None,
            stage: action.as_ref().map(|action| action.stage.clone()),
            started_unix: action.as_ref().map(|action| action.started_unix),
            stays: self.kept.unfinished.get(key).cloned(),
        });
        objects.chain(unfinished).collect()
    }

    /// A line for each artifact and each unfinished action: why it stays, or that it goes.
    #[cfg(test)]
    pub(crate) fn lines(&self) -> Vec<String> {
        self.fates().iter().map(ToString::to_string).collect()
    }

    /// Bytes that go, and bytes that stay.
    pub fn bytes(&self) -> (u64, u64) {
        (self.bytes_of(false), self.bytes_of(true))
    }

    /// Bytes of what stays, or of what goes.
    fn bytes_of(&self, stays: bool) -> u64 {
        let objects = self
            .contents
            .objects
            .iter()
            .filter(|(id, _)| self.kept.objects.contains_key(*id) == stays);
        objects.map(|(_, bytes)| bytes).sum()
    }

    /// Removes what goes: records first, so that none names an object that is gone. The store is
    /// closed meanwhile; deleting ([`Store::empty_trash`]) can wait until it is open again.
    pub fn carry_out(&self, store: &Store, closed: &Closed) -> Result<(), StoreError> {
        let goes = |kept: &BTreeMap<String, String>, key: &String| !kept.contains_key(key);
        for key in self.contents.action_files.iter().filter(|key| goes(&self.kept.records, key)) {
            store.remove_record(key)?;
        }
        for identity in self.contents.objects.keys().filter(|id| goes(&self.kept.objects, id)) {
            store.remove_object(identity)?;
        }
        for key in self.contents.unfinished.keys().filter(|key| goes(&self.kept.unfinished, key)) {
            store.remove_partial(key)?;
        }
        for key in &self.contents.left_over {
            store.remove_partial(key)?;
        }
        for run in &self.runs_to_go {
            store.remove_run(run)?;
        }
        for key in store.lock_files()? {
            if goes(&self.kept.records, &key) && goes(&self.kept.unfinished, &key) {
                store.remove_lock(&key)?;
            }
        }
        store.remove_leftovers(closed)
    }
}

/// The beginning of a hash, as people see it.
fn short(hash: &str) -> &str {
    hash.get(..10).unwrap_or(hash)
}

/// What becomes of an artifact, or of an unfinished action.
#[derive(Debug, Serialize)]
pub struct Fate {
    /// The artifact's identity, or the action's key.
    hash: String,
    /// The artifact's size; an unfinished action has none.
    bytes: Option<u64>,
    /// Stage and point that made it.
    stage: Option<String>,
    started_unix: Option<u64>,
    /// Why it stays; null where it goes.
    stays: Option<String>,
}

impl std::fmt::Display for Fate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let fate = self.stays.as_ref().map_or("goes".to_owned(), |why| format!("stays: {why}"));
        let hash = short(&self.hash);
        let Some(bytes) = self.bytes else {
            let stage = self.stage.as_deref().unwrap_or("an action");
            return write!(f, "{hash}  unfinished    {stage}: {fate}");
        };
        let hours = self.started_unix.map(|unix| unix_time().saturating_sub(unix) / 3600);
        let maker = match (&self.stage, hours) {
            (Some(stage), Some(hours)) => format!("{stage}, {hours} h old"),
            _ => "no record names it".to_owned(),
        };
        write!(f, "{hash}  {:>9.1} MB  {maker}: {fate}", bytes as f64 / 1e6)
    }
}

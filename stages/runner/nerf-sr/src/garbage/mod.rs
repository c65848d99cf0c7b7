//! Garbage collection by reachability: what the roots reach is kept, everything else is deleted
//! (docs/design/029).
//!
//! * [`Collection`]: what to keep and what to delete, decided from the store, the [`Root`] of the
//!   pipeline and a [`Policy`]. [`Collection::decisions`] lists it, [`Collection::carry_out`]
//!   removes garbage from the store.
//! * [`Decision`]: keep or delete one artifact or unfinished action, with the reason.
//! * [`Root`]: actions that are needed, and why. `roots` collects pins, held locks, unfinished
//!   actions with a checkpoint, the plan, and runs that are recent or in progress. Submissions with
//!   jobs are roots, too; if the cluster doesn't answer, all submissions are.
//! * `contents`: records, objects and unfinished actions of the store, and those that roots reach.

mod contents;
mod roots;

use std::collections::BTreeMap;

use artifact::label;
use planning::short_hash;
use serde::Serialize;
use store::{Closed, Record, Store, StoreError};

pub(crate) use roots::{Policy, Root};

use crate::planned::age_text;
use contents::{Contents, Kept};

/// A garbage collection that is decided, but not carried out yet.
pub(crate) struct Collection {
    contents: Contents,
    kept: Kept,
    /// Runs that are neither recent, in progress nor waiting for jobs, by id.
    old_runs: Vec<String>,
}

impl Collection {
    /// Decides what to keep. `plan` is the root of the actions that the pipeline needs.
    ///
    /// # Errors
    /// If a record, object, unfinished action, run, pin or lock can't be read, or a record, run or
    /// pin is damaged: artifacts that it needs are unknown then.
    pub(crate) fn new(store: &Store, plan: Root, policy: Policy) -> Result<Self, StoreError> {
        let contents = Contents::read(store)?;
        let (roots, old_runs) = roots::find_roots(store, &contents, plan, policy)?;
        let kept = contents.reach(&roots);
        Ok(Self { contents, kept, old_runs })
    }

    /// Returns the decision for each artifact, then for each unfinished action.
    pub(crate) fn decisions(&self) -> Vec<Decision> {
        let mut makers: BTreeMap<&str, &Record> = BTreeMap::new();
        for record in self.contents.records.values() {
            makers.entry(&record.output).or_insert(record);
        }
        let objects = self.contents.objects.iter().map(|(identity, bytes)| {
            let maker = makers.get(identity.as_str());
            Decision {
                hash: identity.clone(),
                bytes: Some(*bytes),
                stage: maker.map(|record| label(&record.stage, &record.point)),
                started_unix: maker.map(|record| record.started_unix),
                kept_because: self.kept.objects.get(identity).cloned(),
            }
        });
        let unfinished = self.contents.unfinished.iter().map(|(key, action)| Decision {
            hash: key.clone(),
            bytes: None,
            stage: action.as_ref().map(|action| action.stage.clone()),
            started_unix: action.as_ref().map(|action| action.started_unix),
            kept_because: self.kept.actions.get(key).cloned(),
        });
        objects.chain(unfinished).collect()
    }

    /// Moves garbage to the store's trash: records first, so that no record names a missing object.
    /// The store must be closed meanwhile. [`Store::empty_trash`] can run after it is open again.
    pub(crate) fn carry_out(&self, store: &Store, closed: &Closed) -> Result<(), StoreError> {
        let Self { contents, kept, old_runs } = self;
        let is_garbage = |key: &&String| !kept.actions.contains_key(*key);
        for key in contents.action_keys.iter().filter(is_garbage) {
            store.remove_record(key)?;
        }
        for identity in contents.objects.keys().filter(|id| !kept.objects.contains_key(*id)) {
            store.remove_object(identity)?;
        }
        let unfinished = contents.unfinished.keys().filter(is_garbage);
        for key in unfinished.chain(&contents.leftover_partials) {
            store.remove_partial(key)?;
        }
        for run in old_runs {
            store.remove_run(run)?;
        }
        for key in store.lock_files()?.iter().filter(is_garbage) {
            store.remove_lock(key)?;
        }
        store.remove_leftovers(closed)
    }
}

/// Decision for one artifact or unfinished action: keep or delete, with the reason.
#[derive(Debug, Serialize)]
pub(crate) struct Decision {
    /// Identity of the artifact, or key of the action.
    hash: String,
    /// Size of the artifact; `None` for an unfinished action.
    pub(crate) bytes: Option<u64>,
    /// Stage and point that created the artifact; stage of an unfinished action.
    stage: Option<String>,
    started_unix: Option<u64>,
    /// Reason for keeping it; `None` if it is to be deleted.
    #[serde(rename = "stays")]
    pub(crate) kept_because: Option<String>,
}

impl std::fmt::Display for Decision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let decision = match &self.kept_because {
            Some(reason) => format!("keep: {reason}"),
            None => "delete".to_owned(),
        };
        let hash = short_hash(&self.hash);
        let Some(bytes) = self.bytes else {
            let stage = self.stage.as_deref().unwrap_or("unknown action");
            return write!(f, "{hash}  unfinished    {stage}: {decision}");
        };
        let maker = match (&self.stage, self.started_unix) {
            (Some(stage), Some(unix)) => format!("{stage}, created {}", age_text(unix)),
            _ => "no record names it".to_owned(),
        };
        write!(f, "{hash}  {:>9.1} MB  {maker}: {decision}", bytes as f64 / 1e6)
    }
}

#[cfg(test)]
mod tests;

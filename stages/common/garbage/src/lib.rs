//! Garbage collection by reachability: what roots reach stays, everything else goes.
//!
//! * `roots`: pins, held locks, unfinished actions with a checkpoint, the plan, runs in progress and recent runs.
//! * Submissions with jobs are roots, too; where a cluster can't be asked, all of them are.
//! * `contents`: what lies in the store.
//! * `reach`: from the roots to what they name, and to what that was made of.

mod contents;
mod reach;
mod roots;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use artifact::{Closed, Store, StoreError, label, unix_time};

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
pub fn judge(store: &Store, plan: Root, choice: Choice) -> Result<Verdict, StoreError> {
    let contents = Contents::of(store)?;
    let runs = store.runs()?;
    // After the runs were read: whoever had submitted by then has left jobs.
    let outstanding = roots::outstanding(store)?;
    let roots = roots::roots(store, &contents, plan, choice, &runs, &outstanding)?;
    let kept = reach::reach(&contents, &roots);
    let is_kept = |run: &artifact::Run| run.in_progress || outstanding.contains_key(&run.id) || choice.is_recent(run.used_unix());
    let runs_to_go = runs.iter().filter(|run| !is_kept(run)).map(|run| run.id.clone()).collect();
    Ok(Verdict { contents, kept, runs_to_go })
}

impl Verdict {
    /// A line for each artifact and each unfinished action: why it stays, or that it goes.
    pub fn lines(&self) -> Vec<String> {
        let mut makers: BTreeMap<&str, String> = BTreeMap::new();
        for record in self.contents.records.values() {
            let age = unix_time().saturating_sub(record.started_unix) / 3600;
            makers.entry(&record.output).or_insert_with(|| format!("{}, {age} h old", label(&record.stage, &record.point)));
        }
        let fate = |why: Option<&String>| why.map_or("goes".to_owned(), |why| format!("stays: {why}"));
        let objects = self.contents.objects.iter().map(|(identity, bytes)| {
            let maker = makers.get(identity.as_str()).map_or("no record names it", String::as_str);
            let size = *bytes as f64 / 1e6;
            format!("{}  {size:>9.1} MB  {maker}: {}", short(identity), fate(self.kept.objects.get(identity)))
        });
        let unfinished = self.contents.unfinished.iter().map(|(key, action)| {
            let stage = action.as_ref().map_or("an action", |action| &action.stage);
            format!("{}  unfinished    {stage}: {}", short(key), fate(self.kept.unfinished.get(key)))
        });
        objects.chain(unfinished).collect()
    }

    /// Bytes that go, and bytes that stay.
    pub fn bytes(&self) -> (u64, u64) {
        let sum = |stays: bool| {
            let objects = self.contents.objects.iter().filter(|(id, _)| self.kept.objects.contains_key(*id) == stays);
            objects.map(|(_, bytes)| bytes).sum()
        };
        (sum(false), sum(true))
    }

    /// Removes what goes: records first, so that none names an object that is gone. The store is closed meanwhile; deleting
    /// ([`Store::empty_trash`]) can wait until it is open again.
    pub fn carry_out(&self, store: &Store, _: &Closed) -> Result<(), StoreError> {
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
        for run in &self.runs_to_go {
            store.remove_run(run)?;
        }
        for key in store.lock_files()? {
            if goes(&self.kept.records, &key) && goes(&self.kept.unfinished, &key) {
                store.remove_lock(&key)?;
            }
        }
        Ok(())
    }
}

/// The beginning of a hash, as people see it.
fn short(hash: &str) -> &str {
    hash.get(..10).unwrap_or(hash)
}

use std::collections::{BTreeMap, BTreeSet};

use artifact::unix_time;
use slurm::{Queue, Slurm};
use store::{PartialKey, Run, Store, StoreError};

use crate::garbage::contents::Contents;
use crate::planned::age_text;

/// Actions to keep, with the reason.
#[derive(Debug, Clone, Default)]
pub(crate) struct Root {
    /// Reason for keeping the actions, as a sentence fragment.
    pub(crate) reason: String,
    /// Keys of actions.
    pub(crate) keys: BTreeSet<String>,
    /// Partial keys of nodes with unknown inputs. Every record that matches a partial key is kept.
    pub(crate) waiting: Vec<PartialKey>,
    /// True to keep also the actions that produced the inputs of `keys`. False for plans and runs,
    /// whose `keys` include these actions.
    pub(crate) with_inputs: bool,
}

// Choices of the caller: ages and kinds of entries to keep. Doc comments are the options' help.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct Policy {
    /// Keep artifacts that were created or used in the last N days
    #[arg(long, default_value_t = 7, value_name = "N")]
    pub(crate) keep_days: u64,
    /// Delete checkpoints of interrupted stages, too
    #[arg(long)]
    pub(crate) drop_unfinished: bool,
    /// Delete artifacts of older versions of nerf-sr, too; no plan can use them any more
    #[arg(long)]
    pub(crate) drop_old: bool,
}

impl Policy {
    /// Returns whether a time is less than `keep_days` ago. A time in the future is recent unless
    /// `keep_days` is 0.
    pub(crate) fn is_recent(self, unix: u64) -> bool {
        unix_time().saturating_sub(unix) < self.keep_days.saturating_mul(86_400)
    }
}

/// Returns all roots of a store, and the IDs of the runs that aren't roots. If several roots reach
/// an entry, the first one gives the reason.
pub(crate) fn find_roots(
    store: &Store,
    contents: &Contents,
    plan: Root,
    policy: Policy,
) -> Result<(Vec<Root>, Vec<String>), StoreError> {
    let (mut roots, mut old_runs) = (vec![plan], Vec::new());
    for pin in store.pins()? {
        roots.push(run_root(format!("pinned as {}", pin.id), pin));
    }
    let runs = store.runs()?;
    // Submissions are read after the runs: if a run submits jobs and ends between the two reads,
    // its jobs are found.
    let submissions = outstanding_submissions(store)?;
    for run in runs {
        let used_unix = run.last_used_unix();
        let reason = if let Some(reason) = submissions.get(&run.id) {
            reason.clone()
        } else if run.in_progress {
            let process = run.holder.as_ref().map_or(0, |holder| holder.pid);
            format!("needed by the run of process {process}")
        } else if policy.is_recent(used_unix) {
            format!("used by a run {}", age_text(used_unix))
        } else {
            old_runs.push(run.id);
            continue;
        };
        roots.push(run_root(reason, run));
    }
    for key in store.locked_keys()? {
        roots.push(action_root("a stage is creating it".to_owned(), &key));
    }
    for (key, record) in &contents.records {
        if policy.is_recent(record.started_unix) {
            // The list of artifacts has their ages.
            let reason = format!("younger than --keep-days {}", policy.keep_days);
            roots.push(action_root(reason, key));
        }
        if !policy.drop_old && record.has_old_key() {
            let reason = "created by an older version of nerf-sr; deleted by --drop-old";
            roots.push(action_root(reason.to_owned(), key));
        }
    }
    if !policy.drop_unfinished {
        for key in contents.unfinished.keys() {
            if store.has_checkpoint(key)? {
                let reason = "has a checkpoint; deleted by --drop-unfinished";
                roots.push(action_root(reason.to_owned(), key));
            }
        }
    }
    Ok((roots, old_runs))
}

/// Returns the ids of submissions with unfinished jobs, each with the reason for keeping it; all
/// submissions if Slurm doesn't answer.
fn outstanding_submissions(store: &Store) -> Result<BTreeMap<String, String>, StoreError> {
    let (reason, ids) = match Queue::read(&Slurm::default(), store.root()) {
        Ok(queue) => (
            "a submitted job needs it".to_owned(),
            queue.submissions().into_iter().map(str::to_owned).collect::<Vec<_>>(),
        ),
        Err(error) => {
            let path = store.root().join("slurm");
            let submissions = slurm::list_submissions(store.root())
                .map_err(|e| StoreError::Io { path, source: std::io::Error::other(e) })?;
            let reason = format!("a submitted job may need it ({error})");
            (reason, submissions.into_iter().map(|(id, _)| id).collect())
        }
    };
    Ok(ids.into_iter().map(|id| (id, reason.clone())).collect())
}

fn action_root(reason: String, key: &str) -> Root {
    Root { reason, keys: BTreeSet::from([key.to_owned()]), waiting: Vec::new(), with_inputs: true }
}

fn run_root(reason: String, run: Run) -> Root {
    Root { reason, keys: run.keys, waiting: run.waiting, with_inputs: false }
}

use std::collections::{BTreeMap, BTreeSet};

use artifact::unix_time;
use slurm::{Queue, Slurm};
use store::{Run, Store, StoreError, Waiting};

use crate::contents::Contents;

/// Something that is needed, and why.
#[derive(Debug, Clone, Default)]
pub struct Root {
    /// As people read it after "stays:".
    pub why: String,
    /// Keys of actions.
    pub keys: BTreeSet<String>,
    /// Nodes that any fitting record may belong to.
    pub waiting: Vec<Waiting>,
    /// Whether it needs the actions that those were made of, too. A plan or a run names them
    /// itself.
    pub with_inputs: bool,
}

/// What the person who collects garbage chooses.
#[derive(Debug, Clone, Copy)]
pub struct Choice {
    /// What was used within so many days stays.
    pub keep_days: u64,
    /// Whether checkpoints of actions that nobody works on go.
    pub drop_unfinished: bool,
    /// Whether artifacts whose keys are of an older version go.
    pub drop_old: bool,
}

impl Choice {
    /// Whether a time lies within the days to keep. A time to come does, unless nothing is to be
    /// kept for its age.
    pub(crate) fn is_recent(self, unix: u64) -> bool {
        unix_time().saturating_sub(unix) < self.keep_days.saturating_mul(86_400)
    }
}

/// All roots of a store; where several hold a thing, the first says why.
pub(crate) fn roots(
    store: &Store,
    contents: &Contents,
    plan: Root,
    choice: Choice,
    runs: &[Run],
    outstanding: &BTreeMap<String, String>,
) -> Result<Vec<Root>, StoreError> {
    let mut roots = vec![plan];
    roots.extend(store.pins()?.into_iter().map(|pin| of_run(format!("pinned as {}", pin.id), pin)));
    for run in runs.iter().cloned() {
        if let Some(why) = outstanding.get(&run.id) {
            roots.push(of_run(why.clone(), run));
        } else if run.in_progress {
            let process = run.holder.as_ref().map_or(0, |holder| holder.pid);
            roots.push(of_run(format!("process {process} is running it"), run));
        } else if choice.is_recent(run.used_unix()) {
            roots.push(of_run(format!("a run {} used it", ago(run.used_unix())), run));
        }
    }
    let locked = store.locked_keys()?;
    let at_work = "a stage is at work on it";
    roots.extend(locked.iter().map(|key| of_action(at_work.to_owned(), key)));
    for (key, record) in
        contents.records.iter().filter(|(_, record)| choice.is_recent(record.started_unix))
    {
        roots.push(of_action(format!("made {}", ago(record.started_unix)), key));
    }
    if !choice.drop_old {
        let old = contents.records.iter().filter(|(_, record)| record.has_old_key());
        roots.extend(old.map(|(key, _)| {
            of_action("an older version of nerf-sr made it (--drop-old)".to_owned(), key)
        }));
    }
    if !choice.drop_unfinished {
        let why = "an unfinished action has a checkpoint (--drop-unfinished)";
        for key in contents.unfinished.keys() {
            if store.has_checkpoint(key)? {
                roots.push(of_action(why.to_owned(), key));
            }
        }
    }
    Ok(roots)
}

/// Submissions whose jobs haven't ended, with the reason. Where Slurm can't be asked, that is every
/// one.
pub(crate) fn outstanding(store: &Store) -> Result<BTreeMap<String, String>, StoreError> {
    match Queue::look(&Slurm::default(), store.root()) {
        Ok(queue) => Ok(all("a submitted job needs it", queue.submissions())),
        Err(error) => {
            let path = store.root().join("slurm");
            let submissions = slurm::all(store.root())
                .map_err(|e| StoreError::Io { path, source: std::io::Error::other(e) })?;
            let why = format!("a submitted job may need it, for {error}");
            Ok(all(&why, submissions.iter().map(|(id, _)| id.as_str())))
        }
    }
}

/// All of these submissions, with one reason.
fn all<'a>(why: &str, ids: impl IntoIterator<Item = &'a str>) -> BTreeMap<String, String> {
    ids.into_iter().map(|id| (id.to_owned(), why.to_owned())).collect()
}

fn of_action(why: String, key: &str) -> Root {
    Root { why, keys: BTreeSet::from([key.to_owned()]), waiting: Vec::new(), with_inputs: true }
}

fn of_run(why: String, run: Run) -> Root {
    Root { why, keys: run.keys, waiting: run.waiting, with_inputs: false }
}

fn ago(unix: u64) -> String {
    let hours = unix_time().saturating_sub(unix) / 3600;
    if hours < 48 { format!("{hours} h ago") } else { format!("{} days ago", hours / 24) }
}

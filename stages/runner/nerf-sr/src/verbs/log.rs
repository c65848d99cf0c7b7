use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use anyhow::Context as _;
use artifact::{format_utc, label, print_line, print_lines};
use planning::{Plan, PlanError, Request, State};

use store::{Store, StoreError};

use crate::session::{Session, node_identities, nodes_of_stage};

/// Prints the logs of a stage's nodes, or the log of the stage's last run with any arguments.
pub(crate) fn log(session: &Session, stage: &str, request: &Request) -> anyhow::Result<()> {
    let plan = session.plan(request)?;
    let nodes = nodes_of_stage(&plan, stage);
    let logs = nodes.as_ref().map_or(Ok(Vec::new()), |nodes| find_logs(session, &plan, nodes))?;
    for log in &logs {
        log.print()?;
    }
    if !logs.is_empty() {
        return Ok(());
    }
    let Some((unix, log)) = find_last_log(&session.store, stage)? else {
        // A stage of the plan may not have a log yet; an unknown stage is an error.
        nodes?;
        print_line!("{stage}: has not run yet");
        return Ok(());
    };
    print_line!(
        "{stage}: no log for these arguments; this is the log of its last run, {}",
        format_utc(unix)
    );
    log.print()
}

/// Log of one node.
struct NodeLog {
    /// Stage and point of the node.
    label: String,
    path: PathBuf,
}

impl NodeLog {
    fn print(&self) -> anyhow::Result<()> {
        let bytes = std::fs::read(&self.path).with_context(|| self.path.display().to_string())?;
        print_line!("{} ({}):", self.label, self.path.display());
        print_lines(&String::from_utf8_lossy(&bytes));
        Ok(())
    }
}

/// Finds the existing logs of nodes: for each node, the stage's log and that of the newest job.
fn find_logs(session: &Session, plan: &Plan, nodes: &[usize]) -> anyhow::Result<Vec<NodeLog>> {
    let store = &session.store;
    // Keys are unknown if an input folder is missing, but an earlier run may have a log.
    let states = match plan.states(store, None) {
        Err(PlanError::Source { .. }) => return Ok(Vec::new()),
        states => states?,
    };
    let job_logs = find_job_logs(session, plan);
    let mut logs = Vec::new();
    for &node in nodes {
        let stage_log = states[node].key().map(|key| match states[node] {
            State::Cached(_) => store.action(&key, "log"),
            _ => unfinished_log(store, &key),
        });
        let job_log = job_logs.get(node).cloned().flatten();
        for path in [stage_log, job_log].into_iter().flatten().filter(|path| path.is_file()) {
            logs.push(NodeLog { label: plan.nodes[node].label(), path });
        }
    }
    Ok(logs)
}

/// Finds the log of each node's newest job; empty if nothing was submitted.
fn find_job_logs(session: &Session, plan: &Plan) -> Vec<Option<PathBuf>> {
    let logs = slurm::newest_logs(session.store.root()).unwrap_or_default();
    if logs.is_empty() {
        // The computation of identities reads the input folders.
        return Vec::new();
    }
    let identities = node_identities(plan, &session.store, None).unwrap_or_default();
    identities.iter().map(|identity| logs.get(identity).cloned()).collect()
}

/// Returns the path of the log of an unfinished action.
fn unfinished_log(store: &Store, key: &str) -> PathBuf {
    store.partial(key).join("log")
}

/// Finds the log of a stage's last run, finished or not, with any arguments. Returns the time of
/// its end, or of its last output if it is unfinished, in seconds since 1970, and the log.
fn find_last_log(store: &Store, stage: &str) -> Result<Option<(u64, NodeLog)>, StoreError> {
    let mut logs = Vec::new();
    for record in store.records()?.into_iter().filter(|record| record.stage == stage) {
        // A log's own time may be that of a copy of the store.
        let ended_unix = record.started_unix.saturating_add(record.seconds as u64);
        let path = store.action(&record.key(), "log");
        logs.push((ended_unix, NodeLog { label: label(&record.stage, &record.point), path }));
    }
    for key in store.partials()? {
        let path = unfinished_log(store, &key);
        if let Some(action) = store.unfinished(&key)?.filter(|action| action.stage == stage)
            && let Some(unix) = modified_unix(&path)
        {
            logs.push((unix, NodeLog { label: label(&action.stage, &action.point), path }));
        }
    }
    logs.retain(|(_, log)| log.path.is_file());
    Ok(logs.into_iter().max_by_key(|(unix, _)| *unix))
}

/// Returns a file's modification time in seconds since 1970; `None` if unknown.
fn modified_unix(path: &Path) -> Option<u64> {
    let time = path.metadata().ok()?.modified().ok()?;
    Some(time.duration_since(UNIX_EPOCH).ok()?.as_secs())
}

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::UNIX_EPOCH;

use anyhow::Context as _;
use artifact::{label, print_line, print_lines};
use planning::{Plan, PlanError, Request, State};
use stage_call::utc;
use store::{Store, StoreError};

use crate::identities::identities;
use crate::session::{Session, of_stage};

/// Prints what a stage said: of the nodes that the plan comes to, or else when it last ran with
/// other arguments.
pub(crate) fn log(session: &Session, stage: &str, what: &Request) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let nodes = of_stage(&plan, stage);
    let logs = nodes.as_ref().map_or(Ok(Vec::new()), |nodes| logs_of(session, &plan, nodes))?;
    for (label, path, text) in &logs {
        print_line!("{label} ({}):", path.display());
        print_lines(text);
    }
    if !logs.is_empty() {
        return Ok(ExitCode::SUCCESS);
    }
    let Some(last) = last_of(&session.store, stage)? else {
        // Where the plan has the stage, that it has said nothing is no fault.
        nodes?;
        print_line!("{stage}: it has not run yet");
        return Ok(ExitCode::SUCCESS);
    };
    print_line!(
        "{stage}: not run with these arguments; this is of its last run, {}",
        utc(last.unix)
    );
    print_line!("{} ({}):", last.label, last.path.display());
    print_lines(&text_of(&last.path)?);
    Ok(ExitCode::SUCCESS)
}

/// Label, file and text of the logs that there are of some nodes.
fn logs_of(
    session: &Session,
    plan: &Plan,
    nodes: &[usize],
) -> anyhow::Result<Vec<(String, PathBuf, String)>> {
    // What can't be known, say of a folder that is gone, may still have a log from before.
    let states = match plan.states(&session.store, None) {
        Err(PlanError::Source { .. }) => return Ok(Vec::new()),
        states => states?,
    };
    let jobs = job_logs(session, plan);
    let mut logs = Vec::new();
    for &node in nodes {
        let stages = states[node].key().map(|key| match states[node] {
            State::Cached(_) => session.store.action(&key, "log"),
            _ => attempt_log(&session.store, &key),
        });
        for path in stages
            .into_iter()
            .chain(jobs.get(node).cloned().flatten())
            .filter(|path| path.is_file())
        {
            let text = text_of(&path)?;
            logs.push((plan.nodes[node].label(), path, text));
        }
    }
    Ok(logs)
}

/// What the newest job of each node said, where nodes were submitted.
fn job_logs(session: &Session, plan: &Plan) -> Vec<Option<PathBuf>> {
    let logs = slurm::newest_logs(session.store.root()).unwrap_or_default();
    // Without submissions no source is hashed.
    let identities =
        (!logs.is_empty()).then(|| identities(plan, &session.store, None).unwrap_or_default());
    identities.into_iter().flatten().map(|identity| logs.get(&identity).cloned()).collect()
}

fn attempt_log(store: &Store, key: &str) -> PathBuf {
    store.partial(key).join("log")
}

/// A stage's run.
struct StageRun {
    /// When it ended, or last said something.
    unix: u64,
    label: String,
    path: PathBuf,
}

/// The last run of a stage, finished or not, whatever it was run with.
fn last_of(store: &Store, stage: &str) -> Result<Option<StageRun>, StoreError> {
    let mut runs = Vec::new();
    for record in store.records()?.into_iter().filter(|record| record.stage == stage) {
        runs.push(StageRun {
            unix: record.started_unix + record.seconds as u64,
            label: label(&record.stage, &record.point),
            path: store.action(&record.key(), "log"),
        });
    }
    for key in store.partials()? {
        let path = attempt_log(store, &key);
        if let Some(action) = store.unfinished(&key)?.filter(|action| action.stage == stage)
            && let Some(unix) = changed_unix(&path)
        {
            runs.push(StageRun { unix, label: label(&action.stage, &action.point), path });
        }
    }
    runs.retain(|run| run.path.is_file());
    Ok(runs.into_iter().max_by_key(|run| run.unix))
}

/// When a file was changed last, seconds since 1970; `None` if that isn't known.
fn changed_unix(path: &Path) -> Option<u64> {
    let time = std::fs::metadata(path).ok()?.modified().ok()?;
    Some(time.duration_since(UNIX_EPOCH).ok()?.as_secs())
}

fn text_of(path: &Path) -> anyhow::Result<String> {
    let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

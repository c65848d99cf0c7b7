use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, anyhow};
use artifact::{Failure, RunFile, SUMMARY_FILE, hash_json, print_line, print_lines, report_line, report_text, stop_on_signals};

use crate::counts;
use crate::execute::{self, Options, Outcome};
use crate::plan::{Plan, Request, State};
use crate::process::StageFailure;
use crate::remedy::Remedy;
use crate::session::{Session, command_line};
use crate::sink::{Showing, Shown, show};
use crate::waiting::enter;

/// Makes what the targets need and shows it.
pub(crate) fn run(session: &Session, what: &Request, options: &Options, out: &Path, remedy: &Remedy) -> anyhow::Result<ExitCode> {
    let stop = stop_on_signals()?;
    let plan = session.plan_to_run(what, &stop)?;
    let file = match register(session, &plan, &stop) {
        Ok(file) => file,
        Err(_) if stop.load(Ordering::Relaxed) => return Err(Failure::Interrupted.into()),
        Err(error) => return Err(error.into()),
    };
    let outcome = execute::run(&plan, &session.store, &file, options, &stop);
    let code = if stop.load(Ordering::Relaxed) {
        Err(Failure::Interrupted.into())
    } else if let Some((index, failure)) = outcome.failures.first() {
        let node = &plan.nodes[*index];
        report_text(&remedy.after_failure(&node.label(), &node.stage, outcome.skipped.len()));
        Ok(ExitCode::from(failure.code))
    } else {
        let showing = Showing { plan: &plan, store: &session.store, run: &file, out, options, stop: &stop };
        say_results(session, &plan, &outcome).and_then(|()| show_all(&showing, &outcome)).map(|()| ExitCode::SUCCESS)
    };
    // A run whose end isn't written down, on a full disk, counts from its beginning.
    file.end().ok();
    code
}

/// Writes down what the run needs, as far as is known before it starts.
fn register(session: &Session, plan: &Plan, stop: &AtomicBool) -> Result<RunFile, StageFailure> {
    let fail = |e: artifact::StoreError| StageFailure { code: 1, message: e.to_string() };
    let entered = enter(&session.store, stop, &|text| report_line!("nerf-sr: {text}"))?;
    let file = session.store.begin_run(&entered, command_line()).map_err(fail)?;
    // A source that can't be read is said when the stage's turn comes; other stages may not need it.
    let states = session.states(plan).unwrap_or_default();
    for (index, node) in plan.nodes.iter().enumerate() {
        match states.get(index) {
            Some(State::Cached(record)) => file.needs(&entered, &node.stage, &record.key()),
            Some(State::WillRun { key_parts }) => file.needs(&entered, &node.stage, &hash_json(key_parts)),
            Some(State::Waits { .. }) | None => file.waits(&entered, node.waiting()),
        }
        .map_err(fail)?;
    }
    Ok(file)
}

/// Prints a few words on each result that nothing else is made of.
fn say_results(session: &Session, plan: &Plan, outcome: &Outcome) -> anyhow::Result<()> {
    let ends: BTreeSet<usize> =
        (0..plan.nodes.len()).filter(|&i| !plan.nodes.iter().any(|n| n.parents().any(|p| p == i))).collect();
    for index in ends {
        let record = outcome.records[index].as_ref().context("every node is done")?;
        let summary = std::fs::read_to_string(session.store.object(&record.output).join(SUMMARY_FILE)).unwrap_or_default();
        if !summary.is_empty() {
            print_lines(&format!("{}: {summary}", plan.nodes[index].label()));
        }
    }
    Ok(())
}

/// Calls the sinks and says what the run came to.
fn show_all(showing: &Showing<'_>, outcome: &Outcome) -> anyhow::Result<()> {
    let plan = showing.plan;
    let mut wrote = false;
    for sink in &plan.sinks {
        let shown = show(showing, sink, outcome);
        if showing.stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted.into());
        }
        match shown.map_err(|e| anyhow!("{}: {e}", sink.stage))? {
            Shown::Written(folder) => {
                wrote = true;
                print_line!("{}: {}", sink.stage, page(&folder).display());
            }
            Shown::UpToDate(folder) => print_line!("{}: {} (up to date)", sink.stage, page(&folder).display()),
            Shown::Missing => print_line!("{}: nothing to show", sink.stage),
        }
    }
    let (ran, all) = (outcome.ran.len(), plan.nodes.len());
    print_line!("{}", if ran == 0 && !wrote { counts::all_cached(all) } else { counts::ran(ran, all) });
    Ok(())
}

/// The page in a sink's folder, or the folder.
fn page(folder: &Path) -> PathBuf {
    let page = folder.join("index.html");
    if page.exists() { page } else { folder.to_path_buf() }
}

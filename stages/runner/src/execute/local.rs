//! The local executor: runs a plan's nodes whose parents are done, some at once, and then its sinks.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::sync::mpsc;

use anyhow::{Context as _, anyhow};
use artifact::{Failure, Record, SUMMARY_FILE, print_line, print_lines, report_text};
use planning::{Plan, Sink};
use stage_call::{Display, StageFailure};

use super::{Executor, NodeJob, Work};
use crate::counts;
use crate::remedy::Remedy;
use crate::session::Session;
use crate::sink::{Showing, Shown, show};

/// This machine.
pub(crate) struct Local {
    /// Stages at once.
    pub(crate) jobs: usize,
    /// Threads of all stages together.
    pub(crate) threads: usize,
    /// Whether to go on with what doesn't need a failed stage.
    pub(crate) keep_going: bool,
    /// What to say after a failure.
    pub(crate) remedy: Remedy,
}

impl Executor for Local {
    fn carry_out(&self, work: &Work<'_>) -> anyhow::Result<ExitCode> {
        let Work { session, plan, run, out, stop } = *work;
        let outcome = self::run(work, self);
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted.into());
        }
        let showing = Showing { plan, store: &session.store, run, out, threads: self.threads, stop };
        if let Some((index, failure)) = outcome.failures.first() {
            if self.keep_going {
                show_partly(&showing, &outcome)?;
            }
            let node = &plan.nodes[*index];
            report_text(&self.remedy.after_failure(&node.label(), &node.stage, outcome.skipped.len()));
            return Ok(ExitCode::from(failure.code));
        }
        say_results(session, plan, &outcome)?;
        show_all(&showing, &outcome).map(|()| ExitCode::SUCCESS)
    }
}

/// What came of a run.
struct Outcome {
    /// Each node's record, where it is done.
    records: Vec<Option<Record>>,
    /// Nodes that ran.
    ran: BTreeSet<usize>,
    /// Nodes that failed, and how.
    failures: Vec<(usize, StageFailure)>,
    /// Nodes left out because of these.
    skipped: Vec<usize>,
}

enum NodeProgress {
    Pending,
    Running,
    Over,
}

/// What a worker reports: the node, its record and whether it had to run.
type Report = (usize, Result<(Record, bool), StageFailure>);

fn run(work: &Work<'_>, options: &Local) -> Outcome {
    let Work { session, plan, run: file, stop, .. } = *work;
    let count = plan.nodes.len();
    let mut outcome = Outcome { records: vec![None; count], ran: BTreeSet::new(), failures: Vec::new(), skipped: Vec::new() };
    let mut progress: Vec<NodeProgress> = (0..count).map(|_| NodeProgress::Pending).collect();
    let display = Display::new();
    let (sender, reports) = mpsc::channel::<Report>();
    std::thread::scope(|scope| {
        let mut running = 0;
        loop {
            let give_up = stop.load(Ordering::Relaxed) || (!options.keep_going && !outcome.failures.is_empty());
            let ready: Vec<usize> = (0..count)
                .filter(|&i| {
                    matches!(progress[i], NodeProgress::Pending) && plan.nodes[i].parents().all(|p| outcome.records[p].is_some())
                })
                .collect();
            let places = if give_up { 0 } else { options.jobs.saturating_sub(running) };
            let starting = &ready[..ready.len().min(places)];
            // Stages that run side by side share the cores; one alone has them all.
            let together = (running + starting.len()).clamp(1, options.jobs);
            for &index in starting {
                progress[index] = NodeProgress::Running;
                running += 1;
                let parents: BTreeMap<usize, Record> =
                    plan.nodes[index].parents().filter_map(|p| Some((p, outcome.records[p].clone()?))).collect();
                let (sender, display) = (sender.clone(), &display);
                let threads = (options.threads / together).max(1);
                scope.spawn(move || {
                    let (node, store) = (&plan.nodes[index], &session.store);
                    let job = NodeJob { plan, node, store, file, threads, display, stop };
                    // The receiver lives as long as the scope. A panic doesn't come here: it ends the program (`panics`).
                    sender.send((index, job.run(&parents))).ok();
                });
            }
            if running == 0 {
                break;
            }
            let Ok((index, result)) = reports.recv() else { break };
            running -= 1;
            progress[index] = NodeProgress::Over;
            match result {
                Ok((record, ran)) => {
                    outcome.records[index] = Some(record);
                    if ran {
                        outcome.ran.insert(index);
                    }
                }
                Err(failure) => {
                    display.line(&format!("{}: failed: {}", plan.nodes[index].label(), failure.message));
                    outcome.failures.push((index, failure));
                }
            }
        }
    });
    outcome.skipped = (0..count).filter(|&i| matches!(progress[i], NodeProgress::Pending)).collect();
    outcome
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

/// Calls the sinks that show what there is, where some of it failed.
fn show_partly(showing: &Showing<'_>, outcome: &Outcome) -> anyhow::Result<()> {
    let mut partial = showing.plan.sinks.iter().filter(|sink| sink.program.description.partial);
    partial.try_for_each(|sink| show_one(showing, sink, outcome).map(|_| ()))
}

/// Calls a sink and says where its page is; whether it wrote one.
fn show_one(showing: &Showing<'_>, sink: &Sink, outcome: &Outcome) -> anyhow::Result<bool> {
    let shown = show(showing, sink, &outcome.records);
    if showing.stop.load(Ordering::Relaxed) {
        return Err(Failure::Interrupted.into());
    }
    let shown = shown.map_err(|e| anyhow!("{}: {e}", sink.stage))?;
    match &shown {
        Shown::Written(folder) => print_line!("{}: {}", sink.stage, page(folder).display()),
        Shown::UpToDate(folder) => print_line!("{}: {} (up to date)", sink.stage, page(folder).display()),
        Shown::Missing => print_line!("{}: nothing to show", sink.stage),
    }
    Ok(matches!(shown, Shown::Written(_)))
}

/// Calls the sinks and says what the run came to.
fn show_all(showing: &Showing<'_>, outcome: &Outcome) -> anyhow::Result<()> {
    let plan = showing.plan;
    let mut wrote = false;
    for sink in &plan.sinks {
        wrote |= show_one(showing, sink, outcome)?;
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

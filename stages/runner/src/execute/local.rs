//! The local executor: runs a plan's nodes whose parents are done, some at once, and then its
//! sinks.

use std::cell::OnceCell;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::sync::mpsc;

use anyhow::{Context as _, anyhow};
use artifact::{Failure, print_line, print_lines, report_line, report_text};
use planning::{Plan, Sink};
use stage::SUMMARY_FILE;
use stage_call::{Display, StageFailure};
use store::Record;

use super::node::{Action, Found, NodeJob, folder_of};
use super::places::{Budget, Need, Place, Places};
use super::work::{Executor, Work};
use crate::counts;
use crate::recorded::Course;
use crate::remedy::Remedy;
use crate::session::{Session, command_line};
use crate::sink::{Showing, Shown, show};
use crate::watch::{Chain, Watch};

/// This machine.
pub(crate) struct Local {
    /// What stages may take of it together.
    pub(crate) budget: Budget,
    /// Whether to go on with what doesn't need a failed stage.
    pub(crate) keep_going: bool,
    /// What to say after a failure.
    pub(crate) remedy: Remedy,
    /// How trainings are watched, where that is asked for.
    pub(crate) watch: Option<Watch>,
}

impl Executor for Local {
    fn carry_out(&self, work: &Work<'_>) -> anyhow::Result<ExitCode> {
        let Work { session, plan, run, out, stop } = *work;
        let outcome = self::run(work, self);
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted.into());
        }
        let showing =
            Showing { plan, store: &session.store, run, out, threads: self.budget.threads, stop };
        if let Some((index, failure)) = outcome.failures.first() {
            // Without any result there is hardly a page; a table names what failed.
            if self.keep_going || outcome.records.iter().any(Option::is_some) {
                // Of two failures, the stage's is the run's.
                show_partly(&showing, &outcome)
                    .unwrap_or_else(|error| report_line!("nerf-sr: {error:#}"));
            }
            let node = &plan.nodes[*index];
            report_text(&self.remedy.after_failure(
                &node.label(),
                &node.stage,
                outcome.skipped.len(),
            ));
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

/// How far a node is.
enum NodeProgress {
    /// Its parents aren't done, or it hasn't been looked at since.
    Pending,
    /// It isn't cached, and has no place yet. It is said once that it waits for memory.
    Ready {
        action: Action,
        need: Need,
        said: bool,
    },
    Running,
    Over,
}

/// What a worker reports: the node, its record and whether it had to run.
type Report = (usize, Result<(Record, bool), StageFailure>);

fn run(work: &Work<'_>, options: &Local) -> Outcome {
    let display = Display::new();
    let mut schedule = Schedule::new(work, options, &display);
    let (sender, reports) = mpsc::channel::<Report>();
    std::thread::scope(|scope| {
        loop {
            schedule.look();
            for (job, index, action) in schedule.starting() {
                let sender = sender.clone();
                // The receiver lives as long as the scope. A panic doesn't come here: it ends the
                // program (`panics`).
                scope.spawn(move || sender.send((index, job.carry_out(action))).ok());
            }
            if schedule.places.is_idle() {
                break;
            }
            let Ok(report) = reports.recv() else { break };
            schedule.take_in(report);
        }
    });
    schedule.end()
}

/// Which nodes are done, run, or wait for a place. One that is cached takes none.
struct Schedule<'a> {
    work: &'a Work<'a>,
    options: &'a Local,
    display: &'a Display,
    progress: Vec<NodeProgress>,
    places: Places,
    /// All records, once there is something to run.
    records: OnceCell<Vec<Record>>,
    outcome: Outcome,
}

impl<'a> Schedule<'a> {
    fn new(work: &'a Work<'a>, options: &'a Local, display: &'a Display) -> Self {
        let count = work.plan.nodes.len();
        Self {
            work,
            options,
            display,
            progress: (0..count).map(|_| NodeProgress::Pending).collect(),
            places: Places::new(options.budget),
            records: OnceCell::new(),
            outcome: Outcome {
                records: vec![None; count],
                ran: BTreeSet::new(),
                failures: Vec::new(),
                skipped: Vec::new(),
            },
        }
    }

    fn gives_up(&self) -> bool {
        self.work.stop.load(Ordering::Relaxed)
            || (!self.options.keep_going && !self.outcome.failures.is_empty())
    }

    fn job(&self, index: usize) -> NodeJob<'a> {
        let Work { session, plan, run: file, stop, .. } = *self.work;
        let node = &plan.nodes[index];
        let parents = node
            .parents()
            .filter_map(|parent| Some((parent, self.outcome.records[parent].clone()?)))
            .collect();
        let threads = self.options.budget.threads;
        NodeJob {
            plan,
            node,
            parents,
            store: &session.store,
            file,
            threads,
            display: self.display,
            stop,
            watch: None,
        }
    }

    /// What shows a node's checkpoints, where that is asked for and there are any.
    fn watch(&self, index: usize) -> Option<(&'a Watch, Chain)> {
        let Work { session, plan, .. } = *self.work;
        let node = &plan.nodes[index];
        let watch =
            self.options.watch.as_ref().filter(|_| node.program.description.from_checkpoint)?;
        let output_of =
            |index: usize| self.outcome.records[index].as_ref().map(|r| r.output.clone());
        let chain = Chain::find(plan, index, &|from| folder_of(from, &session.store, &output_of))
            .map(|chain| (watch, chain));
        if chain.is_none() {
            let problem = "no stage of this run can score its views yet; add a target such as eval";
            self.display.line(&format!("{}: not watched: {problem}", node.label()));
        }
        chain
    }

    /// Looks at the nodes whose parents are done. Parents come before what needs them, so one pass
    /// finds all that is cached.
    fn look(&mut self) {
        for (index, node) in self.work.plan.nodes.iter().enumerate() {
            let is_pending = matches!(self.progress[index], NodeProgress::Pending);
            if self.gives_up()
                || !is_pending
                || node.parents().any(|parent| self.outcome.records[parent].is_none())
            {
                continue;
            }
            match self.job(index).find() {
                Ok(Found::Cached(record)) => {
                    self.outcome.records[index] = Some(record);
                    self.progress[index] = NodeProgress::Over;
                }
                Ok(Found::ToDo(action)) => {
                    // Without records every stage counts as unknown.
                    let records = self
                        .records
                        .get_or_init(|| self.work.session.store.records().unwrap_or_default());
                    let need = Need::of(action.key_parts(), &node.stage, records);
                    self.progress[index] = NodeProgress::Ready { action, need, said: false };
                }
                Err(failure) => self.fail(index, failure),
            }
        }
    }

    /// Gives places to nodes that are ready, in the plan's order.
    fn starting(&mut self) -> Vec<(NodeJob<'a>, usize, Action)> {
        let mut starting = Vec::new();
        for index in 0..self.progress.len() {
            let NodeProgress::Ready { need, ref mut said, .. } = self.progress[index] else {
                continue;
            };
            match self.places.place(need) {
                Place::LaterForMemory(why) if !*said => {
                    *said = true;
                    self.display
                        .line(&format!("{}: waits: {why}", self.work.plan.nodes[index].label()));
                }
                Place::Never(message) if !self.gives_up() => {
                    self.fail(index, StageFailure { code: 1, message });
                }
                Place::Free if !self.gives_up() => {
                    let progress =
                        std::mem::replace(&mut self.progress[index], NodeProgress::Running);
                    let NodeProgress::Ready { action, .. } = progress else { continue };
                    self.places.take(index, need);
                    let job = NodeJob { watch: self.watch(index), ..self.job(index) };
                    starting.push((job, index, action));
                }
                _ => {}
            }
        }
        starting
    }

    fn take_in(&mut self, (index, result): Report) {
        self.places.give_back(index);
        match result {
            Ok((record, ran)) => {
                self.progress[index] = NodeProgress::Over;
                self.outcome.records[index] = Some(record);
                if ran {
                    self.outcome.ran.insert(index);
                }
            }
            Err(failure) => self.fail(index, failure),
        }
    }

    fn fail(&mut self, index: usize, failure: StageFailure) {
        self.progress[index] = NodeProgress::Over;
        self.display.line(&format!(
            "{}: failed: {}",
            self.work.plan.nodes[index].label(),
            failure.message
        ));
        self.outcome.failures.push((index, failure));
    }

    /// What came of it.
    fn end(mut self) -> Outcome {
        let is_over = |index: &usize| matches!(self.progress[*index], NodeProgress::Over);
        self.outcome.skipped = (0..self.progress.len()).filter(|index| !is_over(index)).collect();
        self.outcome
    }
}

/// Prints a few words on each result that nothing else is made of.
fn say_results(session: &Session, plan: &Plan, outcome: &Outcome) -> anyhow::Result<()> {
    let ends: BTreeSet<usize> = (0..plan.nodes.len())
        .filter(|&i| !plan.nodes.iter().any(|n| n.parents().any(|p| p == i)))
        .collect();
    for index in ends {
        let record = outcome.records[index].as_ref().context("every node is done")?;
        let file = session.store.object(&record.output).join(SUMMARY_FILE);
        let stored = || std::fs::read_to_string(&file).ok();
        if let Some(summary) = record.summary.clone().or_else(stored) {
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
    let command = command_line();
    let course = Course {
        records: &outcome.records,
        ran: Some(&outcome.ran),
        failures: &outcome.failures,
        command: &command,
    };
    let shown = show(showing, sink, &course);
    if showing.stop.load(Ordering::Relaxed) {
        return Err(Failure::Interrupted.into());
    }
    let shown = shown.map_err(|e| anyhow!("{}: {e}", sink.stage))?;
    match &shown {
        Shown::Written { folder, aside } => {
            say_aside(sink, aside);
            print_line!("{}: {}", sink.stage, page(folder).display());
        }
        Shown::UpToDate(folder) => {
            print_line!("{}: {} (up to date)", sink.stage, page(folder).display());
        }
        Shown::Missing => print_line!("{}: nothing to show", sink.stage),
    }
    Ok(matches!(shown, Shown::Written { .. }))
}

/// Says where what stood in a sink's place is now.
pub(crate) fn say_aside(sink: &Sink, aside: &[PathBuf]) {
    for folder in aside {
        print_line!("{}: what was there before is now {}", sink.stage, page(folder).display());
    }
}

/// Calls the sinks and says what the run came to.
fn show_all(showing: &Showing<'_>, outcome: &Outcome) -> anyhow::Result<()> {
    let plan = showing.plan;
    let mut wrote = false;
    for sink in &plan.sinks {
        wrote |= show_one(showing, sink, outcome)?;
    }
    let (ran, all) = (outcome.ran.len(), plan.nodes.len());
    print_line!(
        "{}",
        if ran == 0 && !wrote { counts::all_cached(all) } else { counts::ran(ran, all) }
    );
    Ok(())
}

/// The page in a sink's folder, or the folder.
fn page(folder: &Path) -> PathBuf {
    let page = folder.join("index.html");
    if page.exists() { page } else { folder.to_path_buf() }
}

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use artifact::{print_line, report_line, report_text};
use planning::{FrozenPlan, Node, Plan, Sink, State};
use signal_hook::consts::SIGUSR1;
use slurm::{Slurm, Submission};
use stage_call::{Display, StageFailure, stop_on_signals};
use store::{Record, RunFile, Store};

use super::run::register;
use crate::execute::{NodeJob, say_aside};
use crate::recorded::Course;
use crate::sink::{Showing, Shown, show};
use crate::unchanged::unusable;

/// Does one task of a submission, as a job of a cluster: a node, whose parents' jobs are over, or a
/// sink.
pub(crate) fn job(folder: &Path, number: usize) -> anyhow::Result<ExitCode> {
    let stop = stop_on_signals()?;
    let is_time_up = Arc::new(AtomicBool::new(false));
    for flag in [&stop, &is_time_up] {
        signal_hook::flag::register(SIGUSR1, Arc::clone(flag))?;
    }
    let root =
        folder.ancestors().nth(2).context("a submission lies in a store's folder `slurm`")?;
    let store = Store::open(root)?;
    let frozen = FrozenPlan::read(&Submission::plan_path(folder))?;
    let plan = frozen.task_plan(number)?;
    let result = register(&store, &plan, &stop).and_then(|run| {
        let (out, command) = (&frozen.out, &submitted_by(&store, folder));
        let task = Task { plan: &plan, store: &store, run: &run, out, stop: &stop, command };
        let result = task.carry_out();
        run.end().ok();
        result
    });
    let Err(failure) = result else { return Ok(ExitCode::SUCCESS) };
    report_text(&format!("nerf-sr: {}", failure.message));
    if is_time_up.load(Ordering::Relaxed) && failure.code == 130 {
        go_on_later(&plan, &store)?;
    }
    Ok(ExitCode::from(failure.code))
}

/// The command line of the run whose submission this is; nothing where that is forgotten.
fn submitted_by(store: &Store, folder: &Path) -> Vec<String> {
    let id = folder.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let run = store.run_or_pin(id).ok().flatten();
    run.map(|run| run.command).unwrap_or_default()
}

/// Puts the job into the queue once more, where its stage has left something to go on from.
fn go_on_later(plan: &Plan, store: &Store) -> anyhow::Result<()> {
    let state = plan.states(store, None)?.pop();
    let key = state.and_then(|state| state.key());
    let has_checkpoint = key.map_or(Ok(false), |key| store.has_checkpoint(&key))?;
    let Some(id) = slurm::current_job_id().filter(|_| has_checkpoint) else {
        report_line!(
            "nerf-sr: its time is up, and it left no checkpoint to go on from; give it more \
            (resources: time)"
        );
        return Ok(());
    };
    report_line!("nerf-sr: its time is up; job {id} goes on from the checkpoint later");
    Slurm::default()
        .requeue(&id)
        .context("it can't be put into the queue again; run it again to go on")
}

/// What a job does.
struct Task<'a> {
    plan: &'a Plan,
    store: &'a Store,
    run: &'a RunFile,
    out: &'a Path,
    stop: &'a AtomicBool,
    /// The command line that submitted it.
    command: &'a [String],
}

impl Task<'_> {
    fn carry_out(&self) -> Result<(), StageFailure> {
        let states = self.plan.states(self.store, Some(self.stop)).map_err(|e| unusable(&e))?;
        let records: Vec<Option<Record>> = states.into_iter().map(State::into_record).collect();
        match (self.plan.sinks.first(), self.plan.nodes.last()) {
            (Some(sink), _) => self.show(sink, &records),
            (None, Some(node)) => self.make(node, &records),
            (None, None) => Ok(()),
        }
    }

    fn make(&self, node: &Node, records: &[Option<Record>]) -> Result<(), StageFailure> {
        if records.last().is_some_and(Option::is_some) {
            print_line!("{}: is cached", node.label());
            return Ok(());
        }
        self.check(&node.label(), node.parents(), records)?;
        let parents =
            node.parents().filter_map(|parent| Some((parent, records[parent].clone()?))).collect();
        let (threads, display) = (slurm::available_cores(), Display::new());
        let Self { plan, store, run: file, stop, .. } = *self;
        NodeJob { plan, node, parents, store, file, threads, display: &display, stop, watch: None }
            .run()
            .map(drop)
    }

    fn show(&self, sink: &Sink, records: &[Option<Record>]) -> Result<(), StageFailure> {
        self.check(&sink.stage, sink.shows.iter().copied(), records)?;
        let Self { plan, store, run, out, stop, command } = *self;
        let showing = Showing { plan, store, run, out, threads: slurm::available_cores(), stop };
        let course = Course { command, ..Course::before(records) };
        match show(&showing, sink, &course)? {
            Shown::Written { folder, aside } => {
                say_aside(sink, &aside);
                print_line!("{}: {}", sink.stage, folder.display());
            }
            Shown::UpToDate(folder) => print_line!("{}: {}", sink.stage, folder.display()),
            Shown::Missing => {}
        }
        Ok(())
    }

    /// Checks that what it needs is there. That its turn has come says little: Slurm takes a
    /// forgotten job for one that went well.
    fn check(
        &self,
        label: &str,
        parents: impl Iterator<Item = usize>,
        records: &[Option<Record>],
    ) -> Result<(), StageFailure> {
        let mut missing = parents.filter(|&parent| records[parent].is_none());
        missing.next().map_or(Ok(()), |parent| {
            let parent = self.plan.nodes[parent].label();
            let message = format!(
                "{label} needs {parent}, which isn't there: its job failed, was cancelled \
                    or is forgotten; run it again"
            );
            Err(StageFailure { code: 3, message })
        })
    }
}

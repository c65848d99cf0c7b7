//! Verbs of cluster jobs: `cancel` cancels jobs, and `job` is the command that a job runs.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use artifact::{bail_bad_input, format_count, print_line, report_line};
use planning::stage_call::{Display, StageFailure, stop_on_signals};
use planning::{FrozenPlan, Plan, State};
use signal_hook::consts::SIGUSR1;
use slurm::{Queue, Slurm, Submission};
use store::{Record, Store};

use super::run::begin_run;
use crate::execute::{Lookup, NodeJob};
use crate::run_record::RunProgress;
use crate::session::Run;
use crate::sink::run_sink;
use crate::stage_failure;

/// Cancels the jobs of this store, or those of one stage. Slurm also cancels the jobs that depend
/// on them.
pub(crate) fn cancel(store: &Store, stage: Option<&str>) -> anyhow::Result<()> {
    let slurm = Slurm::default();
    let mut jobs = Queue::read(&slurm, store.root())?.jobs;
    jobs.retain(|job| stage.is_none_or(|stage| job.task.stage == stage));
    slurm.cancel(&jobs.iter().map(|job| job.id.as_str()).collect::<Vec<_>>())?;
    for job in &jobs {
        print_line!("{}: {job}", job.task.label);
    }
    let of_stage = stage.map(|stage| format!(" of {stage}")).unwrap_or_default();
    print_line!("cancelled {}{of_stage}", format_count(jobs.len(), "job"));
    Ok(())
}

/// Runs one task of a submission as a cluster's job: a node whose parents' jobs have ended, or a
/// sink.
pub(crate) fn job(folder: &Path, number: usize) -> anyhow::Result<ExitCode> {
    let stop = stop_on_signals()?;
    // Slurm sends SIGUSR1 shortly before the time limit (`Site::notice`).
    let is_time_up = Arc::new(AtomicBool::new(false));
    for flag in [&stop, &is_time_up] {
        signal_hook::flag::register(SIGUSR1, Arc::clone(flag))?;
    }
    let root =
        folder.ancestors().nth(2).context("a submission must be a folder STORE/slurm/NAME")?;
    let store = Store::open(root)?;
    let frozen = FrozenPlan::read(&Submission::plan_path(folder))?;
    let plan = frozen.task_plan(number)?;
    let result = begin_run(&store, &plan, &stop).and_then(|(file, states)| {
        // The command line of the run that wrote the submission, unless its file was deleted.
        let id = folder.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let submitting = store.run_or_pin(id).ok().flatten();
        let command = submitting.map(|run| run.command).unwrap_or_default();
        let (plan, store, out) = (&plan, &store, frozen.out.as_path());
        let run = Run { plan, states: &states, store, file: &file, out, stop: &stop };
        let result = run_task(&run, command);
        file.end().ok();
        result
    });
    let Err(error) = result else { return Ok(ExitCode::SUCCESS) };
    let StageFailure { code, message } = stage_failure(&error);
    report_line!("nerf-sr: {message}");
    if is_time_up.load(Ordering::Relaxed) && code == StageFailure::INTERRUPTED {
        requeue(&plan, &store)?;
    }
    Ok(ExitCode::from(code))
}

/// Puts the job back into the queue if its stage has left a checkpoint. Without one, the job would
/// start over for ever.
fn requeue(plan: &Plan, store: &Store) -> anyhow::Result<()> {
    let state = plan.states(store, None)?.pop();
    let key = state.and_then(|state| state.key());
    let has_checkpoint = key.map_or(Ok(false), |key| store.has_checkpoint(&key))?;
    if !has_checkpoint {
        report_line!(
            "nerf-sr: time limit reached without a checkpoint; raise the limit (resources: time)"
        );
        return Ok(());
    }
    let Some(id) = slurm::current_job_id() else {
        report_line!("nerf-sr: interrupted; run again to resume from the checkpoint");
        return Ok(());
    };
    report_line!("nerf-sr: time limit reached; job {id} will resume from the checkpoint");
    Slurm::default().requeue(&id).context("cannot requeue the job; run again to resume")
}

/// Runs the task of a plan for one job. `command` is the command line of the run that submitted the
/// task.
fn run_task(run: &Run<'_>, command: Vec<String>) -> anyhow::Result<()> {
    let states = run.plan.states(run.store, Some(run.stop))?;
    let records: Vec<Option<Record>> = states.into_iter().map(State::into_record).collect();
    let threads = stage::processors().count;
    stage::start_threads(threads);
    if let Some(sink) = run.plan.sinks.first() {
        check_parents(run.plan, &sink.stage, sink.nodes().into_iter(), &records)?;
        let progress = RunProgress { records, command, ..RunProgress::default() };
        run_sink(run, sink, threads, &progress)?;
        return Ok(());
    }
    let Some(node) = run.plan.nodes.last() else { return Ok(()) };
    if records.last().is_some_and(Option::is_some) {
        print_line!("{}: cached", node.label());
        return Ok(());
    }
    check_parents(run.plan, &node.label(), node.parents(), &records)?;
    let parents =
        node.parents().filter_map(|parent| Some((parent, records[parent].clone()?))).collect();
    let display = &Display::default();
    let job = NodeJob { run, node, parents, threads, display, estimate: None, watch: None };
    if let Lookup::Pending(pending) = job.look_up()? {
        job.carry_out(pending)?;
    }
    Ok(())
}

/// Fails if a parent has no record. A job may start without its parents, because Slurm treats a
/// forgotten job as successful.
fn check_parents(
    plan: &Plan,
    label: &str,
    mut parents: impl Iterator<Item = usize>,
    records: &[Option<Record>],
) -> anyhow::Result<()> {
    if let Some(parent) = parents.find(|&parent| records[parent].is_none()) {
        bail_bad_input!(
            "{label} needs {}, which has no artifact: its job failed, was cancelled, or is unknown \
            to Slurm; run again",
            plan.nodes[parent].label()
        );
    }
    Ok(())
}

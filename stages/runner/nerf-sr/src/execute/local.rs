//! The local executor: runs nodes whose parents are done, several at once, and then the sinks.

use std::cell::OnceCell;
use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::sync::mpsc;

use artifact::{Failure, print_line, print_lines, report_line, report_text};
use planning::stage_call::{Display, StageFailure, read_summary};
use planning::{Node, Sink};
use stage::available_memory;
use store::Record;

use super::budget::{Admission, Budget, Demand};
use super::node::{Lookup, NodeJob, PendingAction, input_folder};
use crate::estimates::{Datasets, Estimator, check_memory, run_text, total_comparison_text};
use crate::run_messages::{command_text, end_message, failure_message};
use crate::run_record::RunProgress;
use crate::session::{Run, command_line};
use crate::sink::run_sink;
use crate::stage_failure;
use crate::watch::{Chain, Watch};

/// This machine.
pub(crate) struct Local {
    /// Limits of the stages that run at the same time.
    pub(crate) budget: Budget,
    /// True if stages that don't depend on a failed one still run.
    pub(crate) keep_going: bool,
    /// Arguments of this plan for another verb.
    pub(crate) plan_arguments: Vec<String>,
    /// Options of `--watch`.
    pub(crate) watch: Option<Watch>,
}

impl Local {
    /// Runs missing nodes, then the sinks. Returns the run's exit code.
    pub(crate) fn carry_out(&self, run: &Run<'_>) -> anyhow::Result<ExitCode> {
        let plan = run.plan;
        let free = available_memory()?.unwrap_or(u64::MAX).min(self.budget.memory);
        let estimator = Estimator::new(plan, run.states, run.store, &mut Datasets::default());
        let estimates = estimator.estimates(run.states);
        check_memory(plan, &estimates, free)?;
        if let Some(text) = run_text(plan, &estimates, self.budget.cores) {
            report_text(&format!("nerf-sr: {text}"));
        }
        let NodesOutcome { progress, skipped } = run_nodes(run, self, estimator);
        if run.stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted.into());
        }
        if let Some((index, failure)) = progress.failures.first() {
            // Without any result, pages are written only with --keep-going: a table then names the
            // failed stages.
            if self.keep_going || progress.records.iter().any(Option::is_some) {
                let partial = plan.sinks.iter().filter(|sink| sink.program.description.partial);
                // A sink's failure doesn't replace the stage's exit code.
                if let Err(error) = self.run_sinks(run, partial, &progress) {
                    report_line!("nerf-sr: {error:#}");
                }
            }
            let node = &plan.nodes[*index];
            let log_command = self.log_command(&node.stage);
            report_text(&failure_message(&node.label(), skipped, &log_command));
            return Ok(ExitCode::from(failure.code));
        }
        print_summaries(run, &progress);
        let sinks = self.run_sinks(run, plan.sinks.iter(), &progress)?;
        if let Some(code) = sinks.first_failure {
            return Ok(ExitCode::from(code));
        }
        let ran = progress.ran.iter().flatten();
        let end = end_message(ran.clone().count(), plan.nodes.len(), sinks.has_written);
        let ran = ran.filter_map(|&index| Some((index, progress.records[index].as_ref()?)));
        let comparison = total_comparison_text(&estimates, ran);
        print_line!("{end}{}", comparison.map_or_else(String::new, |text| format!("; {text}")));
        Ok(ExitCode::SUCCESS)
    }

    /// Returns the command that prints a stage's log.
    fn log_command(&self, stage: &str) -> String {
        let command = command_line();
        let program = command.first().map_or("nerf-sr", String::as_str);
        let arguments = self.plan_arguments.iter().map(String::as_str);
        command_text([program, "log", stage].into_iter().chain(arguments))
    }

    /// Runs sinks, and prints the paths of their pages and their failures.
    fn run_sinks<'a>(
        &self,
        run: &Run<'_>,
        sinks: impl Iterator<Item = &'a Sink>,
        progress: &RunProgress,
    ) -> anyhow::Result<SinksOutcome> {
        let mut outcome = SinksOutcome::default();
        for sink in sinks {
            let result = run_sink(run, sink, self.budget.cores, progress);
            if run.stop.load(Ordering::Relaxed) {
                return Err(Failure::Interrupted.into());
            }
            match result {
                Ok(is_written) => outcome.has_written |= is_written,
                Err(error) => {
                    let StageFailure { code, message } = stage_failure(&error);
                    report_line!("nerf-sr: {}: {message}", sink.stage);
                    outcome.first_failure.get_or_insert(code);
                }
            }
        }
        Ok(outcome)
    }
}

/// Outcome of a run's sinks.
#[derive(Default)]
struct SinksOutcome {
    /// True if a page was written.
    has_written: bool,
    /// Exit code of the first sink that failed.
    first_failure: Option<u8>,
}

/// Outcome of a run's nodes.
struct NodesOutcome {
    /// Records of the nodes, and their failures.
    progress: RunProgress,
    /// Number of nodes that were skipped because of failures.
    skipped: usize,
}

fn run_nodes<'a>(run: &'a Run<'a>, options: &'a Local, estimator: Estimator<'a>) -> NodesOutcome {
    let display = Display::default();
    let count = run.plan.nodes.len();
    let mut schedule = Schedule {
        run,
        options,
        display: &display,
        pending: (0..count).collect(),
        ready: BTreeMap::new(),
        running: BTreeMap::new(),
        records: OnceCell::new(),
        estimator,
        progress: RunProgress {
            records: vec![None; count],
            ran: Some(BTreeSet::new()),
            command: command_line(),
            ..RunProgress::default()
        },
    };
    let (sender, reports) = mpsc::channel();
    std::thread::scope(|scope| {
        loop {
            schedule.look_up_nodes();
            for (index, job, action) in schedule.admit_nodes() {
                let sender = sender.clone();
                // The receiver lives as long as the scope. A panic ends the whole process.
                scope.spawn(move || sender.send((index, job.carry_out(action))).ok());
            }
            if schedule.running.is_empty() {
                break;
            }
            let Ok((index, result)) = reports.recv() else { break };
            schedule.finish(index, result);
        }
    });
    let skipped = schedule.pending.len() + schedule.ready.len();
    NodesOutcome { progress: schedule.progress, skipped }
}

/// Progress of a run's nodes.
struct Schedule<'a> {
    run: &'a Run<'a>,
    options: &'a Local,
    display: &'a Display,
    /// Nodes whose cache lookup is outstanding.
    pending: BTreeSet<usize>,
    /// Nodes that wait for admission, by node index.
    ready: BTreeMap<usize, ReadyNode>,
    /// Demands of the running nodes, by node index.
    running: BTreeMap<usize, Demand>,
    /// All records of the store, read when the first node isn't cached.
    records: OnceCell<Vec<Record>>,
    estimator: Estimator<'a>,
    progress: RunProgress,
}

/// A node that isn't cached and whose parents are done.
struct ReadyNode {
    action: PendingAction,
    demand: Demand,
    /// True after a line was printed that the node waits for memory.
    is_reported: bool,
}

impl<'a> Schedule<'a> {
    /// True if no further node may start.
    fn is_stopping(&self) -> bool {
        self.run.stop.load(Ordering::Relaxed)
            || (!self.options.keep_going && !self.progress.failures.is_empty())
    }

    fn report(&self, index: usize, text: &str) {
        self.display.line(&format!("{}: {text}", self.run.plan.nodes[index].label()));
    }

    fn job(&self, index: usize) -> NodeJob<'a> {
        let node = &self.run.plan.nodes[index];
        let parents = node
            .parents()
            .filter_map(|parent| Some((parent, self.progress.records[parent].clone()?)))
            .collect();
        let threads = self.options.budget.cores;
        let (run, display) = (self.run, self.display);
        NodeJob { run, node, parents, threads, display, estimate: None, watch: None }
    }

    /// Finds the stages that render and score a node's checkpoints, if `--watch` is given.
    fn watch(&self, index: usize) -> Option<(&'a Watch, Chain<'a>)> {
        let plan = self.run.plan;
        let has_checkpoints = plan.nodes[index].program.description.from_checkpoint;
        let watch = self.options.watch.as_ref().filter(|_| has_checkpoints)?;
        let chain = Chain::find(plan, index, &|origin| {
            input_folder(origin, self.run.store, &|index| {
                self.progress.records[index].as_ref().map(|record| record.output.clone())
            })
        });
        if chain.is_none() {
            let problem = "no stage of this run can score its views yet; add a target such as eval";
            self.report(index, &format!("not watched: {problem}"));
        }
        Some((watch, chain?))
    }

    /// Looks up the pending nodes whose parents are done. Parents come first in the plan, so one
    /// pass finds all cached nodes.
    fn look_up_nodes(&mut self) {
        for index in self.pending.clone() {
            let node = &self.run.plan.nodes[index];
            if self.is_stopping()
                || node.parents().any(|parent| self.progress.records[parent].is_none())
            {
                continue;
            }
            self.pending.remove(&index);
            match self.job(index).look_up() {
                Ok(Lookup::Cached(record)) => self.progress.records[index] = Some(record),
                Ok(Lookup::Pending(action)) => {
                    let records = self.records.get_or_init(|| {
                        if let Some(line) = self.options.budget.limit_line() {
                            self.display.line(&line);
                        }
                        // If records can't be read, every stage gets the default demand.
                        self.run.store.records().unwrap_or_default()
                    });
                    let demand = Demand::estimate(&action.key_parts, &node.stage, records);
                    self.ready.insert(index, ReadyNode { action, demand, is_reported: false });
                }
                Err(error) => self.fail(index, &error),
            }
        }
    }

    /// Admits ready nodes in the plan's order and returns the new jobs.
    fn admit_nodes(&mut self) -> Vec<(usize, NodeJob<'a>, PendingAction)> {
        let mut admitted = Vec::new();
        for (index, mut node) in std::mem::take(&mut self.ready) {
            match self.options.budget.admission(&self.running, node.demand) {
                Admission::Start if !self.is_stopping() => {
                    self.running.insert(index, node.demand);
                    let estimate = self.estimator.estimate(index, Some(&node.action.key_parts));
                    let job = NodeJob { estimate, watch: self.watch(index), ..self.job(index) };
                    admitted.push((index, job, node.action));
                    continue;
                }
                Admission::TooLarge(message) if !self.is_stopping() => {
                    self.fail(index, &anyhow::Error::msg(message));
                    continue;
                }
                Admission::WaitForMemory(reason) if !node.is_reported => {
                    self.report(index, &format!("waiting: {reason}"));
                    node.is_reported = true;
                }
                _ => {}
            }
            self.ready.insert(index, node);
        }
        admitted
    }

    /// Takes in a worker's result: the record, and whether the stage ran.
    fn finish(&mut self, index: usize, result: anyhow::Result<(Record, bool)>) {
        self.running.remove(&index);
        match result {
            Ok((record, ran)) => {
                self.estimator.read_scene(index, &self.run.store.object(&record.output));
                self.progress.records[index] = Some(record);
                if ran {
                    self.progress.ran.get_or_insert_default().insert(index);
                }
            }
            Err(error) => self.fail(index, &error),
        }
    }

    fn fail(&mut self, index: usize, error: &anyhow::Error) {
        let failure = stage_failure(error);
        // A stage that was interrupted has not failed.
        let failed = if failure.code == Failure::Interrupted.exit_code() { "" } else { "failed: " };
        self.report(index, &format!("{failed}{}", failure.message));
        self.progress.failures.push((index, failure));
    }
}

/// Prints the summary of each node that is no other node's parent.
fn print_summaries(run: &Run<'_>, progress: &RunProgress) {
    let plan = run.plan;
    let parents: BTreeSet<usize> = plan.nodes.iter().flat_map(Node::parents).collect();
    for (index, node) in plan.nodes.iter().enumerate() {
        if parents.contains(&index) {
            continue;
        }
        let Some(record) = &progress.records[index] else { continue };
        let recorded = record.summary.clone();
        if let Some(summary) = recorded.or_else(|| read_summary(&run.store.object(&record.output)))
        {
            print_lines(&format!("{}: {summary}", node.label()));
        }
    }
}

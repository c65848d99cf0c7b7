//! The Slurm executor: submits a job for each node or sink that is neither done nor queued, then
//! exits (docs/design/032).

use std::fs::{self, File};
use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::Ordering;

use anyhow::Context as _;
use artifact::{Failure, format_count, hash_json, print_line, report_line};
use planning::{FrozenPlan, PlanError, Sink, State};
use serde_json::json;
use slurm::{Site, Slurm, Submission, SubmitOptions, Submitted, Task};

use crate::run_messages;
use crate::run_record::RunProgress;
use crate::session::{Run, check_utf8_path, node_identities};
use crate::sink::{is_up_to_date, sink_parts};
use crate::waiting::lock_file;

/// The verb that a job calls.
pub(crate) const JOB_VERB: &str = "job";

/// A cluster that shares this store.
pub(crate) struct Cluster {
    pub(crate) site: Site,
}

impl Cluster {
    /// Submits jobs for missing nodes and sinks. Returns the run's exit code.
    pub(crate) fn carry_out(&self, run: &Run<'_>) -> anyhow::Result<ExitCode> {
        let root = run.store.root();
        let out = std::path::absolute(run.out)?;
        check_utf8_path("the folder of pages", &out)?;
        let submission = Submission::new(root, run.file.id(), tasks(run, &out)?);
        for task in &submission.tasks {
            if let Some(problem) = self.site.problem_with(&task.resources) {
                return Err(PlanError::Usage(format!("stage {}: {problem}", task.stage)).into());
            }
        }
        let runner = std::env::current_exe()
            .and_then(|exe| exe.canonicalize())
            .context("cannot find the runner's own path")?;
        let options = SubmitOptions {
            slurm: &Slurm::default(),
            site: &self.site,
            command: &[runner.as_os_str(), JOB_VERB.as_ref()],
            plan: &serde_json::to_vec(&FrozenPlan::new(run.plan, &out))
                .context("cannot serialise the plan")?,
            working_folder: &std::env::current_dir()?,
            is_stopped: &|| run.stop.load(Ordering::Relaxed),
        };
        let lock = slurm::lock_path(root);
        if let Some(folder) = lock.parent() {
            fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        let _lock = lock_file(&lock, File::options().create(true).append(true), run.stop)?;
        let submitted = submission.submit(root, &options, || find_done(run, &out))?;
        self.report(run, &submission, &submitted)
    }

    /// Prints what was submitted and returns the exit code.
    fn report(
        &self,
        run: &Run<'_>,
        submission: &Submission,
        submitted: &Submitted,
    ) -> anyhow::Result<ExitCode> {
        let Submitted { jobs, already_queued, remaining, error } = submitted;
        for (number, id) in jobs {
            print_line!("{}: job {id}", submission.tasks[*number].label);
        }
        if jobs.is_empty() && *already_queued + *remaining == 0 {
            print_line!("{}", run_messages::all_cached(run.plan.nodes.len()));
        } else {
            let new = format_count(jobs.len(), "job");
            print_line!("{new} submitted, {already_queued} already queued");
        }
        if run.stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted.into());
        }
        if *remaining > 0 {
            let max = self.site.max_submit;
            let reason = error.as_ref().map_or_else(
                || format!("at most {max} jobs may be queued at once (max_submit)"),
                ToString::to_string,
            );
            report_line!(
                "nerf-sr: {} not submitted: {reason}; run this again to submit the rest",
                format_count(*remaining, "job")
            );
        }
        Ok(if error.is_some() { ExitCode::FAILURE } else { ExitCode::SUCCESS })
    }
}

/// Returns the tasks of a run: its nodes, then its sinks.
fn tasks(run: &Run<'_>, out: &Path) -> Result<Vec<Task>, PlanError> {
    let plan = run.plan;
    let identities = node_identities(plan, run.store, Some(run.stop))?;
    let task = |stage: &str, label: String, identity: String, parents: Vec<usize>| Task {
        stage: stage.to_owned(),
        label,
        identity,
        parents,
        resources: plan.resources.get(stage).cloned().unwrap_or_default(),
    };
    let nodes = plan.nodes.iter().zip(&identities).map(|(node, identity)| {
        task(&node.stage, node.label(), identity.clone(), node.parents().collect())
    });
    let sinks = plan.sinks.iter().map(|sink| {
        let identity = sink_identity(sink, &identities, out);
        task(&sink.stage, sink.stage.clone(), identity, sink.nodes().into_iter().collect())
    });
    Ok(nodes.chain(sinks).collect())
}

fn sink_identity(sink: &Sink, node_identities: &[String], out: &Path) -> String {
    let shows: Vec<&String> =
        sink.nodes().into_iter().map(|index| &node_identities[index]).collect();
    let mut parts = sink_parts(sink);
    let own = [("sink", json!(sink.stage)), ("shows", json!(shows)), ("out", json!(out))];
    parts.extend(own.map(|(name, value)| (name.to_owned(), value)));
    hash_json(&parts)
}

/// Returns for each task whether it is done.
fn find_done(run: &Run<'_>, out: &Path) -> anyhow::Result<Vec<bool>> {
    let run = Run { out, ..*run };
    let states = run.plan.states(run.store, Some(run.stop))?;
    let records = states.into_iter().map(State::into_record).collect();
    let progress = RunProgress { records, ..RunProgress::default() };
    let mut done: Vec<bool> = progress.records.iter().map(Option::is_some).collect();
    done.extend(run.plan.sinks.iter().map(|sink| is_up_to_date(&run, sink, &progress)));
    Ok(done)
}

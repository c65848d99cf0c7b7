//! The Slurm executor: a job for each node that isn't known to be cached, and for each sink. Then
//! it leaves.

use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::Ordering;

use anyhow::Context as _;
use artifact::{Failure, counted, hash_json, print_line, report_line};
use planning::{FrozenPlan, PlanError, State};
use serde_json::json;
use slurm::{Site, Slurm, Submission, SubmitOptions, Submitted, Task};
use store::Record;

use super::work::{Executor, Work};
use crate::counts;
use crate::identities::identities;
use crate::session::check_name;
use crate::sink::is_shown;

/// The verb that a job calls.
pub(crate) const JOB_VERB: &str = "job";

/// A cluster that shares this store.
pub(crate) struct Cluster {
    /// What it wants besides.
    pub(crate) site: Site,
}

impl Executor for Cluster {
    fn carry_out(&self, work: &Work<'_>) -> anyhow::Result<ExitCode> {
        let root = work.session.store.root();
        let out = std::path::absolute(work.out)?;
        check_name("the folder of pages", &out)?;
        let submission = Submission::new(root, work.run.id(), tasks(work, &out)?);
        if let Some((task, problem)) =
            submission.tasks.iter().find_map(|t| Some((t, self.site.problem_with(&t.resources)?)))
        {
            return Err(PlanError::Usage(format!("stage {}: {problem}", task.stage)).into());
        }
        let runner = std::env::current_exe()
            .and_then(|exe| exe.canonicalize())
            .context("the runner's own path")?;
        let terms = SubmitOptions {
            slurm: &Slurm::default(),
            site: &self.site,
            command: &[runner.as_os_str(), JOB_VERB.as_ref()],
            plan: &serde_json::to_vec(&FrozenPlan::new(work.plan, &out))
                .context("the plan can't be written down")?,
            folder: &std::env::current_dir()?,
            is_stopped: &|| work.stop.load(Ordering::Relaxed),
        };
        let submitted = submission.submit(root, &terms, || done(work, &out))?;
        self.say(work, &submission, &submitted)
    }
}

impl Cluster {
    fn say(
        &self,
        work: &Work<'_>,
        submission: &Submission,
        submitted: &Submitted,
    ) -> anyhow::Result<ExitCode> {
        let Submitted { jobs, already_queued: queued, remaining: left, error } = submitted;
        for (number, id) in jobs {
            print_line!("{}: job {id}", submission.tasks[*number].label);
        }
        if jobs.is_empty() && *queued + *left == 0 {
            print_line!("{}", counts::all_cached(work.plan.nodes.len()));
        } else {
            print_line!("{} submitted, {queued} queued before", counted(jobs.len(), "job"));
        }
        if work.stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted.into());
        }
        if *left > 0 {
            let most = self.site.max_submit;
            let why = error.as_ref().map_or_else(
                || format!("at most {most} jobs are queued at once (max_submit)"),
                ToString::to_string,
            );
            report_line!("nerf-sr: {} left: {why}; run this again to go on", counted(*left, "job"));
        }
        Ok(if error.is_some() { ExitCode::FAILURE } else { ExitCode::SUCCESS })
    }
}

/// What there is to do: nodes, and after them sinks.
fn tasks(work: &Work<'_>, out: &Path) -> Result<Vec<Task>, PlanError> {
    let plan = work.plan;
    let identities = identities(plan, &work.session.store, Some(work.stop))?;
    let resources = |stage: &str| plan.resources.get(stage).cloned().unwrap_or_default();
    let nodes = plan.nodes.iter().zip(&identities).map(|(node, identity)| Task {
        stage: node.stage.clone(),
        label: node.label(),
        identity: identity.clone(),
        parents: node.parents().collect(),
        resources: resources(&node.stage),
    });
    let sinks = plan.sinks.iter().map(|sink| {
        let shows: Vec<&String> = sink.shows.iter().map(|&index| &identities[index]).collect();
        let code = &sink.program.description.code;
        let parts = json!({"sink": sink.stage, "code": code, "parameters": sink.parameters,
            "shows": shows, "out": out});
        Task {
            stage: sink.stage.clone(),
            label: sink.stage.clone(),
            identity: hash_json(&parts),
            parents: sink.shows.clone(),
            resources: resources(&sink.stage),
        }
    });
    Ok(nodes.chain(sinks).collect())
}

/// Which tasks need no job.
fn done(work: &Work<'_>, out: &Path) -> anyhow::Result<Vec<bool>> {
    let (plan, store) = (work.plan, &work.session.store);
    let records: Vec<Option<Record>> =
        plan.states(store, Some(work.stop))?.into_iter().map(State::into_record).collect();
    let sinks: Vec<bool> =
        plan.sinks.iter().map(|sink| is_shown(plan, sink, &records, store, out)).collect();
    Ok(records.iter().map(Option::is_some).chain(sinks).collect())
}

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::report_text;
use planning::{Asking, Devices, Pipeline, Plan, PlanError, Request, State};
use slurm::{Job, Queue, Slurm};
use stage::check_device;
use store::Store;

use crate::identities::identities;

/// What every verb works with.
pub(crate) struct Session {
    pub(crate) pipeline: Pipeline,
    pub(crate) store: Store,
    pub(crate) devices: Devices,
}

impl Session {
    pub(crate) fn open(
        pipeline: &Path,
        store: Option<&Path>,
        devices: Devices,
    ) -> anyhow::Result<Self> {
        check_device(&devices.given).map_err(|e| PlanError::Usage(e.to_string()))?;
        let pipeline = Pipeline::read(pipeline).map_err(PlanError::from)?;
        let root = store.map_or_else(|| pipeline.home().join(".nerf-sr"), Path::to_path_buf);
        std::fs::create_dir_all(&root).with_context(|| {
            format!("cannot open the store {}; name another with --store", root.display())
        })?;
        // Stages get absolute paths, whatever folder they run in.
        let root = root.canonicalize().with_context(|| root.display().to_string())?;
        let store =
            Store::open(&root).context("cannot open the store; name another with --store")?;
        Ok(Self { pipeline, store, devices })
    }

    /// The plan, to look at: no program is started that isn't the runner's own.
    pub(crate) fn plan(&self, what: &Request) -> anyhow::Result<Plan> {
        self.plan_asking(what, Asking::Look)
    }

    /// The plan, to be run; asking stages what they are ends when `stop` is set.
    pub(crate) fn plan_to_run(&self, what: &Request, stop: &AtomicBool) -> anyhow::Result<Plan> {
        self.plan_asking(what, Asking::Run(stop))
    }

    fn plan_asking(&self, what: &Request, asking: Asking) -> anyhow::Result<Plan> {
        let (pipeline, targets) = planning::find(&self.pipeline, &what.targets)?;
        let plan = Plan::new(&pipeline, &self.store, &Request { targets, ..what.clone() }, asking)?;
        let plan = Plan { devices: self.devices.clone(), ..plan };
        plan.notes.iter().for_each(|note| report_text(note));
        Ok(plan)
    }

    /// The queued or running job of each node, where there is one, and how many there are besides.
    /// Slurm is asked once, and only where this store has had jobs.
    pub(crate) fn jobs(&self, plan: &Plan) -> (Vec<Option<Job>>, usize) {
        let queue = Queue::look(&Slurm::default(), self.store.root()).unwrap_or_else(|error| {
            report_text(&format!("nerf-sr: whether jobs are queued isn't known: {error}"));
            Queue::default()
        });
        if queue.jobs.is_empty() {
            return (Vec::new(), 0);
        }
        let identities = identities(plan, &self.store).unwrap_or_default();
        let jobs: Vec<Option<Job>> =
            identities.iter().map(|identity| queue.job_of(identity).cloned()).collect();
        let besides = queue.jobs.len().saturating_sub(jobs.iter().flatten().count());
        (jobs, besides)
    }

    pub(crate) fn states(&self, plan: &Plan) -> anyhow::Result<Vec<State>> {
        Ok(plan.states(&self.store)?)
    }
}

/// The command line, for people: what isn't UTF-8 in it is shown as well as can be.
pub(crate) fn command_line() -> Vec<String> {
    std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect()
}

/// The nodes of a stage, by the stage's name.
pub(crate) fn of_stage(plan: &Plan, stage: &str) -> Result<Vec<usize>, PlanError> {
    let found: Vec<usize> =
        (0..plan.nodes.len()).filter(|&i| plan.nodes[i].stage == stage).collect();
    if found.is_empty() {
        if plan.sinks.iter().any(|sink| sink.stage == stage) {
            return Err(PlanError::Usage(format!(
                "{stage} is a sink: each run shows by it what it made; nothing of it is kept"
            )));
        }
        let known: BTreeSet<&str> = plan.nodes.iter().map(|n| n.stage.as_str()).collect();
        return Err(PlanError::Usage(format!(
            "no stage {stage:?} in this plan; {}",
            artifact::known_names(stage, known)
        )));
    }
    Ok(found)
}

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::{Failure, report_text};
use planning::{Describing, Devices, Origin, Pipeline, Plan, PlanError, Request, State};
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
        check_name("the pipeline's folder", &pipeline.project_folder())?;
        let root =
            store.map_or_else(|| pipeline.project_folder().join(".nerf-sr"), Path::to_path_buf);
        check_name("the store", &root)?;
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
        self.plan_asking(what, Describing::Own)
    }

    /// The plan, to be run; asking stages what they are ends when `stop` is set.
    pub(crate) fn plan_to_run(&self, what: &Request, stop: &AtomicBool) -> anyhow::Result<Plan> {
        self.plan_asking(what, Describing::Needed(stop))
    }

    fn plan_asking(&self, what: &Request, describing: Describing) -> anyhow::Result<Plan> {
        let (pipeline, targets) = planning::find_targets(&self.pipeline, &what.targets)?;
        let plan =
            Plan::new(&pipeline, &self.store, &Request { targets, ..what.clone() }, describing)?;
        let plan = Plan { devices: self.devices.clone(), ..plan };
        check_apart(&plan, "the store", self.store.root())?;
        plan.notes.iter().for_each(|note| report_text(note));
        Ok(plan)
    }

    /// The queued or running job of each node, where there is one, and how many there are besides.
    /// Slurm is asked once, and only where this store has had jobs.
    pub(crate) fn jobs(&self, plan: &Plan) -> (Vec<Option<Job>>, usize) {
        let queue = Queue::read(&Slurm::default(), self.store.root()).unwrap_or_else(|error| {
            report_text(&format!("nerf-sr: whether jobs are queued isn't known: {error}"));
            Queue::default()
        });
        if queue.jobs.is_empty() {
            return (Vec::new(), 0);
        }
        let identities = identities(plan, &self.store, None).unwrap_or_default();
        let jobs: Vec<Option<Job>> =
            identities.iter().map(|identity| queue.find_job(identity).cloned()).collect();
        let besides = queue.jobs.len().saturating_sub(jobs.iter().flatten().count());
        (jobs, besides)
    }

    pub(crate) fn states(&self, plan: &Plan) -> anyhow::Result<Vec<State>> {
        Ok(plan.states(&self.store, None)?)
    }
}

/// Refuses a folder whose name isn't UTF-8: the records of runs are JSON and contain folders'
/// names.
pub(crate) fn check_name(what: &str, folder: &Path) -> Result<(), Failure> {
    let (named, real) = (absolute(folder), real(folder));
    if named.to_str().is_some() && real.to_str().is_some() {
        return Ok(());
    }
    Err(Failure::BadInput(format!(
        "{real:?}: {what} must have a name in UTF-8; rename the folder, or use another"
    )))
}

/// Refuses a plan with an input folder that contains the folder `written`, which is the store or the
/// folder of pages, named by `what`: each run would change its own input.
pub(crate) fn check_apart(plan: &Plan, what: &str, written: &Path) -> Result<(), PlanError> {
    let written = real(written);
    for node in &plan.nodes {
        for input in &node.inputs {
            let Origin::Folder(folder) = &input.from else { continue };
            if written.starts_with(real(folder)) {
                return Err(PlanError::Usage(format!(
                    "stage {}: input {}: {} contains {what}, {}, which runs write to; name a \
                    folder without results",
                    node.stage,
                    input.name,
                    folder.display(),
                    written.display()
                )));
            }
        }
    }
    Ok(())
}

/// Returns the absolute path of a file; the empty path means the current folder.
fn absolute(path: &Path) -> PathBuf {
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

/// Returns the absolute path of a file, with links resolved as far as the file exists.
fn real(path: &Path) -> PathBuf {
    let absolute = absolute(path);
    let mut existing = absolute.as_path();
    loop {
        match (existing.canonicalize(), existing.parent()) {
            (Ok(found), _) => {
                let rest = absolute.strip_prefix(existing).unwrap_or(Path::new(""));
                // Joined by parts: an empty rest would leave a slash at the end.
                return found.components().chain(rest.components()).collect();
            }
            (Err(_), Some(parent)) => existing = parent,
            (Err(_), None) => return absolute,
        }
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

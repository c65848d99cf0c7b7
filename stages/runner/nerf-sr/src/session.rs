use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::{Failure, hash_json, report_text};
use planning::{
    Describing, Devices, Origin, Pipeline, Plan, PlanError, Request, State, read_source,
};
use slurm::{Job, Queue, Slurm};
use stage::check_device;
use store::{RunFile, Store};

use crate::planned::Planned;

/// Pipeline, store and devices of a verb.
pub(crate) struct Session {
    pub(crate) pipeline: Pipeline,
    pub(crate) store: Store,
    pub(crate) devices: Devices,
}

impl Session {
    /// Reads the pipeline and opens the store. The default store is `.nerf-sr` next to the
    /// pipeline.
    pub(crate) fn open(
        pipeline: &Path,
        store: Option<&Path>,
        devices: Devices,
    ) -> anyhow::Result<Self> {
        check_device(&devices.given).map_err(|e| PlanError::Usage(e.to_string()))?;
        let pipeline = Pipeline::read(pipeline).map_err(PlanError::from)?;
        check_utf8_path("the pipeline's folder", &pipeline.project_folder())?;
        let root =
            store.map_or_else(|| pipeline.project_folder().join(".nerf-sr"), Path::to_path_buf);
        check_utf8_path("the store", &root)?;
        std::fs::create_dir_all(&root).with_context(|| {
            format!("cannot open the store {}; choose another with --store", root.display())
        })?;
        // Stages may run in another folder, so they get absolute paths.
        let root = root.canonicalize().with_context(|| root.display().to_string())?;
        let store =
            Store::open(&root).context("cannot open the store; choose another with --store")?;
        Ok(Self { pipeline, store, devices })
    }

    /// Creates a plan for a verb that runs no stage. Only the runner's own programs are started, to
    /// describe themselves.
    pub(crate) fn plan(&self, request: &Request) -> anyhow::Result<Plan> {
        self.new_plan(request, Describing::OwnOnly)
    }

    /// Creates a plan as [`Self::plan`] does, and finds the states of its nodes.
    pub(crate) fn plan_with_states(&self, request: &Request) -> anyhow::Result<Planned<'_>> {
        let plan = self.plan(request)?;
        let states = plan.states(&self.store, None)?;
        Ok(Planned { store: &self.store, plan, states })
    }

    /// Creates a plan. `describing` states which programs may be started to describe themselves.
    pub(crate) fn new_plan(
        &self,
        request: &Request,
        describing: Describing,
    ) -> anyhow::Result<Plan> {
        let (pipeline, targets) = planning::find_targets(&self.pipeline, &request.targets)?;
        let request = Request { targets, ..request.clone() };
        let plan_of = |request: &Request| {
            let plan = Plan::new(&pipeline, &self.store, request, describing)?;
            Ok(Plan { devices: self.devices.clone(), ..plan })
        };
        let plan = plan_of(&with_artifact_folders(&pipeline, &self.store, &request, plan_of)?)?;
        check_not_in_input(&plan, "the store", self.store.root())?;
        for note in &plan.notes {
            report_text(note);
        }
        Ok(plan)
    }

    /// Finds the queued or running job of each node, and the number of this store's other jobs.
    /// Slurm is called once, and only if this store has submissions.
    pub(crate) fn jobs(&self, plan: &Plan) -> (BTreeMap<usize, Job>, usize) {
        let queue = Queue::read(&Slurm::default(), self.store.root()).unwrap_or_else(|error| {
            report_text(&format!("nerf-sr: cannot read the queue of jobs: {error}"));
            Queue::default()
        });
        if queue.jobs.is_empty() {
            return (BTreeMap::new(), 0);
        }
        let identities = node_identities(plan, &self.store, None).unwrap_or_default();
        let jobs = identities.iter().map(|identity| queue.find_job(identity).cloned()).enumerate();
        let jobs: BTreeMap<usize, Job> =
            jobs.filter_map(|(index, job)| Some((index, job?))).collect();
        let others = queue.jobs.len().saturating_sub(jobs.len());
        (jobs, others)
    }
}

/// A run in progress.
#[derive(Clone, Copy)]
pub(crate) struct Run<'a> {
    pub(crate) plan: &'a Plan,
    /// States of the nodes at the run's start; empty if an input can't be read.
    pub(crate) states: &'a [State],
    pub(crate) store: &'a Store,
    /// File of the actions that the run needs, which protects them from garbage collection.
    pub(crate) file: &'a RunFile,
    /// Folder of pages.
    pub(crate) out: &'a Path,
    pub(crate) stop: &'a AtomicBool,
}

/// Fails if a folder's path isn't UTF-8: the records of runs are JSON and contain paths.
pub(crate) fn check_utf8_path(role: &str, folder: &Path) -> Result<(), Failure> {
    let resolved = resolved_path(folder);
    if absolute_path(folder).to_str().is_some() && resolved.to_str().is_some() {
        return Ok(());
    }
    Err(Failure::BadInput(format!(
        "{resolved:?}: the path of {role} must be UTF-8; rename the folder, or choose another"
    )))
}

/// Fails if an input folder of the plan contains `written`, which is the store or the folder of
/// pages: each run would change its own input.
pub(crate) fn check_not_in_input(plan: &Plan, role: &str, written: &Path) -> Result<(), PlanError> {
    let written = resolved_path(written);
    for node in &plan.nodes {
        for input in &node.inputs {
            let Origin::Folder(folder) = &input.from else { continue };
            if written.starts_with(resolved_path(folder)) {
                return Err(PlanError::Usage(format!(
                    "stage {}: input {}: {} contains {role}, {}, to which runs write; choose a \
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
fn absolute_path(path: &Path) -> PathBuf {
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

/// Returns the absolute path of a file, with links resolved as far as the file exists.
fn resolved_path(path: &Path) -> PathBuf {
    let absolute = absolute_path(path);
    for existing in absolute.ancestors() {
        if let Ok(found) = existing.canonicalize() {
            let rest = absolute.strip_prefix(existing).unwrap_or(Path::new(""));
            // Joined by components: joining an empty rest would append a slash.
            return found.components().chain(rest.components()).collect();
        }
    }
    absolute
}

/// Returns the command line as text. Bytes that aren't UTF-8 are replaced.
pub(crate) fn command_line() -> Vec<String> {
    std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect()
}

/// Returns the indices of a stage's nodes.
pub(crate) fn nodes_of_stage(plan: &Plan, stage: &str) -> Result<Vec<usize>, PlanError> {
    let found: Vec<usize> =
        (0..plan.nodes.len()).filter(|&i| plan.nodes[i].stage == stage).collect();
    if !found.is_empty() {
        return Ok(found);
    }
    if plan.sinks.iter().any(|sink| sink.stage == stage) {
        return Err(PlanError::Usage(format!(
            "{stage} is a sink, which displays runs and has no artifact"
        )));
    }
    let known = known_stages(plan, stage);
    Err(PlanError::Usage(format!("no stage {stage:?} in this plan; {known}")))
}

/// Returns the end of a message about an unknown stage: the stages that have artifacts.
fn known_stages(plan: &Plan, unknown: &str) -> String {
    let known: BTreeSet<&str> = plan.nodes.iter().map(|node| node.stage.as_str()).collect();
    artifact::known_names(unknown, known)
}

/// Computes identities of nodes whose keys may not be known yet: hashes of the key's parts, with
/// parents' identities instead of their outputs (docs/design/032). Fails soon after `stop` is set.
pub(crate) fn node_identities(
    plan: &Plan,
    store: &Store,
    stop: Option<&AtomicBool>,
) -> Result<Vec<String>, PlanError> {
    let mut identities: Vec<String> = Vec::with_capacity(plan.nodes.len());
    for node in &plan.nodes {
        let mut inputs = Vec::new();
        for input in &node.inputs {
            let content = match &input.from {
                Origin::Node { index, subtree } => {
                    format!("{}/{}", identities[*index], subtree.as_deref().unwrap_or_default())
                }
                Origin::Folder(folder) => {
                    read_source(store, node, &input.name, folder, stop)?.content_hash()
                }
            };
            inputs.push((input.name.clone(), content));
        }
        identities.push(hash_json(&planning::key_parts(node, &inputs, plan.device(&node.stage))));
    }
    Ok(identities)
}

/// Replaces stages' names in `-i NAME=STAGE` by the folders of their artifacts: `-i init=train-ss`
/// is the artifact that `train-ss` has without this argument. An existing file of that name has
/// priority. The artifact is that of the same command line, without the argument and without the
/// stage's own parameters, which are those of the training that continues. Only the stages' names
/// in earlier arguments have been replaced in that command line. `new_plan` creates a plan of the
/// pipeline.
fn with_artifact_folders(
    pipeline: &Pipeline,
    store: &Store,
    request: &Request,
    new_plan: impl Fn(&Request) -> Result<Plan, PlanError>,
) -> Result<Request, PlanError> {
    let mut resolved = request.clone();
    for (index, input) in request.inputs.iter().enumerate() {
        let Some((name, stage)) = input.split_once('=') else { continue };
        if !pipeline.stages.contains_key(stage) || Path::new(stage).exists() {
            continue;
        }
        let mut earlier = Request { targets: vec![stage.to_owned()], ..resolved.clone() };
        earlier.inputs.remove(index);
        let plan = new_plan(&Request { parameters: Vec::new(), ..earlier.clone() })?;
        let node = plan.nodes.iter().find(|node| node.stage == stage).ok_or_else(|| {
            let known = known_stages(&plan, stage);
            PlanError::Usage(format!("-i {input}: {stage} has no artifact; {known}"))
        })?;
        let names = node.program.schema.names();
        earlier.parameters.retain(|text| !is_of_stage(text, stage, &names));
        let folder = artifact_folder(store, &new_plan(&earlier)?, stage, input)?;
        resolved.inputs[index] = format!("{name}={folder}");
    }
    Ok(resolved)
}

/// Returns the folder of a stage's artifact, for the argument `input`.
fn artifact_folder(
    store: &Store,
    plan: &Plan,
    stage: &str,
    input: &str,
) -> Result<String, PlanError> {
    let states = plan.states(store, None)?;
    let mut found = plan.nodes.iter().zip(states).filter(|(node, _)| node.stage == stage);
    let problem = match (found.next(), found.next()) {
        (Some((_, State::Cached(record))), None) => {
            return Ok(store.object(&record.output).display().to_string());
        }
        (Some(_), None) => format!("has no artifact yet; run it first: nerf-sr run {stage}"),
        _ => "has several points; name the folder of one (`nerf-sr path`)".to_owned(),
    };
    Err(PlanError::Usage(format!("-i {input}: {stage} {problem}")))
}

/// True if an argument of `-p` sets a parameter of the stage.
fn is_of_stage(text: &str, stage: &str, names: &[&str]) -> bool {
    let name = text.split('=').next().unwrap_or_default();
    name.strip_prefix(stage).is_some_and(|rest| rest.starts_with('.')) || names.contains(&name)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn an_input_from_a_stage_without_an_artifact_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let pipeline = "default: [make]\nstages: {make: {}, show: {inputs: {run: make}}}";
        let pipeline = Pipeline::parse(pipeline.as_bytes(), Path::new("pipeline.yaml")).unwrap();
        let mut descriptions = BTreeMap::new();
        for (name, is_sink) in [("make", false), ("show", true)] {
            let inputs =
                if is_sink { json!({"run": {"kinds": ["run"], "summary": ""}}) } else { json!({}) };
            let description = serde_json::from_value(json!({"name": name, "version": "",
                "code": "", "summary": "", "parameters": {}, "output": {"kind": "x"},
                "inputs": inputs, "sink": is_sink}));
            descriptions.insert(name.to_owned(), description.unwrap());
        }
        let new_plan =
            |request: &Request| Plan::from_descriptions(&pipeline, &descriptions, request);
        for (input, message) in [
            ("init=show", "-i init=show: show has no artifact; known: make"),
            ("init=make", "-i init=make: make has no artifact yet; run it first: nerf-sr run make"),
        ] {
            let request = Request { inputs: vec![input.to_owned()], ..Request::default() };
            let error = with_artifact_folders(&pipeline, &store, &request, new_plan).unwrap_err();
            assert_eq!(error.to_string(), message);
        }
    }

    #[test]
    fn arguments_are_matched_to_their_stage() {
        let names = ["rays", "seed"];
        for (text, expected) in [
            ("rays=30M", true),
            ("train-ss.rays=1,2", true),
            ("prep.scale=3", false),
            ("scale=3", false),
            ("train-ss-2.rays=1", false),
            ("", false),
        ] {
            assert_eq!(is_of_stage(text, "train-ss", &names), expected, "{text}");
        }
    }
}

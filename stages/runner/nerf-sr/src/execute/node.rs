//! Runs one node under its key's lock.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use artifact::{format_duration, hash_json, unix_time};
use planning::stage_call::{Call, Display, StageDisplay, StageFailure, Usage, read_summary};
use planning::{HashedInputs, Node, Origin, hash_inputs, short_hash, stored_inputs};
use serde_json::{Map, Value};
use store::{Attempt, Entered, KeyLock, Record, Store, TimeSpent, Unfinished, host_name};

use crate::estimates::{Estimate, comparison_text};
use crate::session::Run;
use crate::unchanged::{Inputs, call_confirmed};
use crate::waiting::{enter_store, wait_for_lock};
use crate::watch::{Chain, Watch, Watching, scratch_name};

/// Action of a node that isn't cached.
pub(crate) struct PendingAction {
    key: String,
    pub(super) key_parts: Map<String, Value>,
    inputs: HashedInputs,
}

/// Cache lookup result of a node whose parents are done.
pub(crate) enum Lookup {
    Cached(Record),
    Pending(PendingAction),
}

/// A node to run, with everything that running it needs.
pub(crate) struct NodeJob<'a> {
    pub(crate) run: &'a Run<'a>,
    pub(crate) node: &'a Node,
    /// Records of the parents by node index.
    pub(crate) parents: BTreeMap<usize, Record>,
    pub(crate) threads: usize,
    pub(crate) display: &'a Display,
    /// Expected cost.
    pub(crate) estimate: Option<Estimate>,
    /// Stages that render and score the node's checkpoints, if the node is watched.
    pub(crate) watch: Option<(&'a Watch, Chain<'a>)>,
}

impl NodeJob<'_> {
    /// Looks up the node's record. Cached or not, the node's key is first written to the run's
    /// file, which protects the artifact from garbage collection.
    pub(crate) fn look_up(&self) -> anyhow::Result<Lookup> {
        let inputs = hash_inputs(self.node, self.run.store, Some(self.run.stop), |index| {
            self.output_of(index)
        })?;
        let key_parts =
            planning::key_parts(self.node, &inputs.hashes, self.run.plan.device(&self.node.stage));
        let key = hash_json(&key_parts);
        let entered = self.enter()?;
        self.run.file.record_action(&entered, &self.node.stage, &key)?;
        Ok(match self.run.store.hit(&key)? {
            Some(record) => Lookup::Cached(record),
            None => Lookup::Pending(PendingAction { key, key_parts, inputs }),
        })
    }

    /// Runs the node unless another runner has done so meanwhile. Returns the record and whether
    /// the stage ran.
    pub(crate) fn carry_out(&self, pending: PendingAction) -> anyhow::Result<(Record, bool)> {
        let PendingAction { key, key_parts, inputs } = pending;
        let report = |text: &str| self.report(text);
        let lock = wait_for_lock(self.run.stop, "is being created", &report, || {
            self.run.store.try_lock(&key)
        })?;
        let stored = stored_inputs([self.node], self.run.store)?;
        let action = Unfinished {
            stage: self.node.stage.clone(),
            point: self.node.point.clone(),
            key_parts,
            made_of: self.parents.values().chain(&stored).map(Record::key).collect(),
            started_unix: unix_time(),
        };
        let attempt = {
            let entered = self.enter()?;
            let kind = &self.node.program.description.output.kind;
            let record = self.run.store.hit_or_repair(&entered, &key, kind)?;
            if let Some(record) = record {
                return Ok((record, false));
            }
            self.run.store.begin(&entered, &action, &self.node.parameters)?
        };
        let inputs = Inputs::new(self.node, self.run.store, inputs, |index| self.output_of(index))?;
        self.run_and_publish(&lock, attempt, action, &inputs).map(|record| (record, true))
    }

    fn output_of(&self, index: usize) -> String {
        self.parents[&index].output.clone()
    }

    fn report(&self, text: &str) {
        self.display.line(&format!("{}: {text}", self.node.label()));
    }

    fn enter(&self) -> anyhow::Result<Entered> {
        enter_store(self.run.store, self.run.stop, &|text| self.report(text))
    }

    /// Calls the stage and publishes its artifact.
    fn run_and_publish(
        &self,
        lock: &KeyLock,
        attempt: Attempt,
        action: Unfinished,
        inputs: &Inputs<'_>,
    ) -> anyhow::Result<Record> {
        let store = self.run.store;
        let (peak_memory, time) = call_confirmed(&self.node.program, store, self.run.stop, || {
            self.call(lock, &attempt, inputs)
        })?;
        inputs.check_again(&attempt)?;
        let record = Record {
            stage: action.stage,
            point: action.point,
            key_parts: action.key_parts,
            made_of: action.made_of,
            output: String::new(),
            started_unix: action.started_unix,
            seconds: round_to_milliseconds(time.seconds),
            threads: self.threads,
            peak_memory: Some(peak_memory),
            processor_seconds: Some(round_to_milliseconds(time.processor_seconds)),
            model: self.estimate.map(|estimate| estimate.model),
            host: host_name(),
            summary: read_summary(&attempt.output),
        };
        let kind = &self.node.program.description.output.kind;
        let checked = store.check(attempt, kind)?;
        let record = store.publish(&self.enter()?, checked, record)?;
        let estimate = self.estimate.and_then(|estimate| comparison_text(&estimate, &record));
        self.report(&format!(
            "done in {}, artifact {}{}",
            format_duration(record.seconds),
            short_hash(&record.output),
            estimate.map_or_else(String::new, |text| format!(" ({text})"))
        ));
        Ok(record)
    }

    /// Calls the stage. Returns its peak memory, and the time of the call and of the calls whose
    /// checkpoints it resumed from. Fails if an input differs from the one in the key.
    fn call(
        &self,
        lock: &KeyLock,
        attempt: &Attempt,
        inputs: &Inputs<'_>,
    ) -> anyhow::Result<(u64, TimeSpent)> {
        let label = self.node.label();
        inputs.check(self.run.stop)?;
        if inputs.drop_doubtful_checkpoints(attempt)? {
            self.report("an input was written to after the checkpoint; starting over");
        }
        let mut folders: Vec<(String, PathBuf)> = Vec::new();
        for input in &self.node.inputs {
            let folder =
                input_folder(&input.from, self.run.store, &|index| Some(self.output_of(index)));
            folders.extend(folder.map(|folder| (input.name.clone(), folder)));
        }
        let call = Call {
            label: &label,
            program: &self.node.program.path,
            description: &self.node.program.description,
            params: &attempt.params,
            inputs: &folders,
            hashes: &inputs.hashes,
            output: &attempt.output,
            work: Some(&attempt.work),
            from_checkpoint: false,
            device: self.run.plan.device(&self.node.stage),
            threads: self.threads,
            lock: Some(&lock.file),
        };
        let stage_display = self.display.start(&label);
        let earlier = attempt.time_spent();
        let started = Instant::now();
        let (usage, result) = self.run_watched(&call, attempt, &stage_display);
        let time = TimeSpent {
            seconds: earlier.seconds + started.elapsed().as_secs_f64(),
            processor_seconds: earlier.processor_seconds + usage.processor_seconds,
        };
        stage_display.end();
        // Without the file, only the record's time is too short.
        attempt.record_time_spent(&time).ok();
        result?;
        Ok((usage.peak_memory, time))
    }

    /// Runs the stage. If the node is watched, a second thread takes looks until the stage ends.
    fn run_watched(
        &self,
        call: &Call<'_>,
        attempt: &Attempt,
        stage_display: &StageDisplay<'_>,
    ) -> (Usage, Result<(), StageFailure>) {
        let Some((watch, chain)) = &self.watch else {
            return call.run(&attempt.log, stage_display, self.run.stop);
        };
        let is_over = AtomicBool::new(false);
        let scratch = self.run.store.scratch(self.run.file.id()).join(scratch_name(call.label));
        let (label, display, is_over) = (call.label, self.display, &is_over);
        let watching = Watching { watch, chain, label, scratch, display, is_over };
        std::thread::scope(|scope| {
            scope.spawn(|| watching.run(call));
            let result = call.run(&attempt.log, stage_display, self.run.stop);
            is_over.store(true, Ordering::Relaxed);
            result
        })
    }
}

/// Returns the folder of an input; `None` if its artifact doesn't exist yet. `output_of` returns
/// the artifact of a node.
pub(super) fn input_folder(
    origin: &Origin,
    store: &Store,
    output_of: &dyn Fn(usize) -> Option<String>,
) -> Option<PathBuf> {
    match origin {
        Origin::Node { index, subtree } => {
            let object = store.object(&output_of(*index)?);
            Some(subtree.as_ref().map_or(object.clone(), |s| object.join(s)))
        }
        Origin::Folder(folder) => Some(folder.clone()),
    }
}

fn round_to_milliseconds(seconds: f64) -> f64 {
    (seconds * 1e3).round() / 1e3
}

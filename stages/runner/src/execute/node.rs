//! Makes one node, under its key's lock.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use artifact::{hash_json, unix_time};
use planning::{FoundInputs, Node, NodeInput, Origin, Plan, find_inputs};
use serde_json::{Map, Value};
use stage_call::{Call, Display, StageFailure, StageView, Usage, read_summary, seconds};
use store::{Attempt, Entered, Holder, KeyLock, Record, RunFile, Store, Unfinished, host_name};

use crate::unchanged::{ConfirmedProgram, Inputs, unusable};
use crate::waiting::{by, enter, until_held};
use crate::watch::{Chain, Watch, Watching};

/// A node's action that isn't done.
pub(crate) struct Action {
    key_parts: Map<String, Value>,
    inputs: FoundInputs,
}

impl Action {
    pub(crate) fn key_parts(&self) -> &Map<String, Value> {
        &self.key_parts
    }
}

/// What there is of a node whose parents are done.
pub(crate) enum Found {
    Cached(Record),
    ToDo(Action),
}

/// One node's work.
pub(crate) struct NodeJob<'a> {
    pub(crate) plan: &'a Plan,
    pub(crate) node: &'a Node,
    /// Of the nodes that it needs.
    pub(crate) parents: BTreeMap<usize, Record>,
    pub(crate) store: &'a Store,
    pub(crate) file: &'a RunFile,
    pub(crate) threads: usize,
    pub(crate) display: &'a Display,
    pub(crate) stop: &'a AtomicBool,
    /// How its checkpoints are shown, where they are.
    pub(crate) watch: Option<(&'a Watch, Chain)>,
}

impl NodeJob<'_> {
    /// Finds the record or makes it.
    pub(crate) fn run(&self) -> Result<Record, StageFailure> {
        match self.find()? {
            Found::Cached(record) => Ok(record),
            Found::ToDo(action) => self.carry_out(action).map(|(record, _)| record),
        }
    }

    /// Looks whether it is cached. Either way it is written down that this run needs it, so that it
    /// can't go meanwhile.
    pub(crate) fn find(&self) -> Result<Found, StageFailure> {
        let inputs =
            find_inputs(self.node, self.store, Some(self.stop), |index| self.output_of(index))
                .map_err(|e| unusable(&e))?;
        let key_parts = planning::key_parts(self.node, &inputs.hashes, self.device());
        let key = hash_json(&key_parts);
        let entered = self.enter()?;
        self.file.needs(&entered, &self.node.stage, &key).map_err(fail)?;
        let record = self.store.hit(&key).map_err(fail)?;
        Ok(record.map_or(Found::ToDo(Action { key_parts, inputs }), Found::Cached))
    }

    /// Makes it; whether it had to.
    pub(crate) fn carry_out(&self, action: Action) -> Result<(Record, bool), StageFailure> {
        let Action { key_parts, inputs } = action;
        let key = hash_json(&key_parts);
        let lock =
            until_held(self.stop, &|holder, waited| self.say_waiting(holder, waited), || {
                self.store.try_lock(&key)
            })?;
        let action = Unfinished {
            stage: self.node.stage.clone(),
            point: self.node.point.clone(),
            key_parts,
            made_of: self.parents.values().map(Record::key).collect(),
            started_unix: unix_time(),
        };
        let attempt = {
            let entered = self.enter()?;
            // Another runner may have made it while this one waited.
            let kind = &self.node.program.description.output.kind;
            let record = self.store.hit_or_repair(&entered, &key, kind).map_err(fail)?;
            if let Some(record) = record {
                return Ok((record, false));
            }
            self.store.begin(&entered, &action, &self.node.parameters).map_err(fail)?
        };
        let inputs = Inputs::new(self.node, self.store, inputs, |index| self.output_of(index))?;
        self.make(&lock, attempt, action, &inputs).map(|record| (record, true))
    }

    fn output_of(&self, index: usize) -> String {
        self.parents[&index].output.clone()
    }

    fn device(&self) -> &str {
        self.plan.device(&self.node.stage)
    }

    fn enter(&self) -> Result<Entered, StageFailure> {
        enter(self.store, self.stop, &|text| {
            self.display.line(&format!("{}: {text}", self.node.label()));
        })
    }

    fn say_waiting(&self, holder: Option<&Holder>, waited: Duration) {
        let waited = seconds(waited.as_secs_f64());
        self.display.line(&format!(
            "{}: is being made{}; waits for it, for {waited} now",
            self.node.label(),
            by(holder)
        ));
    }

    /// Calls the stage and takes in what it made.
    fn make(
        &self,
        lock: &KeyLock,
        attempt: Attempt,
        action: Unfinished,
        inputs: &Inputs<'_>,
    ) -> Result<Record, StageFailure> {
        let (usage, time) = self.call(lock, &attempt, inputs)?;
        let record = Record {
            stage: action.stage,
            point: action.point,
            key_parts: action.key_parts,
            made_of: action.made_of,
            output: String::new(),
            started_unix: action.started_unix,
            seconds: milliseconds(time.as_secs_f64()),
            threads: self.threads,
            peak_memory: Some(usage.peak_memory),
            processor_seconds: Some(milliseconds(usage.processor_seconds)),
            host: host_name(),
            summary: read_summary(&attempt.output),
        };
        let checked =
            self.store.check(attempt, &self.node.program.description.output.kind).map_err(fail)?;
        let record = self.store.publish(&self.enter()?, checked, record).map_err(fail)?;
        self.display.line(&format!(
            "{}: done in {} → {}",
            self.node.label(),
            seconds(record.seconds),
            &record.output[..10]
        ));
        Ok(record)
    }

    /// Calls the stage. Fails unless program and inputs are those of the key from before the start
    /// to the end. Returns the stage's usage and its running time.
    fn call(
        &self,
        lock: &KeyLock,
        attempt: &Attempt,
        inputs: &Inputs<'_>,
    ) -> Result<(Usage, Duration), StageFailure> {
        let label = self.node.label();
        let program = ConfirmedProgram::new(&self.node.program, self.store, self.stop)?;
        inputs.check(self.stop)?;
        if inputs.drop_doubtful_checkpoints(attempt).map_err(fail)? {
            self.display.line(&format!(
                "{label}: an input was written to since its checkpoint; it starts over"
            ));
        }
        let folders: Vec<(String, PathBuf)> = self
            .node
            .inputs
            .iter()
            .filter_map(|input| Some((input.name.clone(), self.folder_of(input)?)))
            .collect();
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
            device: self.device(),
            threads: self.threads,
            lock: Some(lock.file()),
        };
        let view = self.display.start(&label);
        let started = Instant::now();
        let result = self.run_watched(&call, attempt, &view);
        let time = started.elapsed();
        view.end();
        let usage = result?;
        program.confirm_again()?;
        inputs.check(self.stop).inspect_err(|_| {
            // Checkpoints may contain the changed input, even if it gets its old content back.
            std::fs::remove_dir_all(&attempt.work).ok();
        })?;
        Ok((usage, time))
    }

    /// Runs the stage; whoever watches its checkpoints ends when it does.
    fn run_watched(
        &self,
        call: &Call<'_>,
        attempt: &Attempt,
        view: &StageView<'_>,
    ) -> Result<Usage, StageFailure> {
        let Some((watch, chain)) = &self.watch else {
            return call.run(&attempt.log, view, self.stop);
        };
        let is_over = AtomicBool::new(false);
        let scratch = self.store.scratch(self.file.id()).join(format!("watch-{}", call.label));
        let (label, display, is_over) = (call.label, self.display, &is_over);
        let watching = Watching { watch, chain, label, scratch, display, is_over };
        std::thread::scope(|scope| {
            scope.spawn(|| watching.run(call));
            let result = call.run(&attempt.log, view, self.stop);
            is_over.store(true, Ordering::Relaxed);
            result
        })
    }

    fn folder_of(&self, input: &NodeInput) -> Option<PathBuf> {
        folder_of(&input.from, self.store, &|index| Some(self.output_of(index)))
    }
}

/// Where an input lies; none where it isn't made yet.
pub(super) fn folder_of(
    from: &Origin,
    store: &Store,
    output_of: &dyn Fn(usize) -> Option<String>,
) -> Option<PathBuf> {
    match from {
        Origin::Node { index, subtree } => {
            let object = store.object(&output_of(*index)?);
            Some(subtree.as_ref().map_or(object.clone(), |s| object.join(s)))
        }
        Origin::Folder(folder) => Some(folder.clone()),
    }
}

/// Seconds to the millisecond.
fn milliseconds(seconds: f64) -> f64 {
    (seconds * 1e3).round() / 1e3
}

/// A failure that is neither the input's nor the numbers'.
fn fail(error: impl std::fmt::Display) -> StageFailure {
    StageFailure { code: 1, message: error.to_string() }
}

//! Runs a plan: nodes whose parents are done, some at once, each under its key's lock.

use std::collections::{BTreeMap, BTreeSet};
use std::io::IsTerminal as _;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, mpsc};
use std::time::{Duration, Instant};

use artifact::{
    Attempt, Entered, Event, Holder, KeyLock, Pace, Record, RunFile, Store, Unfinished, hash_json, host_name, printable,
    report_text, unix_time,
};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

use crate::key;
use crate::plan::{Node, NodeInput, Origin, Plan, PlanError, input_hashes};
use crate::process::{Call, StageFailure, Watcher};
use crate::waiting::{by, enter, until_held};

/// How to run.
pub(crate) struct Options {
    /// Stages at once.
    pub(crate) jobs: usize,
    /// Threads of all stages together.
    pub(crate) threads: usize,
    pub(crate) device: String,
    /// Whether to go on with what doesn't need a failed stage.
    pub(crate) keep_going: bool,
}

/// What came of a run.
pub(crate) struct Outcome {
    /// Each node's record, where it is done.
    pub(crate) records: Vec<Option<Record>>,
    /// Nodes that ran.
    pub(crate) ran: BTreeSet<usize>,
    /// Nodes that failed, and how.
    pub(crate) failures: Vec<(usize, StageFailure)>,
    /// Nodes left out because of these.
    pub(crate) skipped: Vec<usize>,
}

enum NodeProgress {
    Pending,
    Running,
    Over,
}

/// What a worker reports: the node, its record and whether it had to run.
type Report = (usize, Result<(Record, bool), StageFailure>);

pub(crate) fn run(plan: &Plan, store: &Store, file: &RunFile, options: &Options, stop: &AtomicBool) -> Outcome {
    let count = plan.nodes.len();
    let mut outcome = Outcome { records: vec![None; count], ran: BTreeSet::new(), failures: Vec::new(), skipped: Vec::new() };
    let mut progress: Vec<NodeProgress> = (0..count).map(|_| NodeProgress::Pending).collect();
    let display = Display::new();
    let (sender, reports) = mpsc::channel::<Report>();
    std::thread::scope(|scope| {
        let mut running = 0;
        loop {
            let give_up = stop.load(Ordering::Relaxed) || (!options.keep_going && !outcome.failures.is_empty());
            let ready: Vec<usize> = (0..count)
                .filter(|&i| {
                    matches!(progress[i], NodeProgress::Pending) && plan.nodes[i].parents().all(|p| outcome.records[p].is_some())
                })
                .collect();
            let places = if give_up { 0 } else { options.jobs.saturating_sub(running) };
            let starting = &ready[..ready.len().min(places)];
            // Stages that run side by side share the cores; one alone has them all.
            let together = (running + starting.len()).clamp(1, options.jobs);
            for &index in starting {
                progress[index] = NodeProgress::Running;
                running += 1;
                let parents: BTreeMap<usize, Record> =
                    plan.nodes[index].parents().filter_map(|p| Some((p, outcome.records[p].clone()?))).collect();
                let (sender, display) = (sender.clone(), &display);
                let threads = (options.threads / together).max(1);
                scope.spawn(move || {
                    let job = NodeJob { node: &plan.nodes[index], store, file, options, threads, display, stop };
                    // The receiver lives as long as the scope. A panic doesn't come here: it ends the program (`panics`).
                    sender.send((index, job.run(&parents))).ok();
                });
            }
            if running == 0 {
                break;
            }
            let Ok((index, result)) = reports.recv() else { break };
            running -= 1;
            progress[index] = NodeProgress::Over;
            match result {
                Ok((record, ran)) => {
                    outcome.records[index] = Some(record);
                    if ran {
                        outcome.ran.insert(index);
                    }
                }
                Err(failure) => {
                    display.line(&format!("{}: failed: {}", plan.nodes[index].label(), failure.message));
                    outcome.failures.push((index, failure));
                }
            }
        }
    });
    outcome.skipped = (0..count).filter(|&i| matches!(progress[i], NodeProgress::Pending)).collect();
    outcome
}

/// A node's inputs: where each lies, and the hash of its content.
struct Inputs {
    folders: Vec<(String, PathBuf)>,
    hashes: Vec<(String, String)>,
}

/// One node's work.
struct NodeJob<'a> {
    node: &'a Node,
    store: &'a Store,
    file: &'a RunFile,
    options: &'a Options,
    threads: usize,
    display: &'a Display,
    stop: &'a AtomicBool,
}

impl NodeJob<'_> {
    /// Finds the record or makes it. `parents` are the records of the nodes that it needs.
    fn run(&self, parents: &BTreeMap<usize, Record>) -> Result<(Record, bool), StageFailure> {
        let output_of = |index: usize| parents[&index].output.clone();
        let hashes = input_hashes(self.node, self.store, output_of).map_err(|e| match e {
            PlanError::Source(message) => StageFailure { code: 3, message },
            other => fail(other),
        })?;
        let key_parts = key::parts(self.node, &hashes, &self.options.device);
        let key = hash_json(&key_parts);
        if let Some(record) = self.find(&key)? {
            return Ok((record, false));
        }
        let lock = until_held(self.stop, &|holder, waited| self.say_waiting(holder, waited), || self.store.try_lock(&key))?;
        let action = Unfinished {
            stage: self.node.stage.clone(),
            point: self.node.point.clone(),
            key_parts,
            made_of: parents.values().map(Record::key).collect(),
            started_unix: unix_time(),
        };
        let attempt = {
            let entered = self.enter()?;
            // Another runner may have made it while this one waited.
            let kind = &self.node.program.description.output.kind;
            if let Some(record) = self.store.hit_or_repair(&entered, &key, kind) {
                return Ok((record, false));
            }
            self.store.begin(&entered, &action, &self.node.parameters).map_err(fail)?
        };
        let folders = self.node.inputs.iter().map(|input| (input.name.clone(), self.folder_of(input, &output_of))).collect();
        self.make(&lock, attempt, action, &Inputs { folders, hashes }).map(|record| (record, true))
    }

    /// The record, if the action was done. Either way it is written down that this run needs it, so that it can't go meanwhile.
    fn find(&self, key: &str) -> Result<Option<Record>, StageFailure> {
        let entered = self.enter()?;
        self.file.needs(&entered, &self.node.stage, key).map_err(fail)?;
        Ok(self.store.hit(key))
    }

    fn enter(&self) -> Result<Entered, StageFailure> {
        enter(self.store, self.stop, &|text| self.display.line(&format!("{}: {text}", self.node.label())))
    }

    fn say_waiting(&self, holder: Option<&Holder>, waited: Duration) {
        let waited = seconds(waited.as_secs_f64());
        self.display.line(&format!("{}: is being made{}; waits for it, for {waited} now", self.node.label(), by(holder)));
    }

    /// Calls the stage and takes in what it made.
    fn make(&self, lock: &KeyLock, attempt: Attempt, action: Unfinished, inputs: &Inputs) -> Result<Record, StageFailure> {
        let label = self.node.label();
        let call = Call {
            label: &label,
            program: &self.node.program,
            params: &attempt.params,
            inputs: &inputs.folders,
            hashes: &inputs.hashes,
            output: &attempt.output,
            work: Some(&attempt.work),
            device: &self.options.device,
            threads: self.threads,
            lock: Some(lock),
        };
        let view = self.display.start(&label);
        let started = Instant::now();
        let result = call.run(&attempt.log, &view, self.stop);
        view.end();
        result?;
        let record = Record {
            stage: action.stage,
            point: action.point,
            key_parts: action.key_parts,
            made_of: action.made_of,
            output: String::new(),
            started_unix: action.started_unix,
            seconds: (started.elapsed().as_secs_f64() * 1e3).round() / 1e3,
            threads: self.threads,
            host: host_name(),
        };
        let checked = self.store.check(attempt, &self.node.program.description.output.kind).map_err(fail)?;
        let record = self.store.publish(&self.enter()?, checked, record).map_err(fail)?;
        self.display.line(&format!("{label}: done in {} → {}", seconds(record.seconds), &record.output[..10]));
        Ok(record)
    }

    fn folder_of(&self, input: &NodeInput, output_of: &dyn Fn(usize) -> String) -> PathBuf {
        match &input.from {
            Origin::Node { index, subtree } => {
                let object = self.store.object(&output_of(*index));
                subtree.as_ref().map_or(object.clone(), |s| object.join(s))
            }
            Origin::Folder(folder) => folder.clone(),
        }
    }
}

/// A failure that is neither the input's nor the numbers'.
fn fail(error: impl std::fmt::Display) -> StageFailure {
    StageFailure { code: 1, message: error.to_string() }
}

/// A time as people say it.
pub(crate) fn seconds(s: f64) -> String {
    if s < 90.0 { format!("{s:.1} s") } else { format!("{:.1} min", s / 60.0) }
}

/// Bars on a terminal, lines elsewhere.
pub(crate) struct Display {
    bars: Option<MultiProgress>,
}

impl Display {
    pub(crate) fn new() -> Self {
        Self { bars: std::io::stderr().is_terminal().then(MultiProgress::new) }
    }

    fn line(&self, text: &str) {
        match &self.bars {
            // The terminal may have gone; the run goes on.
            Some(bars) => bars.println(printable(text)).unwrap_or_default(),
            None => report_text(text),
        }
    }

    pub(crate) fn start(&self, label: &str) -> StageView<'_> {
        let bar = self.bars.as_ref().map(|bars| {
            let style =
                ProgressStyle::with_template("{prefix} [{bar:30}] {percent:>3}% {msg}").expect("the template is constant");
            bars.add(ProgressBar::new(1).with_style(style.progress_chars("=> ")).with_prefix(printable(label).into_owned()))
        });
        if bar.is_none() {
            self.line(&format!("{label}: running"));
        }
        StageView {
            display: self,
            label: label.to_owned(),
            bar,
            shown: Mutex::new(LastShown { when: Instant::now(), label: String::new(), pace: Pace::default() }),
        }
    }
}

/// One running stage on the display.
pub(crate) struct StageView<'a> {
    display: &'a Display,
    label: String,
    bar: Option<ProgressBar>,
    shown: Mutex<LastShown>,
}

/// What was last shown of a stage, and how fast the work that it last told of gets on.
struct LastShown {
    when: Instant,
    label: String,
    pace: Pace,
}

impl StageView<'_> {
    pub(crate) fn end(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Watcher for StageView<'_> {
    fn progress(&self, event: &Event) {
        let Event::Progress { label, done, total, note } = event else { return };
        let mut shown = self.shown.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if shown.label != *label {
            (shown.label, shown.pace) = (label.clone(), Pace::default());
        }
        let left = shown.pace.left(*done, *total);
        if let Some(bar) = &self.bar {
            bar.set_length(*total);
            bar.set_position(*done);
            bar.set_message(format!("{label} {note} · {left} left"));
        } else if shown.when.elapsed() > Duration::from_secs(15) {
            shown.when = Instant::now();
            self.display.line(&format!("{}: {label} {}% {note} · {left} left", self.label, done * 100 / total.max(&1)));
        }
    }

    fn said(&self, line: &str) {
        self.display.line(&format!("{}: {line}", self.label));
    }
}

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use artifact::{Record, Schema, Store, Waiting};
use serde_json::{Map, Value};

use crate::key;
use crate::pipeline::{Pipeline, PipelineError};
use crate::stages::{StageProgram, describe_all};

/// Stages × swept values, in an order in which every node comes after what it needs.
pub struct Plan {
    /// The nodes.
    pub nodes: Vec<Node>,
    /// Sinks that are wanted: name, program, parameters, and the nodes they show (with what those are made of).
    pub(crate) sinks: Vec<Sink>,
}

/// One action to be: a stage at one point of the sweep.
#[derive(Clone, Debug)]
pub struct Node {
    /// Name of the stage's block.
    pub stage: String,
    /// The sweep's values that reach it, e.g. `supersample=2`; empty without a sweep.
    pub point: String,
    /// All parameters, defaults filled in.
    pub parameters: Value,
    pub(crate) inputs: Vec<NodeInput>,
    pub(crate) program: Arc<StageProgram>,
}

/// Where an input comes from.
#[derive(Clone, Debug)]
pub(crate) struct NodeInput {
    pub(crate) name: String,
    pub(crate) from: Origin,
}

#[derive(Clone, Debug)]
pub(crate) enum Origin {
    /// Another node's artifact, or a folder of it.
    Node { index: usize, subtree: Option<String> },
    /// A folder outside the store.
    Folder(PathBuf),
}

/// A stage that shows a run.
pub(crate) struct Sink {
    pub(crate) stage: String,
    pub(crate) program: Arc<StageProgram>,
    pub(crate) parameters: Value,
    pub(crate) shows: Vec<usize>,
}

/// What is asked for on the command line.
#[derive(Clone, Debug, Default)]
pub(crate) struct Request {
    /// Stages to make; empty: the file's default.
    pub(crate) targets: Vec<String>,
    /// `name=value[,value…]`, the name with or without its stage.
    pub(crate) parameters: Vec<String>,
    /// `input=DIR[,DIR…]`, likewise.
    pub(crate) inputs: Vec<String>,
}

/// Why there is no plan.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The file is wrong.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The command line is wrong.
    #[error("{0}")]
    Usage(String),
    /// A source folder is wrong.
    #[error("{0}")]
    Source(String),
}

/// A value that is swept, or just set from the command line.
#[derive(Debug)]
struct Axis {
    stage: String,
    /// What a point calls it.
    label: String,
    what: What,
    values: Vec<String>,
}

#[derive(Debug, PartialEq)]
enum What {
    Parameter(String),
    Input(String),
}

/// The state of a node before a run.
#[derive(Debug, Clone)]
pub(crate) enum State {
    /// Done before, with this record.
    Cached(Box<Record>),
    /// Its inputs are known, its key has no record.
    WillRun { key_parts: Map<String, Value> },
    /// It can't be known before these have run.
    Waits { on: Vec<usize> },
}

impl Node {
    /// Stage and point, as people read it.
    pub fn label(&self) -> String {
        if self.point.is_empty() { self.stage.clone() } else { format!("{} [{}]", self.stage, self.point) }
    }

    /// What a record of it looks like, while its inputs aren't known.
    pub(crate) fn waiting(&self) -> Waiting {
        Waiting {
            program: self.program.description.name.clone(),
            parameters: self.parameters.as_object().cloned().unwrap_or_default(),
        }
    }

    /// The nodes it needs.
    pub(crate) fn parents(&self) -> impl Iterator<Item = usize> + '_ {
        self.inputs.iter().filter_map(|i| match i.from {
            Origin::Node { index, .. } => Some(index),
            Origin::Folder(_) => None,
        })
    }
}

impl Plan {
    /// Checks the whole file, then expands what is asked for.
    pub(crate) fn new(pipeline: &Pipeline, store: &Store, request: &Request) -> Result<Self, PlanError> {
        let programs: BTreeMap<String, Arc<StageProgram>> =
            describe_all(pipeline, store)?.into_iter().map(|(name, program)| (name, Arc::new(program))).collect();
        let order = check(pipeline, &programs)?;
        let targets = if request.targets.is_empty() { &pipeline.default } else { &request.targets };
        for target in targets {
            if !pipeline.stages.contains_key(target) {
                let known = pipeline.stages.keys().cloned().collect::<Vec<_>>().join(", ");
                return Err(PlanError::Usage(format!("no stage {target:?}; known: {known}")));
            }
        }
        let axes =
            axes(pipeline, &programs, request, &needed(targets, |s| pipeline.stages[s].inputs.values().cloned().collect()))?;
        Expansion { pipeline, programs: &programs, axes: &axes, nodes: Vec::new(), of_stage: BTreeMap::new() }
            .expand(&order, targets)
    }

    /// What is known of each node before a run.
    pub(crate) fn states(&self, store: &Store, device: &str) -> Result<Vec<State>, PlanError> {
        let mut states: Vec<State> = Vec::with_capacity(self.nodes.len());
        for node in &self.nodes {
            let on: BTreeSet<usize> = node.parents().filter(|&p| !matches!(states[p], State::Cached(_))).collect();
            if !on.is_empty() {
                states.push(State::Waits { on: on.into_iter().collect() });
                continue;
            }
            let outputs = |index: usize| match &states[index] {
                State::Cached(record) => record.output.clone(),
                _ => unreachable!("a node whose parents aren't cached waits"),
            };
            let hashes = input_hashes(node, store, outputs)?;
            let key_parts = key::parts(node, &hashes, device);
            states.push(match store.hit(&artifact::hash_json(&key_parts)) {
                Some(record) => State::Cached(Box::new(record)),
                None => State::WillRun { key_parts },
            });
        }
        Ok(states)
    }
}

/// Content hashes of a node's inputs, given its parents' outputs.
pub(crate) fn input_hashes(
    node: &Node,
    store: &Store,
    output_of: impl Fn(usize) -> String,
) -> Result<Vec<(String, String)>, PlanError> {
    let hash = |input: &NodeInput| match &input.from {
        Origin::Node { index, subtree: None } => Ok(output_of(*index)),
        Origin::Node { index, subtree: Some(folder) } => {
            let manifest = store.manifest(&output_of(*index)).map_err(|e| PlanError::Source(e.to_string()))?;
            Ok(manifest.subtree(folder).identity())
        }
        Origin::Folder(folder) => crate::sources::hash_source(store, folder)
            .map_err(|e| PlanError::Source(format!("stage {}: input {}: {e}", node.stage, input.name))),
    };
    node.inputs.iter().map(|input| Ok((input.name.clone(), hash(input)?))).collect()
}

/// Whether an input's text names a folder rather than a stage.
fn as_path(text: &str) -> Option<&Path> {
    text.starts_with(['/', '.', '~']).then(|| Path::new(text))
}

/// Checks every block against its stage's description and every input against what it names; returns an order that works.
fn check(pipeline: &Pipeline, programs: &BTreeMap<String, Arc<StageProgram>>) -> Result<Vec<String>, PipelineError> {
    for name in &pipeline.default {
        if !pipeline.stages.contains_key(name) {
            return Err(pipeline.error(name, None, "named in `default`, but there is no such stage"));
        }
    }
    for (name, block) in &pipeline.stages {
        let description = &programs[name].description;
        let schema = Schema::new(&description.parameters)
            .map_err(|e| pipeline.error(name, None, format!("its parameter schema is {e}")))?;
        if let Err(problems) = schema.resolve(&block.parameters) {
            return Err(pipeline.error(name, Some(&problems[0].name), problems[0].to_string()));
        }
        for (input, source) in &block.inputs {
            // A sink gets one record of all that it is shown; what its inputs are called is the file's own affair.
            let record = || description.inputs.get("run").filter(|_| description.sink);
            let Some(port) = description.inputs.get(input).or_else(record) else {
                let known = description.inputs.keys().cloned().collect::<Vec<_>>().join(", ");
                return Err(pipeline.error(name, Some(input), format!("it has no input {input:?}; known: {known}")));
            };
            if as_path(source).is_some() {
                continue;
            }
            let (other, subtree) = split(source);
            let Some(program) = programs.get(other) else {
                return Err(pipeline.error(
                    name,
                    Some(input),
                    format!("input {input}: no stage {other:?}; a folder begins with ./ or /"),
                ));
            };
            if description.sink {
                continue;
            }
            let output = &program.description.output;
            let kind = match subtree {
                None => Some(&output.kind),
                Some(folder) => output.subtrees.get(folder),
            };
            let Some(kind) = kind else {
                let known = output.subtrees.keys().cloned().collect::<Vec<_>>().join(", ");
                return Err(pipeline.error(
                    name,
                    Some(input),
                    format!("input {input}: {other} has no folder {:?}; known: {known}", subtree.unwrap_or_default()),
                ));
            };
            if !port.kinds.contains(kind) {
                return Err(pipeline.error(
                    name,
                    Some(input),
                    format!("input {input} takes {}, but {source} is {kind}", port.kinds.join(" or ")),
                ));
            }
        }
        for (input, port) in &description.inputs {
            if !port.optional && !block.inputs.contains_key(input) {
                return Err(pipeline.error(name, None, format!("input {input} is missing ({})", port.summary)));
            }
        }
    }
    order(pipeline)
}

fn split(source: &str) -> (&str, Option<&str>) {
    source.split_once('/').map_or((source, None), |(stage, folder)| (stage, Some(folder)))
}

/// The stages that a block names as inputs.
fn needs(pipeline: &Pipeline, stage: &str) -> impl Iterator<Item = String> {
    let sources: Vec<String> = pipeline.stages[stage].inputs.values().filter(|s| as_path(s).is_none()).cloned().collect();
    sources.into_iter().map(|s| split(&s).0.to_owned())
}

/// The stages that targets come to, themselves included; `sources` are the inputs' texts of a stage.
fn needed(targets: &[String], sources: impl Fn(&str) -> Vec<String>) -> BTreeSet<String> {
    let mut needed: BTreeSet<String> = BTreeSet::new();
    let mut open: Vec<String> = targets.to_vec();
    while let Some(stage) = open.pop() {
        if needed.insert(stage.clone()) {
            let stages = sources(&stage).into_iter().filter(|s| as_path(s).is_none());
            open.extend(stages.map(|s| split(&s).0.to_owned()));
        }
    }
    needed
}

/// Kahn's order, by name where there is a choice; what is left over is a cycle.
fn order(pipeline: &Pipeline) -> Result<Vec<String>, PipelineError> {
    let mut left: BTreeSet<&String> = pipeline.stages.keys().collect();
    let mut order: Vec<String> = Vec::new();
    while !left.is_empty() {
        let ready = left.iter().find(|s| needs(pipeline, s).all(|n| order.contains(&n))).copied();
        let Some(ready) = ready else {
            // Walk from need to need inside what is left until a stage comes again.
            let mut path = vec![(*left.first().expect("something is left")).clone()];
            loop {
                let last = path.last().expect("the path has a start");
                let next = needs(pipeline, last).find(|n| left.contains(n)).expect("what is left needs something that is left");
                if let Some(at) = path.iter().position(|s| *s == next) {
                    let cycle = [&path[at..], &[next]].concat().join(" ← ");
                    return Err(pipeline.error(&path[at], None, format!("its inputs lead back to it: {cycle}")));
                }
                path.push(next);
            }
        };
        left.remove(ready);
        order.push(ready.clone());
    }
    Ok(order)
}

/// What the command line sets, each with its stage. Where several stages have a name, that one is meant that the targets need; a block
/// that is like another follows that one.
fn axes(
    pipeline: &Pipeline,
    programs: &BTreeMap<String, Arc<StageProgram>>,
    request: &Request,
    needed: &BTreeSet<String>,
) -> Result<Vec<Axis>, PlanError> {
    let mut axes: Vec<Axis> = Vec::new();
    let parameters = request.parameters.iter().map(|text| ("-p", text, true));
    let inputs = request.inputs.iter().map(|text| ("-i", text, false));
    for (flag, text, is_parameter) in parameters.chain(inputs) {
        let (name, values) =
            text.split_once('=').ok_or_else(|| PlanError::Usage(format!("{flag} {text}: expected NAME=VALUE[,VALUE…]")))?;
        let has = |stage: &str, name: &str| {
            let description = &programs[stage].description;
            if is_parameter {
                Schema::new(&description.parameters).is_ok_and(|s| s.names().contains(&name))
            } else {
                description.inputs.contains_key(name)
            }
        };
        let (stages, own): (Vec<&String>, &str) = match name.split_once('.') {
            Some((stage, own)) => (pipeline.stages.keys().filter(|s| *s == stage && has(s, own)).collect(), own),
            None => {
                let follows = |s: &str| {
                    let block = &pipeline.stages[s];
                    block.like.as_ref().is_some_and(|other| needed.contains(other) || !block.gives(is_parameter, name))
                };
                (pipeline.stages.keys().filter(|s| has(s, name) && !follows(s)).collect(), name)
            }
        };
        let stages = match stages.iter().filter(|s| needed.contains(**s)).copied().collect::<Vec<_>>() {
            meant if meant.is_empty() => stages,
            meant => meant,
        };
        let stage = match stages[..] {
            [stage] => stage.clone(),
            [] => {
                let what = if is_parameter { "parameter" } else { "input" };
                return Err(PlanError::Usage(format!(
                    "{flag} {name}: no stage has such {} {what}; see `STAGE --help`",
                    if is_parameter { "a" } else { "an" }
                )));
            }
            _ => {
                let options = stages.iter().map(|s| format!("{s}.{own}")).collect::<Vec<_>>().join(", ");
                return Err(PlanError::Usage(format!("{flag} {name}: more than one stage has it; say which: {options}")));
            }
        };
        let what = if is_parameter { What::Parameter(own.to_owned()) } else { What::Input(own.to_owned()) };
        if axes.iter().any(|a| a.stage == stage && a.what == what) {
            return Err(PlanError::Usage(format!("{flag} {name}: given twice; list several values with commas")));
        }
        let values = values.split(',').map(str::to_owned).collect();
        axes.push(Axis { stage, label: own.to_owned(), what, values });
    }
    Ok(axes)
}

/// The value (by number) of every axis that reaches a node.
type Point = BTreeMap<usize, usize>;

/// The expansion of stages to nodes.
struct Expansion<'a> {
    pipeline: &'a Pipeline,
    programs: &'a BTreeMap<String, Arc<StageProgram>>,
    axes: &'a [Axis],
    nodes: Vec<Node>,
    /// The nodes of each stage, with the value (by number) of every axis that reaches them.
    of_stage: BTreeMap<String, Vec<(Point, usize)>>,
}

impl Expansion<'_> {
    fn expand(mut self, order: &[String], targets: &[String]) -> Result<Plan, PlanError> {
        // Only what the targets need; an input replaced from the command line needs nothing.
        let wanted = needed(targets, |stage| self.block_inputs(stage).into_iter().map(|(_, source)| source).collect());
        let mut sinks = Vec::new();
        for stage in order.iter().filter(|s| wanted.contains(*s)) {
            let program = Arc::clone(&self.programs[stage]);
            if program.description.sink {
                let shows = needs(self.pipeline, stage)
                    .flat_map(|s| self.of_stage[&s].iter().map(|(_, node)| *node).collect::<Vec<_>>())
                    .collect();
                let parameters = self.resolve(stage, &BTreeMap::new())?;
                sinks.push(Sink { stage: stage.clone(), program, parameters, shows });
            } else {
                self.add_stage(stage, &program)?;
            }
        }
        Ok(Plan { nodes: self.nodes, sinks })
    }

    /// A block's inputs less those that the command line replaces.
    fn block_inputs(&self, stage: &str) -> Vec<(String, String)> {
        let replaced = |input: &str| self.axes.iter().any(|a| a.stage == stage && a.what == What::Input(input.to_owned()));
        self.pipeline.stages[stage].inputs.iter().filter(|(i, _)| !replaced(i)).map(|(i, s)| (i.clone(), s.clone())).collect()
    }

    /// Whether a value from the command line reaches a stage itself: given for it, or for the one it is like where it doesn't say otherwise.
    fn sets(&self, axis: &Axis, stage: &str) -> bool {
        let block = &self.pipeline.stages[stage];
        let (is_parameter, name) = match &axis.what {
            What::Parameter(name) => (true, name),
            What::Input(name) => (false, name),
        };
        axis.stage == stage || (block.like.as_deref() == Some(&axis.stage) && !block.gives(is_parameter, name))
    }

    fn add_stage(&mut self, stage: &str, program: &Arc<StageProgram>) -> Result<(), PlanError> {
        let inputs = self.block_inputs(stage);
        // The axes that reach the stage: its own and its parents'.
        let mut reach: BTreeSet<usize> = (0..self.axes.len()).filter(|&a| self.sets(&self.axes[a], stage)).collect();
        for (_, source) in inputs.iter().filter(|(_, s)| as_path(s).is_none()) {
            reach.extend(self.of_stage[split(source).0].iter().flat_map(|(values, _)| values.keys().copied()));
        }
        let mut points: Vec<Point> = vec![BTreeMap::new()];
        for axis in reach {
            let values = 0..self.axes[axis].values.len();
            points = points
                .into_iter()
                .flat_map(|point| {
                    values.clone().map(move |v| {
                        let mut p = point.clone();
                        p.insert(axis, v);
                        p
                    })
                })
                .collect();
        }
        for point in points {
            let mut sources: Vec<NodeInput> = Vec::new();
            for (name, source) in &inputs {
                let from = match as_path(source) {
                    Some(path) => Origin::Folder(self.pipeline.folder().join(path)),
                    None => {
                        let (other, subtree) = split(source);
                        let fits = |values: &Point| values.iter().all(|(axis, v)| point.get(axis) == Some(v));
                        let (_, index) = self.of_stage[other]
                            .iter()
                            .find(|(values, _)| fits(values))
                            .expect("a parent's axes reach its children");
                        Origin::Node { index: *index, subtree: subtree.map(str::to_owned) }
                    }
                };
                sources.push(NodeInput { name: name.clone(), from });
            }
            for (axis, value) in &point {
                if let (true, What::Input(name)) = (self.sets(&self.axes[*axis], stage), &self.axes[*axis].what) {
                    sources.push(NodeInput {
                        name: name.clone(),
                        from: Origin::Folder(PathBuf::from(&self.axes[*axis].values[*value])),
                    });
                }
            }
            sources.sort_by(|a, b| a.name.cmp(&b.name));
            let swept = point.iter().filter(|(axis, _)| self.axes[**axis].values.len() > 1);
            let label = swept
                .map(|(a, v)| format!("{}={}", self.axes[*a].label, self.axes[*a].values[*v]))
                .collect::<Vec<_>>()
                .join(", ");
            let parameters = self.resolve(stage, &point)?;
            self.nodes.push(Node {
                stage: stage.to_owned(),
                point: label,
                parameters,
                inputs: sources,
                program: Arc::clone(program),
            });
            self.of_stage.entry(stage.to_owned()).or_default().push((point, self.nodes.len() - 1));
        }
        Ok(())
    }

    /// A stage's parameters at a point: the command line's over the file's, those over what it is like, and that over the defaults.
    fn resolve(&self, stage: &str, point: &Point) -> Result<Value, PlanError> {
        let mut given = Map::new();
        for layer in self.pipeline.layers(stage) {
            given.extend(self.pipeline.stages[layer].parameters.clone());
            for (axis, value) in self.axes.iter().enumerate().filter(|(_, a)| a.stage == layer && self.sets(a, stage)) {
                if let What::Parameter(name) = &value.what {
                    let text = &value.values[point.get(&axis).copied().unwrap_or(0)];
                    // As in the file: 2 is a number, box a word.
                    let parsed = serde_yaml::from_str(text).map_err(|e| PlanError::Usage(format!("-p {name}={text}: {e}")))?;
                    given.insert(name.clone(), parsed);
                }
            }
        }
        let schema = Schema::new(&self.programs[stage].description.parameters).map_err(PlanError::Usage)?;
        schema.resolve(&given).map_err(|problems| PlanError::Usage(format!("stage {stage}: {}", problems[0])))
    }
}

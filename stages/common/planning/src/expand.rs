//! From stages and values to nodes: every stage once for each combination of the values that reach
//! it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use artifact::FailedPoint;
use contract::GivenInputs;
use serde_json::{Map, Value};

use crate::axes::{Axis, Kind, Setting};
use crate::check::closure;
use crate::experiment::Selection;
use crate::left_out::{Files, check_shown, shown};
use crate::node::{Node, NodeInput, Origin, Plan, Sink};
use crate::part::{Part, Source};
use crate::pipeline::Pipeline;
use crate::request::PlanError;
use crate::stages::{Programs, StageProgram};

/// More nodes than anybody means.
const MOST_NODES: usize = 10_000;

/// The value (by number) of every axis that reaches a node.
type Point = BTreeMap<usize, usize>;

/// The expansion of stages to nodes.
pub(crate) struct Expansion<'a> {
    pipeline: &'a Pipeline,
    programs: &'a Programs,
    axes: &'a [Axis],
    choice: &'a Selection,
    files: Files,
    nodes: Vec<Node>,
    /// The nodes of each stage, with the value (by number) of every axis that reaches them.
    of_stage: BTreeMap<String, Vec<(Point, usize)>>,
    /// The node of each result, by its stage, parameters and inputs.
    of_result: BTreeMap<String, usize>,
    /// The points of each stage that aren't made, with the reason.
    left_out: BTreeMap<String, Vec<(Point, String)>>,
    notes: Vec<String>,
}

impl<'a> Expansion<'a> {
    pub(crate) fn new(
        pipeline: &'a Pipeline,
        programs: &'a Programs,
        axes: &'a [Axis],
        choice: &'a Selection,
    ) -> Result<Self, PlanError> {
        let files = Files::new(pipeline, choice)?;
        let (nodes, notes) = (Vec::new(), Vec::new());
        let (of_stage, of_result, left_out) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        Ok(Self {
            pipeline,
            programs,
            axes,
            choice,
            files,
            nodes,
            of_stage,
            of_result,
            left_out,
            notes,
        })
    }

    /// Makes the nodes of what the targets need, in an order in which each comes after those that
    /// it needs.
    pub(crate) fn expand(
        mut self,
        order: &[String],
        targets: &[String],
    ) -> Result<Plan, PlanError> {
        let wanted = closure(targets, |stage| self.sources(stage));
        let of_targets: Vec<&str> =
            wanted.iter().map(String::as_str).filter(|stage| self.is_sink(stage)).collect();
        check_shown(self.pipeline, &of_targets, self.choice)?;
        let mut sinks = Vec::new();
        for stage in order.iter().filter(|s| wanted.contains(*s)) {
            let program = Arc::clone(self.programs.require(stage)?);
            match program.description.sink {
                true => sinks.push(self.sink(stage, program)?),
                false => self.add_stage(stage, &program)?,
            }
        }
        Ok(Plan { nodes: self.nodes, sinks, notes: self.notes, ..Plan::default() })
    }

    fn is_sink(&self, stage: &str) -> bool {
        self.programs.get(stage).is_some_and(|program| program.description.sink)
    }

    /// The stages that one needs, or that it shows where it is a sink.
    fn sources(&self, stage: &str) -> Vec<String> {
        match self.is_sink(stage) {
            true => {
                shown(self.pipeline, stage, self.choice).into_iter().map(str::to_owned).collect()
            }
            // An input replaced from the command line needs nothing.
            false => self
                .block_inputs(stage)
                .filter_map(|(_, source)| source.stage())
                .map(str::to_owned)
                .collect(),
        }
    }

    /// A sink, with all points of what it shows.
    fn sink(&self, stage: &str, program: Arc<StageProgram>) -> Result<Sink, PlanError> {
        let parameters = self.resolve(stage, &program, &Point::new())?;
        let (mut shows, mut left_out) = (BTreeSet::new(), Vec::new());
        for of in shown(self.pipeline, stage, self.choice) {
            shows.extend(self.of_stage.get(of).into_iter().flatten().map(|(_, node)| *node));
            left_out.extend(self.left_out.get(of).into_iter().flatten().map(|(point, reason)| {
                FailedPoint {
                    stage: of.to_owned(),
                    point: self.label(point),
                    values: self.values(point),
                    reason: Some(reason.clone()),
                }
            }));
        }
        Ok(Sink {
            stage: stage.to_owned(),
            program,
            parameters,
            shows: shows.into_iter().collect(),
            left_out,
        })
    }

    /// A block's inputs less those that the command line or an experiment replaces at every point.
    fn block_inputs(&self, stage: &str) -> impl Iterator<Item = (&'a str, Source<'a>)> {
        let inputs = self.pipeline.stages[stage]
            .inputs
            .iter()
            .map(|(name, source)| (name.as_str(), Source::of(source)));
        let replaced: Vec<bool> = inputs
            .clone()
            .map(|(name, _)| self.axes.iter().any(|axis| replaces(axis, stage, name)))
            .collect();
        inputs.zip(replaced).filter(|(_, is_replaced)| !is_replaced).map(|(input, _)| input)
    }

    /// Whether a setting reaches a stage itself: given for it, or for the one it extends where it
    /// doesn't say otherwise.
    fn sets(&self, set: &Setting, stage: &str) -> bool {
        let block = &self.pipeline.stages[stage];
        let is_own = || set.kind.is_given(self.programs.get(stage), block, &set.name);
        set.stage == stage || (block.extends.as_deref() == Some(&set.stage) && !is_own())
    }

    /// The settings of a point that reach a stage, in the order of the axes.
    fn settings<'b>(
        &'b self,
        stage: &'b str,
        point: &'b Point,
    ) -> impl Iterator<Item = &'b Setting> {
        let settings = self.axes.iter().enumerate().flat_map(move |(index, axis)| {
            // A stage that an axis doesn't reach has no value of it; a sink has the only one.
            &axis.values[point.get(&index).copied().unwrap_or(0)].settings
        });
        settings.filter(move |set| self.sets(set, stage))
    }

    fn add_stage(&mut self, stage: &str, program: &Arc<StageProgram>) -> Result<(), PlanError> {
        for point in self.points(stage)? {
            let parameters = self.resolve(stage, program, &point)?;
            if let Some(reason) = self.missing(stage, &point, &parameters) {
                self.left_out.entry(stage.to_owned()).or_default().push((point, reason));
                continue;
            }
            let inputs = self.node_inputs(stage, &point);
            // Points that come to one result have one node.
            let result = format!("{stage} {parameters} {inputs:?}");
            if let Some(&node) = self.of_result.get(&result) {
                self.of_stage.entry(stage.to_owned()).or_default().push((point, node));
                continue;
            }
            let node = Node {
                stage: stage.to_owned(),
                point: self.label(&point),
                values: self.values(&point),
                parameters,
                inputs,
                program: Arc::clone(program),
            };
            let given: GivenInputs =
                node.inputs.iter().map(|input| (input.name.clone(), self.made_by(input))).collect();
            if let Some(problem) = program.description.broken_rule(&node.parameters, &given) {
                return Err(PlanError::Usage(format!("stage {}: {problem}", node.label())));
            }
            self.of_result.insert(result, self.nodes.len());
            self.of_stage.entry(stage.to_owned()).or_default().push((point, self.nodes.len()));
            self.nodes.push(node);
        }
        Ok(())
    }

    /// Why a stage isn't made at a point: its own file isn't there, or a parent isn't made.
    fn missing(&mut self, stage: &str, point: &Point, parameters: &Value) -> Option<String> {
        if let Some(reason) = self.files.missing(stage, parameters) {
            let note = format!("{stage}: left out: {reason} in {}", self.files.data.display());
            if !self.notes.contains(&note) {
                self.notes.push(note);
            }
            return Some(reason);
        }
        let parents = self.block_inputs(stage).filter_map(|(_, source)| source.stage());
        let left_out = parents.flat_map(|parent| self.left_out.get(parent).into_iter().flatten());
        left_out
            .filter(|(values, _)| is_inside(values, point))
            .map(|(_, reason)| reason.clone())
            .next()
    }

    /// All combinations of the values that reach a stage: those of its own axes and of its
    /// parents'.
    fn points(&self, stage: &str) -> Result<Vec<Point>, PlanError> {
        let is_set = |axis: &&usize| self.axes[**axis].settings().any(|set| self.sets(set, stage));
        let all: Vec<usize> = (0..self.axes.len()).collect();
        let mut reach: BTreeSet<usize> = all.iter().filter(is_set).copied().collect();
        for parent in self.block_inputs(stage).filter_map(|(_, source)| source.stage()) {
            let made = self.of_stage.get(parent).into_iter().flatten().map(|(values, _)| values);
            let left_out =
                self.left_out.get(parent).into_iter().flatten().map(|(values, _)| values);
            reach.extend(made.chain(left_out).flat_map(|values| values.keys().copied()));
        }
        let mut points: Vec<Point> = vec![Point::new()];
        for axis in reach {
            let values = self.axes[axis].values.len();
            if points.len() * values + self.nodes.len() > MOST_NODES {
                let problem = format!(
                    "the sweep comes to more than {MOST_NODES} points of {stage}; sweep fewer \
                    values at once"
                );
                return Err(PlanError::Usage(problem));
            }
            points = points
                .iter()
                .flat_map(|point| (0..values).map(move |value| with(point, axis, value)))
                .collect();
        }
        Ok(points)
    }

    /// Where a node's inputs come from, by name.
    fn node_inputs(&self, stage: &str, point: &Point) -> Vec<NodeInput> {
        let of_block = self.block_inputs(stage).map(|(name, source)| {
            let from = match source {
                Source::Folder(path) => {
                    Origin::Folder(self.pipeline.resolve(stage, Part::Input(name), path))
                }
                Source::Stage { name, subtree } => Origin::Node {
                    index: self.parent(name, point),
                    subtree: subtree.map(str::to_owned),
                },
            };
            (name.to_owned(), from)
        });
        let mut inputs: BTreeMap<String, Origin> = of_block.collect();
        let folders = self.settings(stage, point).filter(|set| set.kind == Kind::Input);
        inputs.extend(folders.map(|set| (set.name.clone(), Origin::Folder(set.folder()))));
        inputs.into_iter().map(|(name, from)| NodeInput { name, from }).collect()
    }

    /// A parent's node at a point of its child.
    fn parent(&self, stage: &str, point: &Point) -> usize {
        let found = self.of_stage[stage].iter().find(|(values, _)| is_inside(values, point));
        found.expect("a parent's axes reach its children").1
    }

    /// The parameters of the stage that an input comes from.
    fn made_by(&self, input: &NodeInput) -> Option<Value> {
        match input.from {
            Origin::Node { index, .. } => Some(self.nodes[index].parameters.clone()),
            Origin::Folder(_) => None,
        }
    }

    /// What a point is called: the values of what is swept.
    fn label(&self, point: &Point) -> String {
        let swept = self.named(point).filter(|(axis, _)| axis.values.len() > 1);
        swept.map(|(axis, text)| format!("{}={text}", axis.name)).collect::<Vec<_>>().join(", ")
    }

    /// The values of what has a name, for tables; the only value of an axis is every node's.
    fn values(&self, point: &Point) -> BTreeMap<String, String> {
        let only = self.axes.iter().filter(|axis| axis.is_named && axis.values.len() == 1);
        let only = only.map(|axis| (axis, axis.values[0].text.as_str()));
        self.named(point)
            .chain(only)
            .map(|(axis, text)| (axis.name.clone(), text.to_owned()))
            .collect()
    }

    fn named<'b>(&'b self, point: &'b Point) -> impl Iterator<Item = (&'b Axis, &'b str)> {
        let values = point
            .iter()
            .map(|(axis, value)| (&self.axes[*axis], *value))
            .filter(|(axis, _)| axis.is_named);
        values.map(|(axis, value)| (axis, axis.values[value].text.as_str()))
    }

    /// A stage's parameters at a point: the command line's over the file's, those over what it
    /// extends, and that over the defaults.
    fn resolve(
        &self,
        stage: &str,
        program: &StageProgram,
        point: &Point,
    ) -> Result<Value, PlanError> {
        let mut given = Map::new();
        for layer in self.pipeline.layers(stage) {
            program.lay_over(&mut given, &self.pipeline.stages[layer]);
            let set = self
                .settings(stage, point)
                .filter(|set| set.kind == Kind::Parameter && set.stage == layer);
            let from_line: Map<String, Value> =
                set.map(|set| (set.name.clone(), set.value.clone())).collect();
            program.schema.lay_over(&mut given, &from_line);
        }
        program
            .schema
            .resolve(&given)
            .map_err(|problems| PlanError::Usage(format!("stage {stage}: {}", problems[0])))
    }
}

/// Whether each value of an axis sets an input of a stage.
fn replaces(axis: &Axis, stage: &str, input: &str) -> bool {
    axis.values.iter().all(|value| {
        let mut settings = value.settings.iter();
        settings.any(|set| set.stage == stage && set.kind == Kind::Input && set.name == input)
    })
}

/// A point with a further value.
fn with(point: &Point, axis: usize, value: usize) -> Point {
    point.iter().map(|(a, v)| (*a, *v)).chain([(axis, value)]).collect()
}

/// Whether a point has all values of another one.
fn is_inside(values: &Point, point: &Point) -> bool {
    values.iter().all(|(axis, value)| point.get(axis) == Some(value))
}

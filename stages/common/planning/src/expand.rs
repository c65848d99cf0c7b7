//! From stages and values to nodes: every stage once for each combination of the values that reach it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use artifact::GivenInputs;
use serde_json::{Map, Value};

use crate::axes::{Axis, Kind, Setting};
use crate::check::{closure, needs};
use crate::pipeline::{Part, Pipeline, Source};
use crate::plan::{Node, NodeInput, Origin, Plan, PlanError, Sink};
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
    nodes: Vec<Node>,
    /// The nodes of each stage, with the value (by number) of every axis that reaches them.
    of_stage: BTreeMap<String, Vec<(Point, usize)>>,
}

impl<'a> Expansion<'a> {
    pub(crate) fn new(pipeline: &'a Pipeline, programs: &'a Programs, axes: &'a [Axis]) -> Self {
        Self { pipeline, programs, axes, nodes: Vec::new(), of_stage: BTreeMap::new() }
    }

    /// Makes the nodes of what the targets need, in an order in which each comes after those that it needs.
    pub(crate) fn expand(mut self, order: &[String], targets: &[String]) -> Result<Plan, PlanError> {
        // An input replaced from the command line needs nothing.
        let sources =
            |stage: &str| self.block_inputs(stage).filter_map(|(_, source)| source.stage()).map(str::to_owned).collect();
        let wanted = closure(targets, sources);
        let mut sinks = Vec::new();
        for stage in order.iter().filter(|s| wanted.contains(*s)) {
            let program = Arc::clone(self.programs.require(stage)?);
            if program.description.sink {
                let nodes = needs(self.pipeline, stage).flat_map(|shown| self.of_stage.get(shown).into_iter().flatten());
                let shows: BTreeSet<usize> = nodes.map(|(_, node)| *node).collect();
                let parameters = self.resolve(stage, &program, &Point::new())?;
                sinks.push(Sink { stage: stage.clone(), program, parameters, shows: shows.into_iter().collect() });
            } else {
                self.add_stage(stage, &program)?;
            }
        }
        Ok(Plan { nodes: self.nodes, sinks, ..Plan::default() })
    }

    /// A block's inputs less those that the command line or an experiment replaces at every point.
    fn block_inputs(&self, stage: &str) -> impl Iterator<Item = (&'a str, Source<'a>)> {
        let inputs = self.pipeline.stages[stage].inputs.iter().map(|(name, source)| (name.as_str(), Source::of(source)));
        let is_set = |axis: &Axis, name: &str| {
            let sets = |set: &Setting| set.stage == stage && set.kind == Kind::Input && set.name == name;
            axis.values.iter().all(|value| value.settings.iter().any(sets))
        };
        let replaced: Vec<bool> = inputs.clone().map(|(name, _)| self.axes.iter().any(|axis| is_set(axis, name))).collect();
        inputs.zip(replaced).filter(|(_, is_replaced)| !is_replaced).map(|(input, _)| input)
    }

    /// Whether a setting reaches a stage itself: given for it, or for the one it extends where it doesn't say otherwise.
    fn sets(&self, set: &Setting, stage: &str) -> bool {
        let block = &self.pipeline.stages[stage];
        let is_own = || set.kind.is_given(self.programs.get(stage), block, &set.name);
        set.stage == stage || (block.extends.as_deref() == Some(&set.stage) && !is_own())
    }

    /// The settings of a point that reach a stage, in the order of the axes.
    fn settings<'b>(&'b self, stage: &'b str, point: &'b Point) -> impl Iterator<Item = &'b Setting> {
        let of_axis = move |(index, axis): (usize, &'b Axis)| {
            // A stage that an axis doesn't reach has no value of it; a sink has the only one.
            &axis.values[point.get(&index).copied().unwrap_or(0)].settings
        };
        self.axes.iter().enumerate().flat_map(of_axis).filter(move |set| self.sets(set, stage))
    }

    fn add_stage(&mut self, stage: &str, program: &Arc<StageProgram>) -> Result<(), PlanError> {
        for point in self.points(stage)? {
            let inputs = self.node_inputs(stage, &point);
            let parameters = self.resolve(stage, program, &point)?;
            // Points that come to one result have one node.
            let is_it = |node: &&usize| self.nodes[**node].parameters == parameters && self.nodes[**node].inputs == inputs;
            if let Some(node) = self.of_stage.get(stage).into_iter().flatten().map(|(_, node)| node).find(is_it).copied() {
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
            let given: GivenInputs = node.inputs.iter().map(|input| (input.name.clone(), self.made_by(input))).collect();
            if let Some(problem) = program.description.broken_rule(&node.parameters, &given) {
                return Err(PlanError::Usage(format!("stage {}: {problem}", node.label())));
            }
            self.nodes.push(node);
            self.of_stage.entry(stage.to_owned()).or_default().push((point, self.nodes.len() - 1));
        }
        Ok(())
    }

    /// All combinations of the values that reach a stage: those of its own axes and of its parents'.
    fn points(&self, stage: &str) -> Result<Vec<Point>, PlanError> {
        let is_set = |axis: &&usize| self.axes[**axis].settings().any(|set| self.sets(set, stage));
        let all: Vec<usize> = (0..self.axes.len()).collect();
        let mut reach: BTreeSet<usize> = all.iter().filter(is_set).copied().collect();
        for parent in self.block_inputs(stage).filter_map(|(_, source)| source.stage()) {
            reach.extend(self.of_stage[parent].iter().flat_map(|(values, _)| values.keys().copied()));
        }
        let mut points: Vec<Point> = vec![Point::new()];
        for axis in reach {
            let values = self.axes[axis].values.len();
            if points.len() * values + self.nodes.len() > MOST_NODES {
                let problem = format!("the sweep comes to more than {MOST_NODES} points of {stage}; sweep fewer values at once");
                return Err(PlanError::Usage(problem));
            }
            let with = |point: &Point, value| point.iter().map(|(a, v)| (*a, *v)).chain([(axis, value)]).collect();
            points = points.iter().flat_map(|point| (0..values).map(move |value| with(point, value))).collect();
        }
        Ok(points)
    }

    /// Where a node's inputs come from, by name.
    fn node_inputs(&self, stage: &str, point: &Point) -> Vec<NodeInput> {
        let of_block = self.block_inputs(stage).map(|(name, source)| {
            let from = match source {
                Source::Folder(path) => Origin::Folder(self.pipeline.resolve(stage, Part::Input(name), path)),
                Source::Stage { name, subtree } => {
                    Origin::Node { index: self.parent(name, point), subtree: subtree.map(str::to_owned) }
                }
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
        let fits = |values: &Point| values.iter().all(|(axis, v)| point.get(axis) == Some(v));
        let found = self.of_stage[stage].iter().find(|(values, _)| fits(values));
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

    /// The values of what has a name, for tables.
    fn values(&self, point: &Point) -> BTreeMap<String, String> {
        self.named(point).map(|(axis, text)| (axis.name.clone(), text.to_owned())).collect()
    }

    fn named<'b>(&'b self, point: &'b Point) -> impl Iterator<Item = (&'b Axis, &'b str)> {
        let values = point.iter().map(|(axis, value)| (&self.axes[*axis], *value)).filter(|(axis, _)| axis.is_named);
        values.map(|(axis, value)| (axis, axis.values[value].text.as_str()))
    }

    /// A stage's parameters at a point: the command line's over the file's, those over what it extends, and that over the defaults.
    fn resolve(&self, stage: &str, program: &StageProgram, point: &Point) -> Result<Value, PlanError> {
        let mut given = Map::new();
        for layer in self.pipeline.layers(stage) {
            program.lay_over(&mut given, &self.pipeline.stages[layer]);
            let set = self.settings(stage, point).filter(|set| set.kind == Kind::Parameter && set.stage == layer);
            let from_line: Map<String, Value> = set.map(|set| (set.name.clone(), set.value.clone())).collect();
            program.schema.lay_over(&mut given, &from_line);
        }
        program.schema.resolve(&given).map_err(|problems| PlanError::Usage(format!("stage {stage}: {}", problems[0])))
    }
}

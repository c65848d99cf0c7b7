//! Expansion of stages and axes to nodes: each stage has one node for each combination of the
//! values that reach it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use artifact::FailedPoint;
use serde_json::{Map, Value};
use stage::GivenInputs;

use crate::axes::{Axis, Kind, Setting};
use crate::check::dependencies;
use crate::experiment::Selection;
use crate::file::{InputSource, Part};
use crate::left_out::{RequiredFiles, check_show, shown_stages};
use crate::node::{Node, NodeInput, Origin, Plan, ShownPoint, Sink};
use crate::pipeline::Pipeline;
use crate::quality::Quality;
use crate::request::PlanError;
use crate::stages::{Programs, StageProgram};

/// Maximum number of nodes in a plan, chosen by hand.
const MAX_NODES: usize = 10_000;

/// Index of a value by index of the axis, for each axis that reaches a node.
type Point = BTreeMap<usize, usize>;

/// State of the expansion.
pub(crate) struct Expansion<'a> {
    pipeline: &'a Pipeline,
    programs: &'a Programs,
    axes: &'a [Axis],
    selection: &'a Selection,
    required_files: RequiredFiles,
    nodes: Vec<Node>,
    /// Points of each stage, with the indices of their nodes.
    nodes_by_stage: BTreeMap<String, Vec<(Point, usize)>>,
    /// Index of a node by its stage, parameters and inputs.
    node_by_content: BTreeMap<String, usize>,
    /// Points of each stage that are left out, with the reason.
    left_out: BTreeMap<String, Vec<(Point, String)>>,
    notes: Vec<String>,
}

impl<'a> Expansion<'a> {
    pub(crate) fn new(
        pipeline: &'a Pipeline,
        programs: &'a Programs,
        axes: &'a [Axis],
        selection: &'a Selection,
    ) -> Result<Self, PlanError> {
        Ok(Self {
            pipeline,
            programs,
            axes,
            selection,
            required_files: RequiredFiles::new(pipeline, selection)?,
            nodes: Vec::new(),
            nodes_by_stage: BTreeMap::new(),
            node_by_content: BTreeMap::new(),
            left_out: BTreeMap::new(),
            notes: Vec::new(),
        })
    }

    /// Creates the nodes of the targets and their dependencies, each after its parents. `order` is
    /// a topological order of all stages.
    pub(crate) fn expand(
        mut self,
        order: &[String],
        targets: &[String],
    ) -> Result<Plan, PlanError> {
        let needed = dependencies(targets, |stage| self.parent_stages(stage));
        let sinks: Vec<&str> =
            needed.iter().map(String::as_str).filter(|stage| self.is_sink(stage)).collect();
        check_show(self.pipeline, &sinks, self.selection)?;
        let mut sinks = Vec::new();
        for stage in order.iter().filter(|stage| needed.contains(*stage)) {
            let program = Arc::clone(self.programs.require(stage)?);
            if program.description.sink {
                sinks.push(self.sink(stage, program)?);
            } else {
                self.add_nodes(stage, &program)?;
            }
        }
        Ok(Plan { nodes: self.nodes, sinks, notes: self.notes, ..Plan::default() })
    }

    fn is_sink(&self, stage: &str) -> bool {
        self.programs.get(stage).is_some_and(|program| program.description.sink)
    }

    /// Returns the stages that a stage needs, or that a sink shows.
    fn parent_stages(&self, stage: &str) -> Vec<String> {
        if self.is_sink(stage) {
            let shown = shown_stages(self.pipeline, stage, self.selection);
            return shown.into_iter().map(str::to_owned).collect();
        }
        let sources = self.block_inputs(stage).into_iter();
        sources.filter_map(|(_, source)| source.stage().map(str::to_owned)).collect()
    }

    /// Creates a sink that shows all points of its stages.
    fn sink(&self, stage: &str, program: Arc<StageProgram>) -> Result<Sink, PlanError> {
        let parameters = self.resolve(stage, &program, &Point::new())?;
        let mut points: Vec<Vec<ShownPoint>> = Vec::new();
        let mut left_out = Vec::new();
        for shown in shown_stages(self.pipeline, stage, self.selection) {
            points.push(self.shown_points(shown));
            for (point, reason) in self.left_out.get(shown).into_iter().flatten() {
                left_out.push(FailedPoint {
                    stage: shown.to_owned(),
                    point: self.label(point),
                    values: self.values(point),
                    reason: Some(reason.clone()),
                });
            }
        }
        // A stage's nodes are consecutive. Two inputs may name the same stage.
        points.sort_by_key(|points| points.first().map(|shown| shown.node));
        points.dedup();
        let points = points.concat();
        let sink = Sink { stage: stage.to_owned(), program, parameters, points, left_out };
        self.check_sink_rules(&sink)?;
        Ok(sink)
    }

    /// Returns the points of a stage that have a node. Points with equal labels and values are one.
    fn shown_points(&self, stage: &str) -> Vec<ShownPoint> {
        let mut shown: Vec<ShownPoint> = Vec::new();
        for (point, node) in self.nodes_by_stage.get(stage).into_iter().flatten() {
            let (point, values) = (self.label(point), self.values(point));
            let point = ShownPoint { node: *node, point, values };
            if !shown.contains(&point) {
                shown.push(point);
            }
        }
        shown
    }

    /// Checks the rules of a sink's description for each node that it shows.
    fn check_sink_rules(&self, sink: &Sink) -> Result<(), PlanError> {
        let Sink { stage, program, parameters, .. } = sink;
        for (input, source) in self.block_inputs(stage) {
            for node in sink.nodes().into_iter().map(|index| &self.nodes[index]) {
                if source.stage() != Some(node.stage.as_str()) {
                    continue;
                }
                let given = Some(node.parameters.clone());
                let inputs = GivenInputs::from([(input.to_owned(), given)]);
                if let Some(problem) = program.description.broken_rule(parameters, &inputs) {
                    return Err(PlanError::Usage(format!("stage {stage}: {problem}")));
                }
            }
        }
        Ok(())
    }

    /// Returns the inputs of a block, without those that an axis replaces at every point.
    fn block_inputs(&self, stage: &str) -> Vec<(&'a str, InputSource<'a>)> {
        let mut inputs = Vec::new();
        for (name, source) in &self.pipeline.stages[stage].inputs {
            if !self.axes.iter().any(|axis| replaces_input(axis, stage, name)) {
                inputs.push((name.as_str(), InputSource::parse(source)));
            }
        }
        inputs
    }

    /// Returns whether a setting applies to a stage. A quality applies to each stage whose program
    /// has parameters of qualities. Any other setting applies to its own stage, and to blocks that
    /// extend this stage without a value of their own.
    fn applies(&self, setting: &Setting, stage: &str) -> bool {
        if setting.kind == Kind::Quality {
            return self.programs.get(stage).is_some_and(Quality::affects);
        }
        let block = &self.pipeline.stages[stage];
        setting.stage == stage
            || (block.extends.as_deref() == Some(&setting.stage)
                && !setting.kind.is_given(self.programs.get(stage), block, &setting.name))
    }

    /// Returns the settings of a point that apply to a stage, in the order of the axes.
    fn settings(&self, stage: &str, point: &Point) -> Vec<&Setting> {
        let mut settings = Vec::new();
        for (index, axis) in self.axes.iter().enumerate() {
            // An axis that doesn't reach the stage has no setting for it. Sinks have no point:
            // their axes have one value.
            let value = &axis.values[point.get(&index).copied().unwrap_or(0)];
            settings.extend(value.settings.iter().filter(|setting| self.applies(setting, stage)));
        }
        settings
    }

    fn add_nodes(&mut self, stage: &str, program: &Arc<StageProgram>) -> Result<(), PlanError> {
        let block = self.pipeline.layers(stage).next().unwrap_or(stage);
        self.add_note(Quality::note(block, program));
        for point in self.points(stage)? {
            let parameters = self.resolve(stage, program, &point)?;
            if let Some(reason) = self.reason_to_leave_out(stage, &point, &parameters) {
                self.left_out.entry(stage.to_owned()).or_default().push((point, reason));
                continue;
            }
            let inputs = self.node_inputs(stage, &point);
            // Points with equal parameters and inputs share a node.
            let content = format!("{stage} {parameters} {inputs:?}");
            let index = match self.node_by_content.get(&content).copied() {
                Some(index) => index,
                None => {
                    let node = Node {
                        stage: stage.to_owned(),
                        point: self.label(&point),
                        values: self.values(&point),
                        parameters,
                        inputs,
                        program: Arc::clone(program),
                    };
                    self.check_rules(&node)?;
                    self.node_by_content.insert(content, self.nodes.len());
                    self.nodes.push(node);
                    self.nodes.len() - 1
                }
            };
            self.nodes_by_stage.entry(stage.to_owned()).or_default().push((point, index));
        }
        Ok(())
    }

    /// Adds a note unless it is known.
    fn add_note(&mut self, note: Option<String>) {
        self.notes.extend(note.filter(|note| !self.notes.contains(note)));
    }

    /// Checks the rules of a stage's description, which may refer to the parameters of its parents.
    fn check_rules(&self, node: &Node) -> Result<(), PlanError> {
        let inputs = node.given_inputs(&self.nodes);
        match node.program.description.broken_rule(&node.parameters, &inputs) {
            Some(problem) => Err(PlanError::Usage(format!("stage {}: {problem}", node.label()))),
            None => Ok(()),
        }
    }

    /// Returns the reason for leaving out a stage at a point, if any: the stage's own file is
    /// missing, or a parent is left out. Adds a note only if the stage's own file is missing.
    fn reason_to_leave_out(
        &mut self,
        stage: &str,
        point: &Point,
        parameters: &Value,
    ) -> Option<String> {
        if let Some(reason) = self.required_files.reason_to_leave_out(stage, parameters) {
            let data = self.required_files.data.display();
            self.add_note(Some(format!("{stage}: left out: {reason} in {data}")));
            return Some(reason);
        }
        for parent in self.block_inputs(stage).into_iter().filter_map(|(_, s)| s.stage()) {
            let mut left_out = self.left_out.get(parent).into_iter().flatten();
            if let Some((_, reason)) = left_out.find(|(part, _)| is_subset(part, point)) {
                return Some(reason.clone());
            }
        }
        None
    }

    /// Returns all combinations of the values that reach a stage: those of its own axes and of its
    /// parents'.
    fn points(&self, stage: &str) -> Result<Vec<Point>, PlanError> {
        let mut reaching = BTreeSet::new();
        for (index, axis) in self.axes.iter().enumerate() {
            if axis.settings().any(|setting| self.applies(setting, stage)) {
                reaching.insert(index);
            }
        }
        for parent in self.block_inputs(stage).into_iter().filter_map(|(_, s)| s.stage()) {
            let nodes = self.nodes_by_stage.get(parent).into_iter().flatten();
            let left_out = self.left_out.get(parent).into_iter().flatten();
            let points = nodes.map(|(point, _)| point).chain(left_out.map(|(point, _)| point));
            reaching.extend(points.flat_map(|point| point.keys().copied()));
        }
        let mut points: Vec<Point> = vec![Point::new()];
        for axis in reaching {
            let values = self.axes[axis].values.len();
            if points.len() * values + self.nodes.len() > MAX_NODES {
                let problem = format!(
                    "with the points of {stage}, the plan has more than {MAX_NODES} nodes; sweep \
                    fewer values at once"
                );
                return Err(PlanError::Usage(problem));
            }
            let mut extended = Vec::with_capacity(points.len() * values);
            for point in &points {
                for value in 0..values {
                    let mut point = point.clone();
                    point.insert(axis, value);
                    extended.push(point);
                }
            }
            points = extended;
        }
        Ok(points)
    }

    /// Returns the inputs of a node, sorted by name.
    fn node_inputs(&self, stage: &str, point: &Point) -> Vec<NodeInput> {
        let mut inputs: BTreeMap<String, Origin> = BTreeMap::new();
        for (name, source) in self.block_inputs(stage) {
            let origin = match source {
                InputSource::Folder(path) => {
                    Origin::Folder(self.pipeline.resolve_path(stage, Part::Input(name), path))
                }
                InputSource::Stage { name, subtree } => Origin::Node {
                    index: self.parent(name, point),
                    subtree: subtree.map(str::to_owned),
                },
            };
            inputs.insert(name.to_owned(), origin);
        }
        for setting in self.settings(stage, point) {
            if setting.kind == Kind::Input {
                inputs.insert(setting.name.clone(), Origin::Folder(setting.folder()));
            }
        }
        inputs.into_iter().map(|(name, from)| NodeInput { name, from }).collect()
    }

    /// Returns the index of a parent's node at a point of its child.
    fn parent(&self, stage: &str, point: &Point) -> usize {
        let found = self.nodes_by_stage[stage].iter().find(|(part, _)| is_subset(part, point));
        found.expect("a parent's axes reach its children").1
    }

    /// Returns the label of a point: names and values of the swept axes.
    fn label(&self, point: &Point) -> String {
        let swept = self.named_values(point).filter(|(axis, _)| axis.values.len() > 1);
        swept.map(|(axis, text)| format!("{}={text}", axis.name)).collect::<Vec<_>>().join(", ")
    }

    /// Returns the values of the named axes at a point, for tables. An axis's only value applies to
    /// every node.
    fn values(&self, point: &Point) -> BTreeMap<String, String> {
        let mut values: BTreeMap<String, String> = BTreeMap::new();
        for (axis, text) in self.named_values(point) {
            values.insert(axis.name.clone(), text.to_owned());
        }
        for axis in self.axes.iter().filter(|axis| axis.is_named && axis.values.len() == 1) {
            values.insert(axis.name.clone(), axis.values[0].text.clone());
        }
        values
    }

    fn named_values<'b>(&'b self, point: &'b Point) -> impl Iterator<Item = (&'b Axis, &'b str)> {
        let values = point.iter().map(|(axis, value)| (&self.axes[*axis], *value));
        let named = values.filter(|(axis, _)| axis.is_named);
        named.map(|(axis, value)| (axis, axis.values[value].text.as_str()))
    }

    /// Returns the quality of a stage at a point.
    fn quality(&self, stage: &str, point: &Point) -> Quality {
        let settings = self.settings(stage, point);
        let last = settings.into_iter().rfind(|setting| setting.kind == Kind::Quality);
        // Axes hold valid qualities alone.
        let given = last.and_then(|setting| Quality::parse(&setting.value).ok());
        given.or(self.pipeline.quality).unwrap_or_default()
    }

    /// Resolves a stage's parameters at a point. Later layers override earlier ones: defaults, the
    /// quality, the block that the stage's block extends, the block itself. In both blocks, values
    /// of axes (command line and experiment) override those of the file.
    fn resolve(
        &self,
        stage: &str,
        program: &StageProgram,
        point: &Point,
    ) -> Result<Value, PlanError> {
        let mut given = Map::new();
        for layer in self.pipeline.layers(stage) {
            program.lay_over(&mut given, &self.pipeline.stages[layer]);
            let mut settings = Map::new();
            for setting in self.settings(stage, point) {
                if setting.kind == Kind::Parameter && setting.stage == layer {
                    settings.insert(setting.name.clone(), setting.value.clone());
                }
            }
            program.schema.override_with(&mut given, &settings);
        }
        self.quality(stage, point).fill(program, &mut given);
        program
            .schema
            .resolve(&given)
            .map_err(|problems| PlanError::Usage(format!("stage {stage}: {}", problems[0])))
    }
}

/// Returns whether every value of an axis sets an input of a stage.
fn replaces_input(axis: &Axis, stage: &str, input: &str) -> bool {
    axis.values.iter().all(|value| {
        let mut settings = value.settings.iter();
        settings.any(|set| set.stage == stage && set.kind == Kind::Input && set.name == input)
    })
}

/// Returns whether a point has all values of `part`.
fn is_subset(part: &Point, point: &Point) -> bool {
    part.iter().all(|(axis, value)| point.get(axis) == Some(value))
}

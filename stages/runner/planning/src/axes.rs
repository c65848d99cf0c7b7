//! Axes of the plan: values of parameters and inputs from the command line and from experiments,
//! swept if there are several.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use artifact::{known_names, suggestion};
use serde_json::Value;

use crate::arguments;
use crate::check::known_stages;
use crate::file::StageBlock;
use crate::pipeline::Pipeline;
use crate::quality::{QUALITY, Quality};
use crate::request::{PlanError, Request};
use crate::stages::{Programs, StageProgram};

/// Names of entries that `table` itself adds to each row, next to the values of the axes.
const TABLE_ENTRIES: [&str; 5] = ["method", "missing", "views", "commit", "machine"];

/// Alternative values, of which each point of the sweep has one.
#[derive(Debug)]
pub(crate) struct Axis {
    /// Name in the labels of points.
    pub name: String,
    pub values: Vec<AxisValue>,
    /// True if tables list the axis's value, even if it is the only one.
    pub is_named: bool,
    /// Text on the command line, for messages.
    argument: String,
}

/// A value of one parameter or input of a stage.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Setting {
    pub stage: String,
    pub kind: Kind,
    pub name: String,
    /// Value of a parameter, or canonical path of an input's folder.
    pub value: Value,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Parameter,
    Input,
    /// Quality of all stages, which belongs to no stage.
    Quality,
}

/// One value of an axis: its text and its settings. A value on the command line has one setting; a
/// scene, protocol or variant of an experiment has several.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct AxisValue {
    pub text: String,
    pub settings: Vec<Setting>,
}

impl Kind {
    fn flag(self) -> &'static str {
        match self {
            Self::Parameter | Self::Quality => "-p",
            Self::Input => "-i",
        }
    }

    fn noun(self) -> &'static str {
        match self {
            Self::Parameter => "parameter",
            Self::Input => "input",
            Self::Quality => QUALITY,
        }
    }

    /// Returns whether a block gives a parameter or input itself.
    pub(crate) fn is_given(
        self,
        program: Option<&StageProgram>,
        block: &StageBlock,
        name: &str,
    ) -> bool {
        match self {
            Self::Parameter => program.is_some_and(|program| program.is_given(block, name)),
            Self::Input => block.inputs.contains_key(name),
            Self::Quality => false,
        }
    }

    fn names(self, program: &StageProgram) -> Vec<&str> {
        match self {
            Self::Parameter => program.schema.names(),
            Self::Input => program.description.inputs.keys().map(String::as_str).collect(),
            Self::Quality => Vec::new(),
        }
    }
}

impl Setting {
    /// Creates the setting of a quality.
    fn quality(value: &Value) -> Result<Self, String> {
        let value = Value::from(Quality::parse(value)?.name());
        Ok(Self { stage: String::new(), kind: Kind::Quality, name: QUALITY.to_owned(), value })
    }

    /// Returns the folder of an input.
    pub(crate) fn folder(&self) -> PathBuf {
        PathBuf::from(self.value.as_str().unwrap_or_default())
    }

    /// Returns whether two settings set the same parameter or input.
    fn sets_the_same(&self, other: &Self) -> bool {
        (&self.stage, self.kind, &self.name) == (&other.stage, other.kind, &other.name)
    }
}

impl Axis {
    /// Creates an axis of an experiment.
    pub(crate) fn new(name: &str, values: Vec<AxisValue>) -> Self {
        Self { name: name.to_owned(), values, is_named: true, argument: String::new() }
    }

    /// Returns the settings of all values.
    pub(crate) fn settings(&self) -> impl Iterator<Item = &Setting> {
        self.values.iter().flat_map(|value| &value.settings)
    }

    /// Returns whether each value has one setting.
    fn is_single(&self) -> bool {
        self.values.iter().all(|value| value.settings.len() == 1)
    }

    /// Returns whether the first settings of two axes set the same parameter or input.
    fn sets_the_same(&self, other: &Self) -> bool {
        let first = self.settings().next();
        first.is_some_and(|own| other.settings().next().is_some_and(|s| own.sets_the_same(s)))
    }
}

/// Context for resolving the names of parameters and inputs.
pub(crate) struct Scope<'a> {
    pub pipeline: &'a Pipeline,
    pub programs: &'a Programs,
    /// Targets and their transitive dependencies.
    pub needed: &'a BTreeSet<String>,
}

impl Scope<'_> {
    /// Returns the axes of the experiment and the command line, with notes on overridden and
    /// repeated arguments. Later axes override earlier ones.
    pub(crate) fn axes(
        &self,
        request: &Request,
        mut experiment: Vec<Axis>,
    ) -> Result<(Vec<Axis>, Vec<String>), PlanError> {
        let mut axes: Vec<Axis> = Vec::new();
        let mut notes = Vec::new();
        let parameters = request.parameters.iter().map(|text| (Kind::Parameter, text));
        let inputs = request.inputs.iter().map(|text| (Kind::Input, text));
        for (kind, text) in parameters.chain(inputs) {
            let axis = self.parse_axis(kind, text, &mut notes)?;
            if let Some(earlier) = axes.iter().position(|earlier| earlier.sets_the_same(&axis)) {
                let overridden = axes.remove(earlier).argument;
                notes.push(format!("{overridden}: overridden by {}", axis.argument));
            }
            // An axis with one setting per value is replaced. One with several stays, and the
            // command line overrides one of its settings.
            let count = experiment.len();
            experiment.retain(|earlier| !earlier.is_single() || !earlier.sets_the_same(&axis));
            let is_named = axis.is_named || experiment.len() < count;
            axes.push(Axis { is_named, ..axis });
        }
        experiment.extend(axes);
        name_by_stage(&mut experiment);
        Ok((experiment, notes))
    }

    /// Resolves a name and value of an experiment.
    pub(crate) fn setting(
        &self,
        kind: Kind,
        name: &str,
        value: &Value,
    ) -> Result<Setting, PlanError> {
        if kind == Kind::Parameter && name == QUALITY {
            return Setting::quality(value)
                .map_err(|e| self.pipeline.error_in_experiment(name, &e).into());
        }
        let (stage, name) = self.find_owner(kind, name).map_err(|error| match error {
            PlanError::Usage(problem) => {
                let problem = problem.trim_start_matches(kind.flag()).trim_start();
                self.pipeline.error_in_experiment(name, problem).into()
            }
            other => other,
        })?;
        let program = self.programs.require(&stage)?;
        let value = match kind {
            Kind::Parameter => program.schema.canonical_value(&name, value),
            Kind::Input | Kind::Quality => value.clone(),
        };
        Ok(Setting { stage, kind, name, value })
    }

    /// Parses an argument NAME=VALUE[,VALUE…].
    fn parse_axis(
        &self,
        kind: Kind,
        text: &str,
        notes: &mut Vec<String>,
    ) -> Result<Axis, PlanError> {
        let argument = format!("{} {text}", kind.flag());
        let (name, text) = text
            .split_once('=')
            .ok_or_else(|| usage_error(&argument, "expected NAME=VALUE[,VALUE…]"))?;
        if kind == Kind::Parameter && name == QUALITY {
            return quality_axis(argument, text, notes);
        }
        let (stage, name) = self.find_owner(kind, name)?;
        let program = self.programs.require(&stage)?;
        let texts_and_values: Vec<(&str, Value)> = match kind {
            Kind::Parameter => {
                let given = arguments::values(text).map_err(|e| usage_error(&argument, e))?;
                given
                    .into_iter()
                    .map(|(text, value)| (text, program.schema.canonical_value(&name, &value)))
                    .collect()
            }
            Kind::Input | Kind::Quality => {
                let folders = arguments::folders(text).map_err(|e| usage_error(&argument, e))?;
                folders.into_iter().map(|text| (text, canonical_folder(text.as_ref()))).collect()
            }
        };
        let settings = texts_and_values.into_iter().map(|(text, value)| {
            (text, Setting { stage: stage.clone(), kind, name: name.clone(), value })
        });
        let values = distinct_values(&argument, settings, notes);
        if program.description.sink && kind == Kind::Input {
            let problem = format!(
                "{stage} is a sink, which shows results of the run and reads no folder; remove the \
                argument"
            );
            return Err(usage_error(&argument, problem));
        }
        if program.description.sink && values.len() > 1 {
            let problem = format!(
                "{stage} is a sink and shows all points of a sweep at once; give one value"
            );
            return Err(usage_error(&argument, problem));
        }
        let is_named = values.len() > 1;
        Ok(Axis { name, values, is_named, argument })
    }

    /// Returns the stage that a name belongs to, and the name without the stage. If several stages
    /// have the name, the one that the targets need is meant; a block whose value is left to the
    /// block that it extends doesn't count.
    fn find_owner(&self, kind: Kind, name: &str) -> Result<(String, String), PlanError> {
        // A stage's name may contain dots.
        let mut splits = name.match_indices('.').map(|(at, _)| (&name[..at], &name[at + 1..]));
        let explicit = splits
            .find(|(stage, _)| self.pipeline.stages.contains_key(*stage))
            .or_else(|| name.split_once('.'));
        if let Some((stage, own_name)) = explicit {
            self.check_owner(kind, stage, own_name)?;
            return Ok((stage.to_owned(), own_name.to_owned()));
        }
        let stages = self.pipeline.stages.keys();
        let all: Vec<&String> = stages
            .filter(|s| self.has(s, kind, name) && !self.is_left_to_base(s, kind, name))
            .collect();
        let needed: Vec<&String> =
            all.iter().copied().filter(|s| self.needed.contains(*s)).collect();
        match if needed.is_empty() { &all } else { &needed }[..] {
            [] => Err(self.unknown_name(kind, name)),
            [stage] => Ok((stage.clone(), name.to_owned())),
            ref several => {
                let options: Vec<String> = several.iter().map(|s| format!("{s}.{name}")).collect();
                Err(PlanError::Usage(format!(
                    "{} {name}: several stages have this {}; choose one: {}",
                    kind.flag(),
                    kind.noun(),
                    options.join(", ")
                )))
            }
        }
    }

    fn has(&self, stage: &str, kind: Kind, name: &str) -> bool {
        self.programs.get(stage).is_some_and(|program| kind.names(program).contains(&name))
    }

    /// Returns whether a name is left to the block that a block extends: the extended block is
    /// needed, or the block sets no value of its own.
    fn is_left_to_base(&self, stage: &str, kind: Kind, name: &str) -> bool {
        let block = &self.pipeline.stages[stage];
        block.extends.as_ref().is_some_and(|base| {
            self.needed.contains(base) || !kind.is_given(self.programs.get(stage), block, name)
        })
    }

    /// Checks that an explicitly named stage exists and has a parameter or input.
    fn check_owner(&self, kind: Kind, stage: &str, name: &str) -> Result<(), PlanError> {
        let problem = if self.pipeline.stages.contains_key(stage) {
            let names = kind.names(self.programs.require(stage)?);
            if names.contains(&name) {
                return Ok(());
            }
            format!("{stage} has no such {}; {}", kind.noun(), known_names(name, names))
        } else {
            format!("no stage {stage:?}; {}", known_stages(self.pipeline, stage))
        };
        Err(PlanError::Usage(format!("{} {stage}.{name}: {problem}", kind.flag())))
    }

    fn unknown_name(&self, kind: Kind, name: &str) -> PlanError {
        let programs = self.pipeline.stages.keys().filter_map(|stage| self.programs.get(stage));
        let known: BTreeSet<&str> = programs.flat_map(|program| kind.names(program)).collect();
        let mut problem = format!(
            "{} {name}: no stage has this {}; {}see `STAGE --help`",
            kind.flag(),
            kind.noun(),
            suggestion(name, known)
        );
        let unusable: Vec<&str> = self.programs.unusable().collect();
        if !unusable.is_empty() {
            let stages = unusable.join(", ");
            problem += &format!("; stages without a description were not searched: {stages}");
        }
        PlanError::Usage(problem)
    }
}

/// Adds the stage to the name of a parameter's or input's axis if another axis or a table's entry
/// has the same name. Otherwise labels would be ambiguous, and tables would average different
/// points.
fn name_by_stage(axes: &mut [Axis]) {
    let named = axes.iter().filter(|axis| axis.is_named).map(|axis| axis.name.clone());
    let taken: Vec<String> = named.chain(TABLE_ENTRIES.map(str::to_owned)).collect();
    for axis in axes.iter_mut().filter(|axis| axis.is_named) {
        let is_ambiguous = taken.iter().filter(|name| **name == axis.name).count() > 1;
        // Scenes, protocols, variants and qualities belong to no stage.
        let setting = axis.settings().next().filter(|s| s.name == axis.name && is_ambiguous);
        let stage = setting.map(|setting| setting.stage.clone()).unwrap_or_default();
        if !stage.is_empty() {
            axis.name = format!("{stage}.{}", axis.name);
        }
    }
}

/// Returns the axis of an argument `quality=WORD[,WORD…]`.
fn quality_axis(argument: String, text: &str, notes: &mut Vec<String>) -> Result<Axis, PlanError> {
    let mut settings = Vec::new();
    for (text, value) in arguments::values(text).map_err(|e| usage_error(&argument, e))? {
        settings.push((text, Setting::quality(&value).map_err(|e| usage_error(&argument, e))?));
    }
    let values = distinct_values(&argument, settings.into_iter(), notes);
    Ok(Axis { name: QUALITY.to_owned(), is_named: values.len() > 1, values, argument })
}

/// Returns the values of an axis with one setting each; a repeated setting is noted and used once.
fn distinct_values<'a>(
    argument: &str,
    settings: impl Iterator<Item = (&'a str, Setting)>,
    notes: &mut Vec<String>,
) -> Vec<AxisValue> {
    let mut values: Vec<AxisValue> = Vec::new();
    for (text, setting) in settings {
        let settings = vec![setting];
        match values.iter().find(|earlier| earlier.settings == settings) {
            Some(earlier) => {
                let first = &earlier.text;
                notes.push(format!("{argument}: {text} equals {first}; it is used once"));
            }
            None => values.push(AxisValue { text: text.to_owned(), settings }),
        }
    }
    values
}

fn usage_error(argument: &str, problem: impl std::fmt::Display) -> PlanError {
    PlanError::Usage(format!("{argument}: {problem}"))
}

/// Returns the canonical path of a folder as a setting's value.
pub(crate) fn canonical_folder(path: &Path) -> Value {
    let canonical = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    Value::from(canonical.to_string_lossy())
}

//! What the command line sets: values of parameters and inputs, each for a stage, swept where there
//! are several.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use artifact::known_names;
use serde_json::Value;

use crate::arguments;
use crate::file::StageBlock;
use crate::pipeline::Pipeline;
use crate::request::{PlanError, Request};
use crate::stages::{Programs, StageProgram};

/// Settings that go together, or several such that are swept.
#[derive(Debug)]
pub(crate) struct Axis {
    /// By which points are called.
    pub name: String,
    pub values: Vec<AxisValue>,
    /// Whether points have its value in their name, though it is the only one.
    pub is_named: bool,
    /// As it was given, for people.
    given: String,
}

/// A parameter or an input of a stage, set.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Setting {
    pub stage: String,
    pub kind: Kind,
    pub name: String,
    /// The parameter's value; of an input, the folder that it leads to.
    pub value: Value,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Parameter,
    Input,
}

/// One value of an axis: as it was written, and what it sets. On the command line that is one
/// thing; a scene, a protocol or a variant of an experiment sets several.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct AxisValue {
    pub text: String,
    pub settings: Vec<Setting>,
}

impl Kind {
    fn flag(self) -> &'static str {
        match self {
            Self::Parameter => "-p",
            Self::Input => "-i",
        }
    }

    fn noun(self) -> &'static str {
        match self {
            Self::Parameter => "parameter",
            Self::Input => "input",
        }
    }

    fn article(self) -> &'static str {
        match self {
            Self::Parameter => "a",
            Self::Input => "an",
        }
    }

    /// Whether a block gives that name itself.
    pub(crate) fn is_given(
        self,
        program: Option<&StageProgram>,
        block: &StageBlock,
        name: &str,
    ) -> bool {
        match self {
            Self::Parameter => program.is_some_and(|program| program.is_given(block, name)),
            Self::Input => block.inputs.contains_key(name),
        }
    }

    fn names(self, program: &StageProgram) -> Vec<&str> {
        match self {
            Self::Parameter => program.schema.names(),
            Self::Input => program.description.inputs.keys().map(String::as_str).collect(),
        }
    }
}

impl Setting {
    /// The folder that an input leads to.
    pub(crate) fn folder(&self) -> PathBuf {
        PathBuf::from(self.value.as_str().unwrap_or_default())
    }

    fn is_of(&self, other: &Self) -> bool {
        (&self.stage, self.kind, &self.name) == (&other.stage, other.kind, &other.name)
    }
}

impl Axis {
    /// An axis of an experiment.
    pub(crate) fn new(name: &str, values: Vec<AxisValue>) -> Self {
        Self { name: name.to_owned(), values, is_named: true, given: String::new() }
    }

    /// All that any of its values sets.
    pub(crate) fn settings(&self) -> impl Iterator<Item = &Setting> {
        self.values.iter().flat_map(|value| &value.settings)
    }

    /// Whether each of its values sets one thing.
    fn is_single(&self) -> bool {
        self.values.iter().all(|value| value.settings.len() == 1)
    }

    /// Whether both set one and the same thing.
    fn is_of(&self, other: &Self) -> bool {
        self.settings().zip(other.settings()).next().is_some_and(|(one, other)| one.is_of(other))
    }
}

/// What names on the command line are looked up in.
pub(crate) struct Scope<'a> {
    pub pipeline: &'a Pipeline,
    pub programs: &'a Programs,
    /// The stages that the targets come to.
    pub needed: &'a BTreeSet<String>,
}

impl Scope<'_> {
    /// The axes in the order in which they were given, the last one where several set the same; and
    /// what to say of it.
    ///
    /// `experiment` are those of the pipeline's file.
    pub(crate) fn axes(
        &self,
        request: &Request,
        mut experiment: Vec<Axis>,
    ) -> Result<(Vec<Axis>, Vec<String>), PlanError> {
        let (mut axes, mut notes): (Vec<Axis>, Vec<String>) = (Vec::new(), Vec::new());
        let parameters = request.parameters.iter().map(|text| (Kind::Parameter, text));
        let inputs = request.inputs.iter().map(|text| (Kind::Input, text));
        for (kind, text) in parameters.chain(inputs) {
            let axis = self.axis(kind, text, &mut notes)?;
            if let Some(earlier) = axes.iter().position(|earlier| earlier.is_of(&axis)) {
                notes.push(format!("{}: overridden by {}", axes.remove(earlier).given, axis.given));
            }
            // A sweep of the file gives way; what sets several things at once stays, and the
            // command line wins over a part of it.
            let before = experiment.len();
            experiment.retain(|earlier| !earlier.is_single() || !earlier.is_of(&axis));
            // What takes the place of an axis with a name is in tables, too.
            let is_named = axis.is_named || experiment.len() < before;
            axes.push(Axis { is_named, ..axis });
        }
        // What is said on the command line comes later, and so wins.
        Ok((experiment.into_iter().chain(axes).collect(), notes))
    }

    /// What a name and a value of an experiment's file set.
    pub(crate) fn setting(
        &self,
        kind: Kind,
        name: &str,
        value: &Value,
    ) -> Result<Setting, PlanError> {
        let (stage, name) =
            self.owner(kind, name).map_err(|error| self.in_file(kind, name, error))?;
        let program = self.programs.require(&stage)?;
        let value = if kind == Kind::Parameter {
            program.schema.canonical_value(&name, value)
        } else {
            value.clone()
        };
        Ok(Setting { stage, kind, name, value })
    }

    /// An error about what the command line could say, as one about a name in an experiment's file.
    fn in_file(&self, kind: Kind, name: &str, error: PlanError) -> PlanError {
        match error {
            PlanError::Usage(problem) => {
                let problem = problem.trim_start_matches(kind.flag()).trim_start();
                PlanError::Pipeline(self.pipeline.error_in_experiment(name, problem))
            }
            other => other,
        }
    }

    fn axis(&self, kind: Kind, text: &str, notes: &mut Vec<String>) -> Result<Axis, PlanError> {
        let given = format!("{} {text}", kind.flag());
        let usage = |problem: String| PlanError::Usage(format!("{given}: {problem}"));
        let (name, text) =
            text.split_once('=').ok_or_else(|| usage("expected NAME=VALUE[,VALUE…]".to_owned()))?;
        let (stage, name) = self.owner(kind, name)?;
        let program = self.programs.require(&stage)?;
        let values: Vec<(&str, Value)> = match kind {
            Kind::Parameter => {
                let given = arguments::values(text).map_err(|e| usage(e.to_string()))?.into_iter();
                given
                    .map(|(text, given)| (text, program.schema.canonical_value(&name, &given)))
                    .collect()
            }
            Kind::Input => arguments::folders(text)
                .map_err(|e| usage(e.to_string()))?
                .into_iter()
                .map(|text| (text, folder(text)))
                .collect(),
        };
        let values = values.into_iter().map(|(text, value)| AxisValue {
            text: text.to_owned(),
            settings: vec![Setting { stage: stage.clone(), kind, name: name.clone(), value }],
        });
        let values = each_once(values.collect(), |again, first| {
            notes.push(format!("{given}: {again} is {first} again; it is made once"));
        });
        if program.description.sink && kind == Kind::Input {
            return Err(usage(format!(
                "{stage} is a sink, which shows what the run made; it takes no folder"
            )));
        }
        if program.description.sink && values.len() > 1 {
            return Err(usage(format!(
                "{stage} is a sink and shows all points of a sweep at once; give one value"
            )));
        }
        let is_named = values.len() > 1;
        Ok(Axis { name, values, is_named, given })
    }

    /// The stage that a name belongs to, and the name without it. Where several stages have the
    /// name, that one is meant that the targets need; a block that extends another follows that
    /// one.
    fn owner(&self, kind: Kind, name: &str) -> Result<(String, String), PlanError> {
        // A stage's own name may have a point.
        let mut splits = name.match_indices('.').map(|(at, _)| (&name[..at], &name[at + 1..]));
        let stated = splits
            .find(|(stage, _)| self.pipeline.stages.contains_key(*stage))
            .or_else(|| name.split_once('.'));
        if let Some((stage, own)) = stated {
            return self.stated_owner(kind, (stage, own));
        }
        let stages = self.pipeline.stages.keys();
        let with_name: Vec<&String> =
            stages.filter(|s| self.has(s, kind, name) && !self.follows(s, kind, name)).collect();
        let meant: Vec<&String> =
            with_name.iter().copied().filter(|s| self.needed.contains(*s)).collect();
        match if meant.is_empty() { &with_name } else { &meant }[..] {
            [] => Err(self.unknown(kind, name)),
            [stage] => Ok((stage.clone(), name.to_owned())),
            ref several => {
                let options =
                    several.iter().map(|s| format!("{s}.{name}")).collect::<Vec<_>>().join(", ");
                let problem = format!(
                    "{} {name}: more than one stage has it; say which: {options}",
                    kind.flag()
                );
                Err(PlanError::Usage(problem))
            }
        }
    }

    fn has(&self, stage: &str, kind: Kind, name: &str) -> bool {
        self.programs.get(stage).is_some_and(|program| kind.names(program).contains(&name))
    }

    /// Whether a block extends another, and has that name's value from there.
    fn follows(&self, stage: &str, kind: Kind, name: &str) -> bool {
        let block = &self.pipeline.stages[stage];
        let is_own = || kind.is_given(self.programs.get(stage), block, name);
        block.extends.as_ref().is_some_and(|other| self.needed.contains(other) || !is_own())
    }

    /// The stage that is named itself, which must have such a parameter or input.
    fn stated_owner(
        &self,
        kind: Kind,
        (stage, own): (&str, &str),
    ) -> Result<(String, String), PlanError> {
        let usage =
            |problem: String| PlanError::Usage(format!("{} {stage}.{own}: {problem}", kind.flag()));
        if !self.pipeline.stages.contains_key(stage) {
            let known = known_names(stage, self.pipeline.stages.keys().map(String::as_str));
            return Err(usage(format!("no stage {stage:?}; {known}")));
        }
        let names = kind.names(self.programs.require(stage)?);
        if names.contains(&own) {
            return Ok((stage.to_owned(), own.to_owned()));
        }
        Err(usage(format!("{stage} has no such {}; {}", kind.noun(), known_names(own, names))))
    }

    fn unknown(&self, kind: Kind, name: &str) -> PlanError {
        let programs = self.pipeline.stages.keys().filter_map(|stage| self.programs.get(stage));
        let known: BTreeSet<&str> = programs.flat_map(|program| kind.names(program)).collect();
        let meant = artifact::nearest(name, known)
            .map(|known| format!("did you mean {known}? "))
            .unwrap_or_default();
        let problem = format!(
            "{} {name}: no stage has such {} {}; {meant}see `STAGE --help`",
            kind.flag(),
            kind.article(),
            kind.noun()
        );
        let unasked: Vec<&str> = self.programs.unknown().collect();
        if unasked.is_empty() {
            return PlanError::Usage(problem);
        }
        PlanError::Usage(format!("{problem}; {} couldn't be asked", unasked.join(", ")))
    }
}

/// A folder's name, which means the folder that it leads to.
pub(crate) fn folder(name: &str) -> Value {
    let leads_to = Path::new(name).canonicalize().unwrap_or_else(|_| PathBuf::from(name));
    Value::from(leads_to.to_string_lossy())
}

/// Values without those that mean the same as an earlier one; `tell` is told of these and of the
/// earlier ones.
fn each_once(values: Vec<AxisValue>, mut tell: impl FnMut(&str, &str)) -> Vec<AxisValue> {
    let mut kept: Vec<AxisValue> = Vec::new();
    for value in values {
        match kept.iter().find(|earlier| earlier.settings == value.settings) {
            Some(earlier) => tell(&value.text, &earlier.text),
            None => kept.push(value),
        }
    }
    kept
}

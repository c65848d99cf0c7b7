//! Checks of the whole file, whatever is asked for: first of what it says alone, then of its blocks
//! against their stages' descriptions.

use std::collections::BTreeSet;

use artifact::known_names;
use contract::{Description, Input};
use serde_json::Map;

use crate::file::StageBlock;
use crate::part::{Part, PipelineError, Source};
use crate::pipeline::Pipeline;
use crate::stages::{Programs, StageProgram};

/// Checks that every stage which the file names is there.
pub(crate) fn names(pipeline: &Pipeline) -> Result<(), PipelineError> {
    let known = |name: &str| known_names(name, pipeline.stages.keys().map(String::as_str));
    for name in &pipeline.default {
        if !pipeline.stages.contains_key(name) {
            let problem = format!(
                "stage {name}: named in `default`, but there is no such stage; {}",
                known(name)
            );
            return Err(pipeline.error_in_default(problem));
        }
    }
    for (name, block) in &pipeline.stages {
        extension(pipeline, name, block)?;
        for (input, source) in &block.inputs {
            if let Some(other) =
                Source::of(source).stage().filter(|other| !pipeline.stages.contains_key(*other))
            {
                let problem = format!(
                    "input {input}: no stage {other:?}; a folder begins with ./ or /; {}",
                    known(other)
                );
                return Err(pipeline.error(name, Part::Input(input), problem));
            }
        }
    }
    Ok(())
}

/// Checks that a block extends another as it may.
fn extension(pipeline: &Pipeline, name: &str, block: &StageBlock) -> Result<(), PipelineError> {
    let Some(other) = &block.extends else { return Ok(()) };
    let problem = match pipeline.stages.get(other) {
        None => {
            let known = known_names(other, pipeline.stages.keys().map(String::as_str));
            format!("extends: there is no stage {other:?}; {known}")
        }
        Some(other_block) if other_block.extends.is_some() => {
            format!("extends: {other:?} itself extends another; name that one")
        }
        Some(_) if block.run.is_some() => {
            "run: what it runs follows from `extends`; give one of them".to_owned()
        }
        Some(_) => return Ok(()),
    };
    Err(pipeline.error(name, Part::Field("extends"), problem))
}

/// Checks every block whose stage is known against its description, and every input against what it
/// names.
pub(crate) fn blocks(pipeline: &Pipeline, programs: &Programs) -> Result<(), PipelineError> {
    // What is wrong with a block that others extend is said of it alone.
    let (extending, own): (Vec<_>, Vec<_>) =
        pipeline.stages.iter().partition(|(_, block)| block.extends.is_some());
    for (name, block) in own.into_iter().chain(extending) {
        let Some(program) = programs.get(name) else { continue };
        parameters(pipeline, program, name, block)?;
        for (input, source) in &block.inputs {
            check_input(&program.description, input, source, programs)
                .map_err(|e| pipeline.error(name, Part::Input(input), e.to_string()))?;
        }
        for (input, port) in &program.description.inputs {
            let is_given = block.inputs.contains_key(input)
                || (program.description.sink && !block.inputs.is_empty());
            if !port.optional && !is_given {
                return Err(pipeline.error(
                    name,
                    Part::Block,
                    format!("input {input} is missing ({})", port.summary),
                ));
            }
        }
    }
    Ok(())
}

/// Checks the parameters of a block, over those of the block that it extends.
fn parameters(
    pipeline: &Pipeline,
    program: &StageProgram,
    name: &str,
    block: &StageBlock,
) -> Result<(), PipelineError> {
    let mut given = Map::new();
    pipeline.layers(name).for_each(|layer| program.lay_over(&mut given, &pipeline.stages[layer]));
    let Err(problems) = program.schema.resolve(&given) else { return Ok(()) };
    let parameter = problems[0].name.split('/').next().unwrap_or_default();
    let part =
        if program.is_given(block, parameter) { Part::Parameter(parameter) } else { Part::Block };
    Err(pipeline.error(name, part, problems[0].to_string()))
}

/// What is wrong with an input of a block, and what to do.
#[derive(Debug, thiserror::Error)]
enum InputError<'a> {
    /// The stage doesn't have it; `known` says what it has.
    #[error("it has no input {input:?}; {known}")]
    Unknown { input: &'a str, known: String },
    /// A sink is given a folder.
    #[error("input {input}: a sink shows stages, and {folder} is a folder; name a stage")]
    Folder { input: &'a str, folder: &'a str },
    /// It names a sink.
    #[error("input {input}: {stage} is a sink, which shows a run; nothing can be made of that")]
    Sink { input: &'a str, stage: &'a str },
    /// The artifact that it names has no such folder; `known` says what it has.
    #[error("input {input}: {stage} has no folder {subtree:?}; {known}")]
    Subtree { input: &'a str, stage: &'a str, subtree: &'a str, known: String },
    /// It names something of another kind.
    #[error("input {input} takes {}, but {named} is {kind}", port.kinds.join(" or "))]
    Kind { input: &'a str, port: &'a Input, named: &'a str, kind: &'a str },
}

/// Checks one input of a stage against what it names.
fn check_input<'a>(
    description: &'a Description,
    input: &'a str,
    source: &'a str,
    programs: &'a Programs,
) -> Result<(), InputError<'a>> {
    // A sink gets one record of all that it is shown; what its inputs are called is the file's own
    // affair.
    let record = || description.inputs.get("run").filter(|_| description.sink);
    let Some(port) = description.inputs.get(input).or_else(record) else {
        let known = known_names(input, description.inputs.keys().map(String::as_str));
        return Err(InputError::Unknown { input, known });
    };
    let Source::Stage { name: other, subtree } = Source::of(source) else {
        let problem = InputError::Folder { input, folder: source };
        return if description.sink { Err(problem) } else { Ok(()) };
    };
    match programs.get(other) {
        Some(made_by) if made_by.description.sink => Err(InputError::Sink { input, stage: other }),
        Some(made_by) if !description.sink => {
            check_kind((input, port), source, (other, subtree), made_by)
        }
        _ => Ok(()),
    }
}

/// Checks that what an input names is of a kind that it takes.
fn check_kind<'a>(
    (input, port): (&'a str, &'a Input),
    source: &'a str,
    (other, subtree): (&'a str, Option<&'a str>),
    made_by: &'a StageProgram,
) -> Result<(), InputError<'a>> {
    let output = &made_by.description.output;
    let kind = match subtree {
        None => &output.kind,
        Some(folder) => output.subtrees.get(folder).ok_or_else(|| {
            let known = known_names(folder, output.subtrees.keys().map(String::as_str));
            InputError::Subtree { input, stage: other, subtree: folder, known }
        })?,
    };
    if port.kinds.contains(kind) {
        return Ok(());
    }
    Err(InputError::Kind { input, port, named: source, kind })
}

/// The stages that a block names as inputs.
pub(crate) fn needs<'a>(pipeline: &'a Pipeline, stage: &str) -> impl Iterator<Item = &'a str> {
    pipeline.stages[stage].inputs.values().filter_map(|source| Source::of(source).stage())
}

/// The stages that targets come to, themselves included; `sources` are the stages that one names as
/// inputs.
pub(crate) fn closure(
    targets: &[String],
    sources: impl Fn(&str) -> Vec<String>,
) -> BTreeSet<String> {
    let mut found: BTreeSet<String> = BTreeSet::new();
    let mut open: Vec<String> = targets.to_vec();
    while let Some(stage) = open.pop() {
        if found.insert(stage.clone()) {
            open.extend(sources(&stage));
        }
    }
    found
}

/// An order in which every stage comes after those it needs: Kahn's, by name where there is a
/// choice; what is left over is a cycle.
pub(crate) fn order(pipeline: &Pipeline) -> Result<Vec<String>, PipelineError> {
    let mut left: BTreeSet<&str> = pipeline.stages.keys().map(String::as_str).collect();
    let mut order: Vec<String> = Vec::new();
    while !left.is_empty() {
        let Some(ready) =
            left.iter().find(|s| needs(pipeline, s).all(|n| !left.contains(n))).copied()
        else {
            return Err(cycle(pipeline, &left));
        };
        left.remove(ready);
        order.push(ready.to_owned());
    }
    Ok(order)
}

/// Names a cycle among stages that all wait for others of them.
fn cycle(pipeline: &Pipeline, left: &BTreeSet<&str>) -> PipelineError {
    let mut path: Vec<&str> = left.first().copied().into_iter().collect();
    // Walk from need to need inside what is left until a stage comes again.
    while let Some(next) =
        path.last().and_then(|last| needs(pipeline, last).find(|n| left.contains(n)))
    {
        if let Some(at) = path.iter().position(|s| *s == next) {
            let cycle = [&path[at..], &[next]].concat().join(" ← ");
            return pipeline.error(
                path[at],
                Part::Block,
                format!("its inputs lead back to it: {cycle}"),
            );
        }
        path.push(next);
    }
    unreachable!("what is left needs something that is left")
}

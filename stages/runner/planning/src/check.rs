//! Checks a whole pipeline, independently of the targets: first names, then blocks against the
//! descriptions of their programs.

use std::collections::BTreeSet;

use artifact::known_names;
use serde_json::Map;
use stage::Description;

use crate::file::{InputSource, Part, PipelineError, StageBlock};
use crate::pipeline::Pipeline;
use crate::stages::{Programs, StageProgram};

/// Checks that every stage exists that the pipeline names.
pub(crate) fn check_names(pipeline: &Pipeline) -> Result<(), PipelineError> {
    for name in &pipeline.default {
        if !pipeline.stages.contains_key(name) {
            let known = known_stages(pipeline, name);
            let problem = format!("default: no stage {name:?}; {known}");
            return Err(pipeline.error_in_default(problem));
        }
    }
    for (name, block) in &pipeline.stages {
        check_extends(pipeline, name, block)?;
        for (input, source) in &block.inputs {
            let Some(other) = InputSource::parse(source).stage() else { continue };
            if !pipeline.stages.contains_key(other) {
                let known = known_stages(pipeline, other);
                let problem = format!(
                    "input {input}: no stage {other:?}; a folder starts with ./ or /; {known}"
                );
                return Err(pipeline.error(name, Part::Input(input), problem));
            }
        }
    }
    Ok(())
}

/// Returns a suggestion for an unknown stage's name, and the known names.
pub(crate) fn known_stages(pipeline: &Pipeline, name: &str) -> String {
    known_names(name, pipeline.stages.keys().map(String::as_str))
}

/// Checks the `extends` of a block.
fn check_extends(pipeline: &Pipeline, name: &str, block: &StageBlock) -> Result<(), PipelineError> {
    let Some(other) = &block.extends else { return Ok(()) };
    let problem = match pipeline.stages.get(other) {
        None => format!("extends: no stage {other:?}; {}", known_stages(pipeline, other)),
        Some(StageBlock { extends: Some(base), .. }) => {
            let remedy = if base == name || base == other {
                "remove one `extends`".to_owned()
            } else {
                format!("extend {base:?} instead")
            };
            format!("extends: {other:?} itself extends {base:?}; {remedy}")
        }
        Some(_) if block.run.is_some() => {
            "run: not allowed together with `extends`; remove one of them".to_owned()
        }
        Some(_) => return Ok(()),
    };
    Err(pipeline.error(name, Part::Field("extends"), problem))
}

/// Checks every block with a usable program against the program's description, and the kinds of its
/// inputs.
pub(crate) fn check_blocks(pipeline: &Pipeline, programs: &Programs) -> Result<(), PipelineError> {
    // Blocks that extend others come last: a problem in an inherited entry is reported for the
    // block that contains the entry.
    let (extending, own): (Vec<_>, Vec<_>) =
        pipeline.stages.iter().partition(|(_, block)| block.extends.is_some());
    for (name, block) in own.into_iter().chain(extending) {
        let Some(program) = programs.get(name) else { continue };
        check_parameters(pipeline, program, name, block)?;
        for (input, source) in &block.inputs {
            check_input(&program.description, input, source, programs).map_err(|problem| {
                let is_inherited = pipeline.is_inherited(name, Part::Input(input));
                let remedy = if is_inherited && !program.description.inputs.contains_key(input) {
                    format!("; `{input}: null` removes an inherited input")
                } else {
                    String::new()
                };
                pipeline.error(name, Part::Input(input), problem + &remedy)
            })?;
        }
        for (input, declared) in &program.description.inputs {
            let is_given = block.inputs.contains_key(input)
                || (program.description.sink && !block.inputs.is_empty());
            if !declared.optional && !is_given {
                let problem =
                    format!("input {input} is missing ({}); add it to `inputs`", declared.summary);
                return Err(pipeline.error(name, Part::Block, problem));
            }
        }
    }
    Ok(())
}

/// Checks the parameters of a block together with the inherited ones.
fn check_parameters(
    pipeline: &Pipeline,
    program: &StageProgram,
    name: &str,
    block: &StageBlock,
) -> Result<(), PipelineError> {
    let mut given = Map::new();
    for layer in pipeline.layers(name) {
        program.lay_over(&mut given, &pipeline.stages[layer]);
    }
    let Err(problems) = program.schema.resolve(&given) else { return Ok(()) };
    let parameter = problems[0].name.split('/').next().unwrap_or_default();
    let part =
        if program.is_given(block, parameter) { Part::Parameter(parameter) } else { Part::Block };
    Err(pipeline.error(name, part, problems[0].to_string()))
}

/// Checks one input of a stage against its source. Fails with the problem and a remedy.
fn check_input(
    description: &Description,
    input: &str,
    source: &str,
    programs: &Programs,
) -> Result<(), String> {
    // A sink's program has one input, `run`. Its block names inputs freely: the runner makes the
    // record of the run from them.
    let run = description.inputs.get("run").filter(|_| description.sink);
    let Some(declared) = description.inputs.get(input).or(run) else {
        let known = known_names(input, description.inputs.keys().map(String::as_str));
        return Err(format!("no input {input:?}; {known}"));
    };
    let InputSource::Stage { name: stage, subtree } = InputSource::parse(source) else {
        if description.sink {
            return Err(format!(
                "input {input}: {source} is a folder, but a sink shows stages; name a stage"
            ));
        }
        return Ok(());
    };
    let Some(producer) = programs.get(stage) else { return Ok(()) };
    if producer.description.sink {
        return Err(format!(
            "input {input}: {stage} is a sink, which has no artifact; name another stage"
        ));
    }
    if description.sink {
        return Ok(());
    }
    let output = &producer.description.output;
    let kind = match subtree {
        None => &output.kind,
        Some(subtree) => output.subtrees.get(subtree).ok_or_else(|| {
            let known = known_names(subtree, output.subtrees.keys().map(String::as_str));
            format!("input {input}: {stage} has no subtree {subtree:?}; {known}")
        })?,
    };
    if !declared.kinds.contains(kind) {
        let kinds = declared.kinds.join(" or ");
        return Err(format!(
            "input {input} takes kind {kinds}, but {source} has kind {kind}; name another stage or \
            subtree"
        ));
    }
    Ok(())
}

/// Returns the stages that a block names as inputs.
pub(crate) fn input_stages<'a>(
    pipeline: &'a Pipeline,
    stage: &str,
) -> impl Iterator<Item = &'a str> {
    pipeline.stages[stage].inputs.values().filter_map(|source| InputSource::parse(source).stage())
}

/// Returns the targets and their transitive dependencies. `parents` returns the stages that a stage
/// depends on.
pub(crate) fn dependencies(
    targets: &[String],
    parents: impl Fn(&str) -> Vec<String>,
) -> BTreeSet<String> {
    let mut found: BTreeSet<String> = BTreeSet::new();
    let mut open: Vec<String> = targets.to_vec();
    while let Some(stage) = open.pop() {
        if found.insert(stage.clone()) {
            open.extend(parents(&stage));
        }
    }
    found
}

/// Returns a topological order of all stages (Kahn's algorithm; by name if several are ready).
pub(crate) fn topological_order(pipeline: &Pipeline) -> Result<Vec<String>, PipelineError> {
    let mut remaining: BTreeSet<&str> = pipeline.stages.keys().map(String::as_str).collect();
    let mut order: Vec<String> = Vec::new();
    while !remaining.is_empty() {
        let mut stages = remaining.iter().copied();
        let ready = stages.find(|s| input_stages(pipeline, s).all(|n| !remaining.contains(n)));
        let Some(ready) = ready else { return Err(cycle_error(pipeline, &remaining)) };
        remaining.remove(ready);
        order.push(ready.to_owned());
    }
    Ok(order)
}

/// Creates the error for a cycle. Each of `stages` has an input among `stages`.
fn cycle_error(pipeline: &Pipeline, stages: &BTreeSet<&str>) -> PipelineError {
    let mut path: Vec<&str> = stages.first().copied().into_iter().collect();
    // Follow inputs until a stage repeats.
    while let Some(next) =
        path.last().and_then(|last| input_stages(pipeline, last).find(|n| stages.contains(n)))
    {
        if let Some(at) = path.iter().position(|s| *s == next) {
            let cycle = [&path[at..], &[next]].concat().join(" ← ");
            let problem = format!("inputs form a cycle: {cycle}; change one of these inputs");
            return pipeline.error(path[at], Part::Block, problem);
        }
        path.push(next);
    }
    unreachable!("each of the stages depends on another one")
}

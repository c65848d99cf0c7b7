//! Inputs that the command line gives by a stage's name: `-i init=train-ss` is the folder of the
//! artifact that `train-ss` has without this argument.

use artifact::known_names;
use planning::{Describing, Pipeline, Plan, PlanError, Request, State};

use crate::session::Session;

/// Replaces stages' names in `-i NAME=STAGE` by the folders of their artifacts; an existing file of
/// that name has priority. The artifact is that of the same command line, without the argument and
/// without the stage's own parameters, which are those of the training that continues. Only the
/// stages' names in earlier arguments have been replaced in that command line.
pub(crate) fn with_folders(
    pipeline: &Pipeline,
    session: &Session,
    request: &Request,
    describing: Describing<'_>,
) -> Result<Request, PlanError> {
    let mut resolved = request.clone();
    for (index, input) in request.inputs.iter().enumerate() {
        let Some((name, stage)) = input.split_once('=') else { continue };
        if !pipeline.stages.contains_key(stage) || std::path::Path::new(stage).exists() {
            continue;
        }
        let folder = folder_of(pipeline, session, &resolved, describing, (index, stage))?;
        resolved.inputs[index] = format!("{name}={folder}");
    }
    Ok(resolved)
}

/// Returns the folder of a stage's artifact in the plan without the argument `index`.
fn folder_of(
    pipeline: &Pipeline,
    session: &Session,
    request: &Request,
    describing: Describing<'_>,
    (index, stage): (usize, &str),
) -> Result<String, PlanError> {
    let mut earlier = Request { targets: vec![stage.to_owned()], ..request.clone() };
    earlier.inputs.remove(index);
    let names = parameter_names(pipeline, session, &earlier, describing, stage)?;
    earlier.parameters.retain(|text| !is_of_stage(text, stage, &names));
    let plan = Plan::new(pipeline, &session.store, &earlier, describing)?;
    let plan = Plan { devices: session.devices.clone(), ..plan };
    let states = plan.states(&session.store, None)?;
    let mut found = plan.nodes.iter().zip(states).filter(|(node, _)| node.stage == stage);
    let argument = &request.inputs[index];
    match (found.next(), found.next()) {
        (Some((_, State::Cached(record))), None) => {
            Ok(session.store.object(&record.output).display().to_string())
        }
        (Some(_), None) => Err(PlanError::Usage(format!(
            "-i {argument}: {stage} has no artifact yet; run it first: nerf-sr run {stage}"
        ))),
        _ => Err(PlanError::Usage(format!(
            "-i {argument}: {stage} has several points; name the folder of one (`nerf-sr path`)"
        ))),
    }
}

/// Returns the names of a stage's parameters.
fn parameter_names(
    pipeline: &Pipeline,
    session: &Session,
    request: &Request,
    describing: Describing<'_>,
    stage: &str,
) -> Result<Vec<String>, PlanError> {
    let request = Request { parameters: Vec::new(), ..request.clone() };
    let plan = Plan::new(pipeline, &session.store, &request, describing)?;
    let node = plan.nodes.iter().find(|node| node.stage == stage).ok_or_else(|| {
        let stages = plan.nodes.iter().map(|node| node.stage.as_str());
        PlanError::Usage(format!("{stage} has no artifact; {}", known_names(stage, stages)))
    })?;
    Ok(node.program.schema.names().into_iter().map(str::to_owned).collect())
}

/// True if an argument of `-p` sets a parameter of the stage.
fn is_of_stage(text: &str, stage: &str, names: &[String]) -> bool {
    let name = text.split('=').next().unwrap_or_default();
    match name.strip_prefix(stage).and_then(|rest| rest.strip_prefix('.')) {
        Some(_) => true,
        None => names.iter().any(|own| own == name),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_matched_to_their_stage() {
        let names = ["rays".to_owned(), "seed".to_owned()];
        for (text, expected) in [
            ("rays=30M", true),
            ("train-ss.rays=1,2", true),
            ("prep.scale=3", false),
            ("scale=3", false),
            ("train-ss-2.rays=1", false),
            ("", false),
        ] {
            assert_eq!(is_of_stage(text, "train-ss", &names), expected, "{text}");
        }
    }
}

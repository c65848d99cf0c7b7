//! Inputs that the command line gives by a stage's name: `-i init=train-ss` is the folder of the
//! artifact that `train-ss` has without this argument.

use planning::{Pipeline, Plan, PlanError, Request, State};
use store::Store;

use crate::session::nodes_of_stage;

/// Replaces stages' names in `-i NAME=STAGE` by the folders of their artifacts; an existing file of
/// that name has priority. The artifact is that of the same command line, without the argument and
/// without the stage's own parameters, which are those of the training that continues. Only the
/// stages' names in earlier arguments have been replaced in that command line. `new_plan` creates a
/// plan of the pipeline.
pub(crate) fn with_folders(
    pipeline: &Pipeline,
    store: &Store,
    request: &Request,
    new_plan: impl Fn(&Request) -> Result<Plan, PlanError>,
) -> Result<Request, PlanError> {
    let mut resolved = request.clone();
    for (index, input) in request.inputs.iter().enumerate() {
        let Some((name, stage)) = input.split_once('=') else { continue };
        if !pipeline.stages.contains_key(stage) || std::path::Path::new(stage).exists() {
            continue;
        }
        let mut earlier = Request { targets: vec![stage.to_owned()], ..resolved.clone() };
        earlier.inputs.remove(index);
        let plan = new_plan(&Request { parameters: Vec::new(), ..earlier.clone() })?;
        let names = plan.nodes[nodes_of_stage(&plan, stage)?[0]].program.schema.names();
        earlier.parameters.retain(|text| !is_of_stage(text, stage, &names));
        let folder = artifact_folder(store, &new_plan(&earlier)?, stage, input)?;
        resolved.inputs[index] = format!("{name}={folder}");
    }
    Ok(resolved)
}

/// Returns the folder of a stage's artifact, for the argument `input`.
fn artifact_folder(
    store: &Store,
    plan: &Plan,
    stage: &str,
    input: &str,
) -> Result<String, PlanError> {
    let states = plan.states(store, None)?;
    let mut found = plan.nodes.iter().zip(states).filter(|(node, _)| node.stage == stage);
    let problem = match (found.next(), found.next()) {
        (Some((_, State::Cached(record))), None) => {
            return Ok(store.object(&record.output).display().to_string());
        }
        (Some(_), None) => format!("has no artifact yet; run it first: nerf-sr run {stage}"),
        _ => "has several points; name the folder of one (`nerf-sr path`)".to_owned(),
    };
    Err(PlanError::Usage(format!("-i {input}: {stage} {problem}")))
}

/// True if an argument of `-p` sets a parameter of the stage.
fn is_of_stage(text: &str, stage: &str, names: &[&str]) -> bool {
    let name = text.split('=').next().unwrap_or_default();
    name.strip_prefix(stage).is_some_and(|rest| rest.starts_with('.')) || names.contains(&name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_matched_to_their_stage() {
        let names = ["rays", "seed"];
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

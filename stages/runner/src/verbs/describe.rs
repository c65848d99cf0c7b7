use std::process::{Command, ExitCode};

use anyhow::Context as _;
use planning::{Pipeline, PlanError, executable};

/// Prints the help of a stage's program: what it makes, its inputs and its parameters.
pub(crate) fn describe(pipeline: &Pipeline, stage: &str) -> anyhow::Result<ExitCode> {
    let (pipeline, _) = planning::find_targets(pipeline, &[stage.to_owned()])?;
    if !pipeline.stages.contains_key(stage) {
        let known = artifact::known_names(stage, pipeline.stages.keys().map(String::as_str));
        return Err(PlanError::Usage(format!("no stage {stage:?}; {known}")).into());
    }
    let program = executable(&pipeline, stage);
    let status = Command::new(&program).arg("--help").status();
    let status = status
        .with_context(|| format!("{} can't be started; run `make build`", program.display()))?;
    Ok(if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

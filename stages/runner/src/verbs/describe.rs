use std::process::{Command, ExitCode};

use anyhow::Context as _;

use crate::pipeline::Pipeline;
use crate::plan::PlanError;
use crate::stages::executable;

/// Prints the help of a stage's program: what it makes, its inputs and its parameters.
pub(crate) fn describe(pipeline: &Pipeline, stage: &str) -> anyhow::Result<ExitCode> {
    if !pipeline.stages.contains_key(stage) {
        let known = pipeline.stages.keys().cloned().collect::<Vec<_>>().join(", ");
        return Err(PlanError::Usage(format!("no stage {stage:?}; known: {known}")).into());
    }
    let program = executable(pipeline, stage);
    let status = Command::new(&program).arg("--help").status();
    let status = status.with_context(|| format!("{}; build it (make build)", program.display()))?;
    Ok(if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

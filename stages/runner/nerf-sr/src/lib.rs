//! `nerf-sr`, the runner: pipeline.yaml → plan → run. The crate `planning` creates plans; this one
//! carries them out. It knows stages by their `describe` and artifacts by their hashes; `estimates`
//! also knows what the rays and pixels of some stages cost.
//!
//! * `cli`, `session`, `verbs`: the command line, its pipeline and store, and one function per
//!   verb.
//! * `starter`: the pipeline file that `init` writes.
//! * `execute`: carries out a plan on this machine or as a cluster's jobs, each node under its
//!   key's lock. `unchanged` checks that programs and inputs stay the same while a stage runs.
//!   `waiting` waits for locks; `run_messages` has the messages at the end of a run.
//! * `garbage`: deletes the artifacts that nothing needs.
//! * `estimates`: processor time of the stages to run.
//! * `planned`: a plan's nodes with their states, as text and as JSON. `lineage` compares two
//!   results and their inputs.
//! * `watch`: shows one test view of a field while the field trains.
//! * `sink`: gives the run's record (`run_record`) to stages that show it, such as the report, and
//!   publishes their pages (`publish`, `page`).

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod cli;
mod estimates;
mod execute;
mod garbage;
mod lineage;
mod page;
mod planned;
mod publish;
mod run_messages;
mod run_record;
mod session;
mod sink;
mod starter;
mod unchanged;
mod verbs;
mod waiting;
mod watch;

use std::process::ExitCode;

use artifact::report_line;
use planning::PlanError;
use planning::stage_call::StageFailure;

/// Runs the program and returns the exit code. A closed stdout isn't a failure. Codes:
///
/// * 0: success
/// * 1: other failures, such as those of the store
/// * 2: invalid pipeline file or command line
/// * 3: unusable input folder or artifact
/// * 70: panic
/// * 130: interruption
/// * after a stage has failed: that stage's exit code
pub fn main() -> ExitCode {
    stage::install_panic_hook("nerf-sr");
    cli::run_command_line().unwrap_or_else(|error| {
        report_line!("nerf-sr: {}", artifact::one_line(&error));
        ExitCode::from(exit_code(&error))
    })
}

/// Returns the exit code of an error: that of the first [`PlanError`] or [`StageFailure`] in the
/// error's chain, otherwise that of [`artifact::exit_code`].
fn exit_code(error: &anyhow::Error) -> u8 {
    let code = error.chain().find_map(|cause| {
        let failure = cause.downcast_ref::<StageFailure>().map(|failure| failure.code);
        failure.or_else(|| cause.downcast_ref::<PlanError>().map(plan_exit_code))
    });
    code.unwrap_or_else(|| artifact::exit_code(error))
}

/// Converts an error to the failure of a stage.
fn stage_failure(error: &anyhow::Error) -> StageFailure {
    StageFailure { code: exit_code(error), message: artifact::one_line(error) }
}

fn plan_exit_code(error: &PlanError) -> u8 {
    match error {
        PlanError::Pipeline(_) | PlanError::Usage(_) => StageFailure::USAGE,
        PlanError::Store(_) => StageFailure::FAILED,
        PlanError::Source { .. } | PlanError::Artifact(_) => StageFailure::BAD_INPUT,
        PlanError::Interrupted => StageFailure::INTERRUPTED,
    }
}

use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};

use artifact::{Failure, report_line};
use planning::{Plan, Request, State};
use stage_call::{StageFailure, stop_on_signals};
use store::{RunFile, Store};

use crate::execute::{Executor, Work};
use crate::session::{Session, check_apart, command_line};
use crate::waiting::enter;

/// Makes what the targets need and shows it.
pub(crate) fn run(
    session: &Session,
    what: &Request,
    out: &Path,
    executor: &dyn Executor,
) -> anyhow::Result<ExitCode> {
    let stop = stop_on_signals()?;
    let plan = session.plan_to_run(what, &stop)?;
    check_apart(&plan, "the folder of pages", out)?;
    let file = match register(&session.store, &plan, &stop) {
        Ok(file) => file,
        Err(_) if stop.load(Ordering::Relaxed) => return Err(Failure::Interrupted.into()),
        Err(error) => return Err(error.into()),
    };
    let code = executor.carry_out(&Work { session, plan: &plan, run: &file, out, stop: &stop });
    // A run whose end isn't written down, on a full disk, counts from its beginning.
    file.end().ok();
    code
}

/// Writes down what the run needs, as far as is known before it starts.
pub(super) fn register(
    store: &Store,
    plan: &Plan,
    stop: &AtomicBool,
) -> Result<RunFile, StageFailure> {
    let fail = |e: store::StoreError| StageFailure { code: 1, message: e.to_string() };
    let entered = enter(store, stop, &|text| report_line!("nerf-sr: {text}"))?;
    let file = store.begin_run(&entered, command_line()).map_err(fail)?;
    // A source that can't be read is said when the stage's turn comes; other stages may not need
    // it.
    let states = plan.states(store, Some(stop)).unwrap_or_default();
    for (index, node) in plan.nodes.iter().enumerate() {
        match states.get(index).and_then(State::key) {
            Some(key) => file.needs(&entered, &node.stage, &key),
            None => file.waits(&entered, node.waiting()),
        }
        .map_err(fail)?;
    }
    Ok(file)
}

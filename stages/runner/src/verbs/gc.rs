use std::process::ExitCode;

use artifact::{Failure, print_line, report_line, stop_on_signals};
use garbage::{Choice, Root, judge};
use stage_call::seconds;

use crate::plan::Request;
use crate::session::Session;
use crate::waiting::until_held;

/// Removes what nothing needs any more.
pub(crate) fn gc(session: &Session, what: &Request, dry_run: bool, choice: Choice) -> anyhow::Result<ExitCode> {
    let store = &session.store;
    let needed = needed(session, what)?;
    if dry_run {
        let verdict = judge(store, needed, choice)?;
        verdict.lines().iter().for_each(|line| print_line!("{line}"));
        let (goes, stays) = verdict.bytes();
        print_line!("{:.1} MB would go, {:.1} MB would stay", goes as f64 / 1e6, stays as f64 / 1e6);
        return Ok(ExitCode::SUCCESS);
    }
    let stop = stop_on_signals()?;
    let say = |_: Option<&_>, waited: std::time::Duration| {
        report_line!("nerf-sr: waits until no run looks for artifacts, for {} now", seconds(waited.as_secs_f64()));
    };
    let closed = match until_held(&stop, &say, || store.try_close()) {
        Ok(closed) => closed,
        Err(failure) if failure.code == 130 => return Err(Failure::Interrupted.into()),
        Err(failure) => return Err(failure.into()),
    };
    let verdict = judge(store, needed, choice)?;
    verdict.carry_out(store, &closed)?;
    drop(closed);
    verdict.lines().iter().for_each(|line| print_line!("{line}"));
    store.empty_trash()?;
    let (goes, stays) = verdict.bytes();
    print_line!("{:.1} MB freed, {:.1} MB stay", goes as f64 / 1e6, stays as f64 / 1e6);
    Ok(ExitCode::SUCCESS)
}

/// What the pipeline needs with these arguments.
fn needed(session: &Session, what: &Request) -> anyhow::Result<Root> {
    let plan = session.plan(what)?;
    let mut root = Root { why: "the pipeline needs it".to_owned(), ..Root::default() };
    for (node, state) in plan.nodes.iter().zip(session.states(&plan)?) {
        match state.key() {
            Some(key) => _ = root.keys.insert(key),
            None => root.waiting.push(node.waiting()),
        }
    }
    Ok(root)
}

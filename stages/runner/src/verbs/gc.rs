use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context as _;
use artifact::{Failure, print_line, report_line};
use garbage::{Collection, Policy, Root};
use planning::{PlanError, Request};
use serde_json::json;
use stage::stop_on_signals;
use stage_call::seconds;

use super::print::print_json;
use crate::session::Session;
use crate::waiting::until_held;

/// Removes what nothing needs any more.
pub(crate) fn gc(
    session: &Session,
    what: &Request,
    policy: Policy,
    style: Style,
) -> anyhow::Result<ExitCode> {
    let store = &session.store;
    let needed = needed(session, what)?;
    if style.dry_run {
        return style.tell(&Collection::new(store, needed, policy).context(UNREAD)?);
    }
    let stop = stop_on_signals()?;
    let closed = match until_held(&stop, &|_, waited| say_wait(waited), || store.try_close()) {
        Ok(closed) => closed,
        Err(failure) if failure.code == 130 => return Err(Failure::Interrupted.into()),
        Err(failure) => return Err(failure.into()),
    };
    let collection = Collection::new(store, needed, policy).context(UNREAD)?;
    collection.carry_out(store, &closed)?;
    drop(closed);
    store.empty_trash()?;
    style.tell(&collection)
}

/// Context of an error that comes before anything is deleted.
const UNREAD: &str =
    "nothing was deleted: gc must read the whole store; make this readable or move it away";

fn say_wait(waited: Duration) {
    report_line!(
        "nerf-sr: waits until no run looks for artifacts, for {} now",
        seconds(waited.as_secs_f64())
    );
}

/// What to do beside deciding, and how to tell of it.
#[derive(Clone, Copy)]
pub(crate) struct Style {
    /// Only say what would go.
    pub(crate) dry_run: bool,
    /// For programs.
    pub(crate) json: bool,
}

impl Style {
    fn tell(self, collection: &Collection) -> anyhow::Result<ExitCode> {
        let (goes, stays) = collection.bytes();
        if self.json {
            let told = json!({"dry_run": self.dry_run, "bytes_gone": goes, "bytes_left": stays,
                "items": collection.decisions()});
            return print_json(&told);
        }
        for decision in collection.decisions() {
            print_line!("{decision}");
        }
        let verbs = if self.dry_run { ("would go", "would stay") } else { ("freed", "stay") };
        print_line!(
            "{:.1} MB {}, {:.1} MB {}",
            goes as f64 / 1e6,
            verbs.0,
            stays as f64 / 1e6,
            verbs.1
        );
        Ok(ExitCode::SUCCESS)
    }
}

/// What the pipeline needs with these arguments.
fn needed(session: &Session, what: &Request) -> anyhow::Result<Root> {
    let plan = session.plan(what)?;
    let states = match plan.states(&session.store, None) {
        Err(error @ PlanError::Store(_)) => return Err(anyhow::Error::from(error).context(UNREAD)),
        states => states?,
    };
    let mut root = Root { reason: "the pipeline needs it".to_owned(), ..Root::default() };
    for (node, state) in plan.nodes.iter().zip(states) {
        match state.key() {
            Some(key) => _ = root.keys.insert(key),
            None => root.waiting.push(node.waiting()),
        }
    }
    Ok(root)
}

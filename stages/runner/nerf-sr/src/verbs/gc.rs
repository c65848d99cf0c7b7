use crate::garbage::{Collection, Policy, Root};
use anyhow::Context as _;
use artifact::{format_size, print_line, report_line};
use planning::{PlanError, Request, stored_inputs};
use serde_json::json;
use stage::stop_on_signals;
use store::Record;

use super::print_json;
use crate::session::Session;
use crate::waiting::wait_for_lock;

/// Deletes artifacts that nothing needs (docs/design/029), or with `dry_run` only lists them.
pub(crate) fn gc(
    session: &Session,
    request: &Request,
    policy: Policy,
    dry_run: bool,
    json: bool,
) -> anyhow::Result<()> {
    let store = &session.store;
    let root = plan_root(session, request)?;
    if dry_run {
        return print(&Collection::new(store, root, policy).context(UNREADABLE)?, dry_run, json);
    }
    let stop = stop_on_signals()?;
    let closed = wait_for_lock(
        &stop,
        "runs look up artifacts",
        &|text| report_line!("nerf-sr: {text}"),
        || store.try_close(),
    )?;
    let collection = Collection::new(store, root, policy).context(UNREADABLE)?;
    collection.carry_out(store, &closed)?;
    drop(closed);
    if let Err(error) = store.empty_trash() {
        report_line!("nerf-sr: warning: the next gc must delete the rest of the trash: {error}");
    }
    print(&collection, dry_run, json)
}

/// Context of an error before anything is deleted.
const UNREADABLE: &str = "nothing was deleted, because gc must read the whole store; make this \
    file readable or move it away";

fn print(collection: &Collection, dry_run: bool, json: bool) -> anyhow::Result<()> {
    let decisions = collection.decisions();
    let (mut deleted, mut kept) = (0, 0);
    for decision in &decisions {
        let total = if decision.kept_because.is_some() { &mut kept } else { &mut deleted };
        *total += decision.bytes.unwrap_or(0);
    }
    if json {
        return print_json(&json!({"dry_run": dry_run, "bytes_gone": deleted,
            "bytes_left": kept, "items": decisions}));
    }
    for decision in decisions {
        print_line!("{decision}");
    }
    let [deleted, kept] = [deleted, kept].map(format_size);
    if dry_run {
        print_line!("{deleted} would be deleted, {kept} would be kept");
    } else {
        print_line!("{deleted} deleted, {kept} kept");
    }
    Ok(())
}

/// Returns the root that keeps the plan's actions.
fn plan_root(session: &Session, request: &Request) -> anyhow::Result<Root> {
    let plan = session.plan(request)?;
    let states = match plan.states(&session.store, None) {
        Err(error @ PlanError::Store(_)) => {
            return Err(anyhow::Error::from(error).context(UNREADABLE));
        }
        states => states?,
    };
    let mut root = Root { reason: "the pipeline needs it".to_owned(), ..Root::default() };
    for (index, state) in states.iter().enumerate() {
        match state.key() {
            Some(key) => _ = root.keys.insert(key),
            None => root.waiting.push(plan.nodes[index].partial_key()),
        }
    }
    let stored = stored_inputs(&plan.nodes, &session.store).context(UNREADABLE)?;
    root.keys.extend(stored.iter().map(Record::key));
    Ok(root)
}

use artifact::{Failure, bail_usage, format_count, known_names, print_line};
use planning::{Request, State, stored_inputs};

use crate::session::{Session, command_line};
use crate::waiting::try_enter_store;

/// Maximum length of a pin's name in bytes; chosen by hand, below the limit of file systems.
const MAX_NAME_BYTES: usize = 100;

/// Protects the targets' artifacts from garbage collection.
pub(crate) fn pin(session: &Session, name: &str, request: &Request) -> anyhow::Result<()> {
    check_name(name)?;
    let plan = session.plan(request)?;
    let entered = try_enter_store(&session.store)?;
    let mut actions = Vec::new();
    for (index, state) in plan.states(&session.store, None)?.into_iter().enumerate() {
        let node = &plan.nodes[index];
        let State::Cached(record) = state else {
            bail_usage!("{} has no artifact to pin yet; run it first", node.label());
        };
        actions.push((node.stage.clone(), record.key()));
    }
    for record in stored_inputs(&plan.nodes, &session.store)? {
        actions.push((record.stage.clone(), record.key()));
    }
    session.store.pin(&entered, name, command_line(), &actions)?;
    print_line!("pinned {} as {name}", format_count(actions.len(), "artifact"));
    Ok(())
}

/// Removes a pin.
pub(crate) fn unpin(session: &Session, name: &str) -> anyhow::Result<()> {
    check_name(name)?;
    if session.store.unpin(name)? {
        print_line!("removed pin {name}");
        return Ok(());
    }
    let pins = session.store.pin_names()?;
    let known = known_names(name, pins.iter().map(String::as_str));
    bail_usage!("no pin {name:?}; {known}");
}

/// Fails unless a pin's name is valid as a file name.
fn check_name(name: &str) -> Result<(), Failure> {
    let is_plain = name.chars().all(|c| c.is_alphanumeric() || "-_.".contains(c));
    if name.is_empty() || name.starts_with('.') || name.len() > MAX_NAME_BYTES || !is_plain {
        bail_usage!(
            "invalid pin name {name:?}; use at most {MAX_NAME_BYTES} bytes of letters, digits, -, \
            _ and ., and no dot at the beginning"
        );
    }
    Ok(())
}

use std::process::ExitCode;

use artifact::print_line;
use planning::{PlanError, Request, State};

use crate::session::{Session, command_line};
use crate::waiting::enter_at_once;

/// Keeps what the targets have, until `unpin`.
pub(crate) fn pin(session: &Session, name: &str, what: &Request) -> anyhow::Result<ExitCode> {
    check(name)?;
    let plan = session.plan(what)?;
    let entered = enter_at_once(&session.store)?;
    let mut actions = Vec::new();
    for (node, state) in plan.nodes.iter().zip(session.states(&plan)?) {
        match state {
            State::Cached(record) => actions.push((node.stage.clone(), record.key())),
            _ => {
                let message = format!(
                    "{} isn't cached, and only what is made can be pinned; run it first",
                    node.label()
                );
                return Err(PlanError::Usage(message).into());
            }
        }
    }
    session.store.pin(&entered, name, command_line(), &actions)?;
    print_line!("pinned {} artifacts as {name}", actions.len());
    Ok(ExitCode::SUCCESS)
}

/// Takes a pin away.
pub(crate) fn unpin(session: &Session, name: &str) -> anyhow::Result<ExitCode> {
    check(name)?;
    if session.store.unpin(name)? {
        print_line!("{name} is no longer pinned");
        return Ok(ExitCode::SUCCESS);
    }
    let known = session.store.pin_names()?;
    let known = if known.is_empty() {
        "nothing is pinned".to_owned()
    } else {
        format!("pinned: {}", known.join(", "))
    };
    Err(PlanError::Usage(format!("no pin {name:?}; {known}")).into())
}

/// A pin's name is a file's.
fn check(name: &str) -> Result<(), PlanError> {
    let is_plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    if name.is_empty() || name.starts_with('.') || name.len() > 100 || !name.chars().all(is_plain) {
        return Err(PlanError::Usage(format!(
            "pin {name:?}: a name has letters, digits, -, _ and ., and doesn't begin with a dot"
        )));
    }
    Ok(())
}

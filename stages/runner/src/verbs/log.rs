use std::process::ExitCode;

use artifact::hash_json;

use crate::plan::{Request, State};
use crate::session::{Session, of_stage};

/// Prints what a stage said.
pub(crate) fn log(session: &Session, stage: &str, what: &Request) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let states = session.states(&plan)?;
    for i in of_stage(&plan, stage)? {
        let path = match &states[i] {
            State::Cached(record) => session.store.action(&record.key(), "log"),
            State::WillRun { key_parts } => session.store.partial(&hash_json(key_parts)).join("log"),
            State::Waits { .. } => continue,
        };
        println!("{}:", plan.nodes[i].label());
        print!("{}", std::fs::read_to_string(&path).unwrap_or_else(|_| "  it has said nothing yet\n".to_owned()));
    }
    Ok(ExitCode::SUCCESS)
}

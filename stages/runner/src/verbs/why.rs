use std::process::ExitCode;

use artifact::print_line;

use crate::plan::Request;
use crate::session::{Session, of_stage};
use crate::words::{causes, words};

/// Says why a stage is cached, would run, or waits.
pub(crate) fn why(session: &Session, stage: &str, what: &Request) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let states = session.states(&plan)?;
    let records = session.store.records()?;
    for i in of_stage(&plan, stage)? {
        print_line!("{}: {}", plan.nodes[i].label(), words(session, &plan, i, &states[i], &records));
        for cause in causes(&states, i) {
            print_line!("  {}: {}", plan.nodes[cause].label(), words(session, &plan, cause, &states[cause], &records));
        }
    }
    Ok(ExitCode::SUCCESS)
}

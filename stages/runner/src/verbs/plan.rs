use std::process::ExitCode;

use artifact::print_line;
use planning::Request;

use super::print::print_json;
use crate::node_report::PlanReport;
use crate::session::Session;
use crate::words::{by_scene, shown, words};

/// Shows what `run` would do.
pub(crate) fn plan(session: &Session, what: &Request, json: bool) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let states = session.states(&plan)?;
    if json {
        return print_json(&PlanReport::new(session, &plan, &states, &[])?);
    }
    for (i, state) in states.iter().enumerate() {
        print_line!("{:<40} {}", plan.nodes[i].label(), words(session, &plan, i, state, None));
        by_scene(session, &plan.nodes[i], state).iter().for_each(|line| print_line!("    {line}"));
    }
    for sink in &plan.sinks {
        print_line!("{:<40} {}", sink.stage, shown(&plan, sink, &states));
    }
    Ok(ExitCode::SUCCESS)
}

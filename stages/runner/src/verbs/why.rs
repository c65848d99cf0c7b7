use std::process::ExitCode;

use artifact::print_line;
use planning::{Plan, Request, State};
use store::Record;

use super::print::print_json;
use crate::node_report::PlanReport;
use crate::session::{Session, of_stage};
use crate::words::{by_scene, causes, shown, words};

/// Says why a stage is cached, would run, or waits; of a sink, what it shows.
pub(crate) fn why(
    session: &Session,
    stage: &str,
    what: &Request,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let states = session.states(&plan)?;
    let records = session.store.records()?;
    if json {
        return print_json(&PlanReport::new(session, &plan, &states, &records)?.only(stage));
    }
    let line = |index: usize| explained(session, &plan, &states, &records, index);
    if let Some(sink) = plan.sinks.iter().find(|sink| sink.stage == stage) {
        print_line!("{stage}: {}", shown(&plan, sink, &states));
        sink.shows.iter().for_each(|&index| print_line!("  {}", line(index)));
        return Ok(ExitCode::SUCCESS);
    }
    for index in of_stage(&plan, stage)? {
        print_line!("{}", line(index));
        by_scene(session, &plan.nodes[index], &states[index])
            .iter()
            .for_each(|line| print_line!("    {line}"));
        causes(&states, index).into_iter().for_each(|cause| print_line!("  {}", line(cause)));
    }
    Ok(ExitCode::SUCCESS)
}

/// A node with its state, and why that is so.
fn explained(
    session: &Session,
    plan: &Plan,
    states: &[State],
    records: &[Record],
    index: usize,
) -> String {
    let words = words(session, plan, index, &states[index], Some(records));
    format!("{}: {words}", plan.nodes[index].label())
}

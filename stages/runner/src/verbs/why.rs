use std::process::ExitCode;

use artifact::print_line;
use planning::Request;

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
        return super::print_json(&PlanReport::new(session, &plan, &states, &records).only(stage));
    }
    let say = |index: usize, indent: &str| {
        print_line!(
            "{indent}{}: {}",
            plan.nodes[index].label(),
            words(session, &plan, index, &states[index], Some(&records))
        );
    };
    if let Some(sink) = plan.sinks.iter().find(|sink| sink.stage == stage) {
        print_line!("{stage}: {}", shown(&plan, sink, &states));
        sink.shows.iter().for_each(|&index| say(index, "  "));
        return Ok(ExitCode::SUCCESS);
    }
    for index in of_stage(&plan, stage)? {
        say(index, "");
        by_scene(session, &plan.nodes[index], &states[index])
            .iter()
            .for_each(|line| print_line!("    {line}"));
        causes(&states, index).into_iter().for_each(|cause| say(cause, "  "));
    }
    Ok(ExitCode::SUCCESS)
}

use std::process::ExitCode;

use artifact::{counted, hash_json, print_line, sized};
use planning::{Request, State};
use stage_call::seconds;

use super::print::print_json;
use crate::node_report::PlanReport;
use crate::session::Session;
use crate::words::age;

/// Shows every stage with its artifact, age and time.
pub(crate) fn status(session: &Session, what: &Request, json: bool) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let states = session.states(&plan)?;
    let (jobs, besides) = session.jobs(&plan);
    if json {
        let mut report = PlanReport::new(session, &plan, &states, &[])?;
        report.nodes.iter_mut().zip(jobs).for_each(|(node, job)| node.job = job);
        return print_json(&report);
    }
    let mut jobs = jobs.into_iter();
    for (node, state) in plan.nodes.iter().zip(states) {
        let job = jobs.next().flatten().map(|job| job.to_string());
        let detail = match &state {
            State::Cached(record) => {
                let size = session.store.manifest(&record.output).map_or(0, |m| m.size());
                format!(
                    "{}  {:>9}  {:>9}  {}",
                    &record.output[..10],
                    sized(size),
                    seconds(record.seconds),
                    age(record)
                )
            }
            State::WillRun { key_parts }
                if session.store.has_checkpoint(&hash_json(key_parts))? =>
            {
                "has a checkpoint to go on from".to_owned()
            }
            _ => String::new(),
        };
        let detail = job
            .into_iter()
            .chain((!detail.is_empty()).then_some(detail))
            .collect::<Vec<_>>()
            .join("; ");
        print_line!("{:<40} {:<9} {detail}", node.label(), state.name());
    }
    if besides > 0 {
        print_line!(
            "queued besides: {}, of pages or of runs with other arguments",
            counted(besides, "job")
        );
    }
    Ok(ExitCode::SUCCESS)
}
